"""What ``p2p check`` prints: what is wrong with a sequence of one's own, before anything is tracked.

Known faults: depth in another unit or not registered to colour, the camera matrix of another resolution, times in
milliseconds, masks that hold the table too, objects without anything to track.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from p2p_lib.apps.click import FirstMasks, check_depths, clicked_masks
from p2p_lib.core.backends import DEFAULT_DETECTOR, make_detector
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config, preset
from p2p_lib.core.errors import BadInput, Doubt, MissingData, P2PError, did_you_mean, listed
from p2p_lib.core.findings import Finding, Level
from p2p_lib.core.mask_length import doubt_growth, mask_length_m, whole_length_m
from p2p_lib.core.options import lengths_m
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame, evenly
from p2p_lib.datasets import first_masks as drawing
from p2p_lib.datasets import images
from p2p_lib.datasets.alignment import background_share, misfit, moving_scale
from p2p_lib.datasets.camera_check import odd_camera, sees
from p2p_lib.datasets.depth_units import (
    MEASURED_SHARE,
    beyond,
    distance_m,
    hardly_counts,
    likely_units,
    near_scene,
    odd_scene,
    odd_size,
    uncounted,
)
from p2p_lib.datasets.image_sequence import INTRINSICS, paired_images, read_K
from p2p_lib.datasets.images import DEFAULT_HZ
from p2p_lib.datasets.numbering import numbered_apart
from p2p_lib.datasets.sequence import Sequence, no_truth_said, open_sequence, recognise
from p2p_lib.evaluation.known_size import Lengths
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX
from p2p_lib.extended.depth_lag import DepthLag
from p2p_lib.method.sampling import choose, usable_region

#: Frames that are looked at, evenly spread.
FRAMES = 12
#: Ranges in metres of whatever is recorded in front of a depth camera.
NEAREST_M, FARTHEST_M = 0.05, 20.0
#: Frames per second that cameras have, and a gap as a multiple of the usual interval.
RATES_HZ, GAP = (0.5, 500.0), 10.0
#: Fraction of images that may equal the next one.
REPEATED_SHARE = 0.3
#: Fraction of a mask's rim that may lie on the background: 0.4 at most on good sequences.
RIM_SHARE = 0.5
#: What an object seldom is: so much of the image, so deep (of its distance). Good sequences: at most 0.07, 0.23.
LARGE_SHARE, DEEP_SHARE = 0.12, 0.25
#: Files of one fault that are named.
_LISTED = 5
#: Fewer points tell no pose.
POSED = 3
#: Fraction of depth at its largest value from which on it was cut off there.
CLIPPED_SHARE = 0.1

#: What is judged in metres, by how its findings are called.
_BY_METRES = ("registration", ": mask", ": points")
_KNOWN = "--size NAME=CM (the object's longest side)"
#: What to put where something of a folder is missing.
_PUT = {
    "rgb": "Put the colour images there, one for each depth image.",
    "depth": "Put the depth images there, registered to colour, one for each colour image, in 16-bit millimetres.",
}
_REPLACE = "Replace it, or leave out both of its images."


def check_folder(
    sequence: str | Path | Sequence,
    *,
    prompts: Iterable[Prompt] = (),
    format: str | None = None,
    depth_scale: float | None = None,
    config: Config | None = None,
    sizes: Mapping[str, Any] | None = None,
    picture: Path | None = None,
) -> list[Finding]:
    """What is right and wrong with a sequence, in the order in which it should be mended.

    prompts  clicks, for a sequence without masks: the built-in segmenter makes its first ones
    config   whose limits count (default: the preset ``default``)
    sizes    how long objects are known to be, cm: what was measured is compared with it
    picture  file that the first masks are drawn into, as ``first_masks.png`` of a run

    Files that are missing or cannot be read are findings too, all that can be told without each other.
    """
    config, prompts = config or preset(), tuple(prompts)
    try:
        opened = open_sequence(sequence, format, depth_scale, gaps=True)
    except P2PError as error:
        own = isinstance(sequence, str | Path) and format in (None, "folder")
        if own and (side_by_side := _pairs_by_name(Path(str(sequence)).expanduser())):
            return [side_by_side]
        return (_files(Path(str(sequence)).expanduser()) if own else []) or [_unreadable("files", error)]
    sequence = opened
    frames, masks, wrong = _looked_at(sequence)
    if not frames:
        return wrong
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", Doubt)
        try:
            firsts = clicked_masks(sequence, prompts, config) if prompts else _first_masks(sequence, config)
            check_depths(sequence, prompts)
            _doubt_boxes(sequence, prompts, firsts, config)
        except P2PError as error:
            firsts = {}
            wrong.append(_unreadable("clicks" if prompts else "masks", error))
    if picture is not None and firsts:
        drawn = drawing.FirstMasks(picture, prompts)
        for first in {frame.index: frame for frame, _ in firsts.values()}.values():
            drawn.add(first, {name: mask for name, (frame, mask) in firsts.items() if frame.index == first.index})
    unprompted = "" if prompts else "Objects are called as the masks are, or as prompts call them: --prompts FILE."
    sizes_m = lengths_m(sizes, dict.fromkeys(prompt.name for prompt in prompts) or sequence.objects, unprompted)
    size = f"{sequence.format}: {len(sequence)} images of {sequence.camera.width}x{sequence.camera.height}"
    scale = getattr(sequence, "depth_scale", 1.0)
    findings = [*wrong, Finding("files", Level.OK, f"{size}, {len(frames)} looked at"), _camera(sequence.camera)]
    pairs = [(f, after) for f in frames if (after := _readable(sequence, f.index + 1)) is not None]
    sized = [_size(name, m, *firsts[name], sequence.camera) for name, m in sizes_m.items() if name in firsts]
    depth, unit = _depth(frames, scale), None
    if depth.level is not Level.WRONG:
        unit = _beyond(firsts, sized, config, scale) or _uncounted(depth, frames, firsts, sized, config, scale)
    of_objects = unit is not None and unit.name != depth.name
    about_depth = [depth, unit] if unit is not None and of_objects else [unit or depth]
    findings += [_times(sequence), _repeated(pairs), *about_depth, _scale(pairs)]
    if about_depth[-1].level is Level.WRONG:
        return findings  # what follows would only be its consequences
    findings += [_registered(frames, pairs), _truth(sequence)]
    if not firsts and not prompts:  # of prompts it is said already what is wrong with them
        findings.append(_no_masks(sequence, any(masks), config))
    for name, (frame, mask) in firsts.items():
        if mask.sum() < config.lifecycle.min_mask_px:
            findings.append(_nothing_there(name, frame, mask, config))
            continue
        if name in sizes_m:
            findings += [of for of in sized if of.name == f"{name}: size"]
        elif wrong_size := odd_size(mask, distance_m(frame, mask), sequence.camera, scale):
            findings.append(Finding(f"{name}: size", Level.LOOK, *wrong_size))
        others = [(f, m[name]) for f, m in zip(frames, masks) if name in m and not prompts]
        if not of_objects or np.isnan(distance_m(frame, mask)):
            findings.append(_range(name, frame, mask, config, scale))
        said = [of.message for of in doubts if isinstance(of.message, Doubt) and of.message.object == name]
        findings += [Finding(f"{name}: clicks", Level.LOOK, str(doubt)) for doubt in said]
        findings += [_rim(name, [(frame, mask), *others], config), _points(name, frame, mask, config)]
        findings += [*_misspelt(name, firsts), *_later(name, frame, prompts)]
    return findings if unit is None else _blamed(unit, findings)


def _looked_at(sequence: Sequence) -> tuple[list[Frame], list[Mapping[str, np.ndarray]], list[Finding]]:
    """Some frames with their masks, and what is wrong with files."""
    frames, masks = list[Frame](), list[Mapping[str, np.ndarray]]()
    whole, wrong = _whole(sequence)
    looked_at, faults = evenly(whole, FRAMES).tolist(), list[tuple[P2PError, str]]()
    for i in looked_at:
        try:
            frames.append(sequence.frame(i))
        except P2PError as error:
            faults.append((error, f"{_REPLACE} {images.SKIP_BAD}"))
            continue
        masks.append({})
        try:
            masks[-1] = sequence.masks(i) or {}
        except P2PError as error:
            faults.append((error, ""))
    return frames, masks, [*wrong, *_once(faults, len(looked_at))]


def _blamed(unit: Finding, findings: list[Finding]) -> list[Finding]:
    """What is wrong by metres, where their unit is in doubt, is its consequence: the unit is to be mended first."""
    follow = [f for f in findings if f.level is Level.WRONG and f.name.endswith(_BY_METRES)]
    after = {id(f): replace(f, level=Level.LOOK, fix=f"If the unit is right ({unit.name}): {f.fix}") for f in follow}
    first = {id(unit): replace(unit, level=Level.WRONG)} if follow else {}
    return [(first | after).get(id(f), f) for f in findings]


def _pairs_by_name(folder: Path) -> Finding | None:
    """Whether colour and depth images lie side by side, as 7-Scenes ships them, which no layout has."""
    if not (any(folder.glob("*.color.*")) and any(folder.glob("*.depth.*"))):
        return None
    fix = "Put the colour images into rgb/, those of depth, registered to colour, into depth/, and write cam_K.txt."
    return Finding("files", Level.WRONG, f"{folder}: pairs of *.color.* and *.depth.*, as in 7-Scenes", fix)


def _unreadable(name: str, error: P2PError, otherwise: str = "", more: str = "") -> Finding:
    """An error as a finding; ``otherwise`` is what to do where it has no advice of its own."""
    if isinstance(error, BadInput):
        text, advice = f"{error.name}: got {error.got}, expected {error.expected}", error.fix
    elif isinstance(error, MissingData):
        text, advice = f"{error.name}: {error.expected}", error.fix
    else:
        text, advice = str(error), ""
    return Finding(name, Level.WRONG, f"{text}{more}", advice.replace(images.SEE_CHECK, "").strip() or otherwise)


def _once(faults: Iterable[tuple[P2PError, str]], looked_at: int) -> Iterator[Finding]:
    """Errors of files, each with what to do otherwise; those that differ in numbers alone are one finding."""
    alike: dict[str, list[tuple[P2PError, str]]] = {}
    for error, otherwise in faults:
        alike.setdefault(re.sub(r"\d+", "N", str(error)), []).append((error, otherwise))
    for (first, otherwise), *others in alike.values():
        names = [Path(getattr(error, "name", "")).name for error, _ in others]
        more = (
            f"; {len(names)} more like it of the {looked_at} frames looked at: {listed(names, _LISTED)}"
            if names
            else ""
        )
        yield _unreadable("files", first, otherwise=otherwise, more=more)


def _whole(sequence: Sequence) -> tuple[np.ndarray, list[Finding]]:
    """Frames (K,) whose files are there to their end, of all, not only of those that are looked at; and the others."""
    rgb, depth = getattr(sequence, "rgb", ()), getattr(sequence, "depth", ())
    missing = [path for path in depth if not path.is_file()]
    torn = [path for path in (*rgb, *depth) if path.is_file() and images.is_cut_off(path)]
    apart = numbered_apart([path for path in depth if path not in missing], rgb) if missing else ""
    back = f"Put them back. {images.SKIP_BAD}{' Or none is, and both are counted apart: ' * bool(apart)}{apart}"
    found = [(missing, f"{len(missing)} of {len(depth)} depth images are missing", back)] * bool(missing)
    again = f"Copy them again. {images.SKIP_BAD}"
    found += [(torn, f"{len(torn)} of {len(rgb) + len(depth)} images end too early", again)] * bool(torn)
    lost = {*missing, *torn}
    whole = [i for i in range(len(sequence)) if not lost or not lost & {rgb[i], depth[i]}]
    return np.array(whole, int), [
        Finding("files", Level.WRONG, f"{what}: {listed(paths, _LISTED)}", fix) for paths, what, fix in found
    ]


def _readable(sequence: Sequence, i: int) -> Frame | None:
    """A frame; None where there is none, or its files cannot be read."""
    with suppress(P2PError):
        return sequence.frame(i) if i < len(sequence) else None
    return None


def _files(folder: Path) -> list[Finding]:
    """Each file of a folder of one's own that is missing or wrong; none where it is in another layout."""
    if not any((folder / part).exists() for part in ("rgb", "depth", "cam_K.txt")):
        return []
    with suppress(P2PError):
        if recognise(folder) != "folder":
            return []
    wrong: list[Finding] = []

    def look(name: str, fix: str, read: Callable[[], Any]) -> Any:
        try:
            return read()
        except P2PError as error:
            wrong.append(_unreadable(name, error, otherwise=fix))

    def first(part: str, suffixes: tuple[str, ...], read: Callable[[Path], np.ndarray]) -> None:
        files = look(
            f"{part}/",
            _PUT[part],
            lambda: images.list_files(folder / part, suffixes, f"{part} images"),
        )
        if files:
            look(f"{part}/", _REPLACE, lambda: read(files[0]))

    first("rgb", images.COLOUR, images.read_rgb)
    first("depth", images.DEPTH, images.read_raw_depth)
    if not wrong:
        look("depth/", "", lambda: paired_images(folder))
    camera = next((name for name in ("cam_K.txt", *INTRINSICS) if (folder / name).is_file()), "cam_K.txt")
    look(camera, "", lambda: Camera.from_K(read_K(folder)[0], 1, 1, camera))
    for path in (path for path in (folder / "times.txt", folder / "depth_scale.txt") if path.exists()):
        look(path.name, "It is optional: correct it or remove it.", partial(images.read_numbers, path, "numbers"))
    return wrong


def _later(name: str, first: Frame, prompts: Iterable[Prompt]) -> list[Finding]:
    """That corrections are not looked at: what they make of a mask depends on how the object was followed."""
    later = sorted({prompt.frame for prompt in prompts if prompt.name == name and prompt.frame > first.index})
    text = f"in {len(later)} later frames, from frame {later[0]} on, not looked at here" if later else ""
    fix = "p2p run draws the masks that they make into its first_masks.png."
    return [Finding(f"{name}: corrections", Level.OPTIONAL, text, fix)] if later else []


def _camera(camera: Camera) -> Finding:
    """Whether K belongs to images of this size."""
    if wrong := odd_camera(camera):
        return Finding("camera", Level.WRONG, *wrong)
    text = f"{sees(camera)}; images cannot tell whether fx and fy are right: a known size can, {_KNOWN}"
    return Finding("camera", Level.OK, text)


def _size(name: str, known_m: float, frame: Frame, mask: np.ndarray, camera: Camera) -> Finding:
    """Whether what a mask holds is as long as the object is known to be; a mask that is cut off tells nothing."""
    if mask[[0, -1]].any() or mask[:, [0, -1]].any():
        text = f"{100 * known_m:g} cm given; its mask in frame {frame.index} reaches the image's border"
        return Finding(f"{name}: size", Level.OPTIONAL, text, "p2p run --size measures it in every frame.")
    of = Lengths(known_m, measured_m := mask_length_m(frame, mask, camera))
    if text := of.doubt:
        fix = "Look at the mask first; if it holds the object alone, mend K or --depth-scale."
        return Finding(f"{name}: size", Level.LOOK, f"{text} (frame {frame.index})", fix)
    if not np.isfinite(measured_m):
        text = f"{100 * known_m:g} cm given; its mask in frame {frame.index} has too little depth to be measured"
        return Finding(f"{name}: size", Level.OPTIONAL, text)
    return Finding(f"{name}: size", Level.OK, f"{of.fit} (frame {frame.index})")


def _times(sequence: Sequence) -> Finding:
    """Whether the times are seconds, and without holes."""
    steps_s = np.diff(sequence.times_s)
    if not len(steps_s):
        return Finding("times", Level.LOOK, "a single image", "Tracking needs a video.")
    usual_s, widest = float(np.median(steps_s)), int(steps_s.argmax())
    text = f"{1 / usual_s:.3g} images per second, {sequence.times_s[-1] - sequence.times_s[0]:.1f} s"
    own = sequence.path is None or (sequence.path / "times.txt").is_file()
    if not own and np.array_equal(sequence.times_s, np.arange(len(sequence)) / DEFAULT_HZ):
        text += "; assumed, since there is no times.txt (seconds, one a line)"
    if not RATES_HZ[0] <= 1 / usual_s <= RATES_HZ[1]:
        unit = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
        guess = next((f" These look like {n}." for k, n in unit.items() if 1 <= k / usual_s <= RATES_HZ[1]), "")
        text = f"{usual_s:.3g} s between images: {1 / usual_s:.3g} per second"
        return Finding("times", Level.WRONG, text, f"times.txt holds seconds, one a line.{guess}")
    if steps_s[widest] > GAP * usual_s:
        text += f", but {steps_s[widest]:.2g} s between frames {widest} and {widest + 1}"
        fix = "Images are missing there: what moved meanwhile has to be found again."
        return Finding("times", Level.LOOK, text, fix)
    return Finding("times", Level.OK, text)


def _scale(pairs: list[tuple[Frame, Frame]]) -> Finding:
    """Whether depth has one unit throughout."""
    moves = moving_scale(pairs)
    fix = "Take depth as the camera measured it, in one unit, not scaled image by image."
    return Finding.whether(not moves, "scale", moves or "depth keeps its scale from image to image", fix)


def _truth(sequence: Sequence) -> Finding:
    """Whether there is anything to score a run against: frames with a pose, and with the object in sight."""
    masks_px = [sequence.visible_px(i) for i in range(len(sequence))] if sequence.truth else []
    seen = []
    for name, of in sequence.truth.items():
        posed = np.isfinite(of.T_cam_model).all((1, 2))
        shown = [px is None or px.get(name, 0) >= MIN_VISIBLE_PX for px in masks_px]
        count, said = int((posed & of.labelled & shown).sum()), f"{name} in {posed.sum()} images"
        seen.append(said if count == posed.sum() else f"{said}, in sight in {count} of them")
    none = f"none{no_truth_said(sequence)}, so that a run is not scored"
    return Finding("truth", Level.OK, "; ".join(seen) or none)


def _repeated(pairs: list[tuple[Frame, Frame]]) -> Finding:
    """Whether images are copies of the one before: a recorder that was faster than its camera."""
    copies = [a.index for a, b in pairs if np.array_equal(a.rgb, b.rgb)]
    frozen = [a.index for a, b in pairs if a.depth_m.any() and np.array_equal(a.depth_m, b.depth_m)]
    if max(len(copies), len(frozen)) > REPEATED_SHARE * len(pairs):
        what, of = ("colour", copies) if len(copies) >= len(frozen) else ("depth", frozen)
        text = f"{len(of)} of {len(pairs)} {what} images equal the next one, that of frame {of[0]} for one"
        return Finding("motion", Level.LOOK, text, "Record each image once, with the time at which it was taken.")
    return Finding("motion", Level.OK, "every image looked at differs from the next")


def _depth(frames: list[Frame], scale: float) -> Finding:
    """Whether depth is in metres once the scale is applied."""
    known = [frame.depth_m[frame.depth_m > 0] for frame in frames]
    share = float(np.mean([len(d) / f.depth_m.size for d, f in zip(known, frames)]))
    if not share:
        return Finding("depth", Level.WRONG, "no measurement anywhere", "Look at the files in depth/: all are 0.")
    every_m = np.concatenate(known)
    median_m = float(np.median(every_m))
    text = f"{median_m:.3g} m in the middle, {100 * share:.0f} % of the pixels measured"
    if not NEAREST_M <= median_m <= FARTHEST_M:
        clipped = float((every_m == every_m.max()).mean())
        if median_m > FARTHEST_M and clipped > CLIPPED_SHARE:
            text = f"{text}; {100 * clipped:.0f} % of them are cut off at {every_m.max():.3g} m, the most that fits"
            fix = "Export the depth again, as 16-bit millimetres: no scale restores what was cut off."
            return Finding("depth", Level.WRONG, text, fix)
        fix = "Say what a unit is with --depth-scale or depth_scale.txt (millimetres: 0.001, metres: 1)."
        fix += f" {guess}." if (guess := likely_units(median_m, scale)) else ""
        return Finding("depth", Level.WRONG, f"{text}: the unit is another", fix)
    if share < MEASURED_SHARE / 2:
        fix = "Keep the sensor's least distance, and out of the sun; glass, mirrors and black things have no depth."
        return Finding("depth", Level.LOOK, text, fix)
    return Finding("depth", Level.OK, text)


def _uncounted(
    depth: Finding, frames: list[Frame], firsts: FirstMasks, sizes: Iterable[Finding], config: Config, scale: float
) -> Finding | None:
    """The finding on depth of which hardly any counts, or whose near part is nowhere near: all that tells a unit here.

    Of masks, what they hold tells more, and a size that fits everything: beside them only a scene that is near as a
    whole is doubted.
    """
    if firsts:
        wrong = None if any(of.fine for of in sizes) else near_scene(frames, scale)
    else:
        wrong = hardly_counts(frames, config.depth, scale) or odd_scene(frames, scale)
    return None if wrong is None else replace(depth, level=Level.LOOK, text=f"{depth.text}, {wrong[0]}", fix=wrong[1])


def _registered(frames: list[Frame], pairs: list[tuple[Frame, Frame]]) -> Finding:
    """Whether depth was registered to the colour camera, and is of its moment in pairs of neighbouring images."""
    name, found = "registration", misfit(frames)
    if found is None:
        fix = "Be sure that the camera's software aligns them: what is not aligned gives poses that are wrong or lost."
        return Finding(
            name,
            Level.OPTIONAL,
            "too few edges in depth and colour, or too much alike, to tell whether they agree",
            fix,
        )
    if found.doubt is not None:
        text, fix = found.doubt
        return Finding(name, Level.WRONG, f"depth is {text}", fix)
    for before, after in pairs:
        lag = DepthLag()
        lag.moved(before)
        if lag.moved(after) is not None:
            text, fix = lag.doubt
            return Finding(name, Level.LOOK, f"depth and colour are {text} in frame {after.index}", fix)
    return Finding(name, Level.OK, "edges of depth lie on edges of colour")


def _no_masks(sequence: Sequence, drawn: bool, config: Config) -> Finding:
    """Nothing to begin with: no masks at all, or masks that hold no object."""
    fix = f"Make clicks with p2p click and give them with --prompts, or put masks into {sequence.path}/masks."
    if not drawn:
        return Finding("masks", Level.LOOK, "none", fix)
    text = f"none that shows an object: no object has {config.lifecycle.min_mask_px} pixels in any image"
    return Finding("masks", Level.WRONG, text, fix)


def _nothing_there(name: str, frame: Frame, mask: np.ndarray, config: Config) -> Finding:
    """A click at which the segmenter found no object to speak of."""
    count, needed = int(mask.sum()), config.lifecycle.min_mask_px
    what = f"only {count} pixels were segmented" if count else "nothing was segmented"
    text = f"{what} at the clicks on it in frame {frame.index}; {needed} pixels are needed"
    return Finding(f"{name}: mask", Level.WRONG, text, "Click again, near the centre of the object: p2p click.")


def _doubt_boxes(sequence: Sequence, prompts: Iterable[Prompt], firsts: FirstMasks, config: Config) -> None:
    """Warn of boxes and masks that make an object longer than its first mask; what later clicks make, a run knows."""
    for prompt in prompts:
        said = prompt.box_px is not None or (prompt.mask is not None and prompt.mask.any())
        if not said or prompt.frame <= firsts[prompt.name][0].index:
            continue
        (later,) = clicked_masks(sequence, [prompt], config).values()
        first_m = whole_length_m(*firsts[prompt.name], sequence.camera)
        doubt_growth(prompt.name, prompt.frame, mask_length_m(*later, sequence.camera), np.array([first_m]))


def _misspelt(name: str, firsts: FirstMasks) -> list[Finding]:
    """Whether an object that comes later is an earlier one, to be corrected, whose name was misspelt."""
    first, _ = firsts[name]
    if meant := did_you_mean(name, [n for n, (frame, _) in firsts.items() if frame.index < first.index]):
        return [Finding(f"{name}: name", Level.LOOK, f"a new object from frame {first.index} on", meant)]
    return []


def _beyond(firsts: FirstMasks, sizes: Iterable[Finding], config: Config, scale: float) -> Finding | None:
    """The one finding of objects that are all out of range, or far away; that they are is told by a size that fits."""
    away_m = {name: m for name, first in firsts.items() if np.isfinite(m := distance_m(*first))}
    if not away_m or (wrong := beyond(away_m, config.depth, scale)) is None:
        return None
    level = Level.WRONG if uncounted(away_m, config.depth) else Level.LOOK
    if level is Level.LOOK and any(of.fine for of in sizes):
        return None
    name = next(iter(away_m))
    frame, mask = firsts[name]
    return Finding(f"{name}: depth", level, f"{wrong[0]}; {int(mask.sum())} pixels in frame {frame.index}", wrong[1])


def _range(name: str, frame: Frame, mask: np.ndarray, config: Config, scale: float) -> Finding:
    """Whether an object is where depth counts, and measured."""
    share = float((frame.depth_m[mask] > 0).mean())
    if share < MEASURED_SHARE:
        fix = "Dark, shiny and transparent things have none; change the light or the distance, or spray it matt."
        text = f"only {100 * share:.0f} % of its pixels in frame {frame.index} have a depth"
        return Finding(f"{name}: depth", Level.WRONG if share < 0.1 else Level.LOOK, text, fix)
    text = f"{distance_m(frame, mask):.2f} m away, {int(mask.sum())} pixels in frame {frame.index}"
    wrong = _beyond({name: (frame, mask)}, (), config, scale)  # one that is far away beside others is
    return wrong if wrong is not None and wrong.level is Level.WRONG else Finding(f"{name}: depth", Level.OK, text)


def _rim(name: str, seen: list[tuple[Frame, np.ndarray]], config: Config) -> Finding:
    """Whether an object's masks hold background; the first of them also whether it is background altogether."""
    first, mask = seen[0]
    seen = [(frame, mask) for frame, mask in seen if mask.sum() >= config.lifecycle.min_mask_px]
    shares = np.array([background_share(mask, frame.depth_m) for frame, mask in seen])
    if np.isnan(shares).all():
        return Finding(f"{name}: mask", Level.OPTIONAL, "no depth along its rim to judge it by")
    typical = float(np.nanmedian(shares))
    of = f" (median of {len(shares)} masks)" if len(shares) > 1 else ""
    text = f"{100 * typical:.0f} % of its rim lies on the background{of}"
    if typical > RIM_SHARE:
        worst = seen[int(np.nanargmax(shares))][0].index
        fix = f"Draw it to the object's edge or a little inside; frame {worst} is the worst."
        return Finding(f"{name}: mask", Level.WRONG, text, fix)
    depth_m = first.depth_m[mask & (first.depth_m > 0)]
    near_m, away_m, far_m = np.percentile(depth_m, [2, 50, 98]) if len(depth_m) else (0.0, 0.0, 0.0)
    large, deep_m = mask.mean(), far_m - near_m  # without its outermost pixels
    if large > LARGE_SHARE or deep_m > DEEP_SHARE * away_m:
        text = f"it covers {100 * large:.0f} % of the image, over {deep_m:.2f} m of depth; {text}"
        fix = (
            "If a table or a wall is in it, click near the object's centre, or draw the mask tighter; else it is fine."
        )
        return Finding(f"{name}: mask", Level.LOOK, text, fix)
    return Finding(f"{name}: mask", Level.OK, text)


def _points(name: str, frame: Frame, mask: np.ndarray, config: Config) -> Finding:
    """Whether an object has anything to track: points that can be lifted, with a contrast of their own."""
    detector = make_detector(DEFAULT_DETECTOR, config.sampling, np.random.default_rng(config.seed))
    found = detector.detect(frame, usable_region(frame, mask, config.depth.edge_m, config.depth.narrow))
    taken = choose(found, np.zeros((0, 2)), config.sampling.max_visible, config.sampling)
    u, v = np.rint(found.uv_px[taken]).astype(int).T
    contrast = _contrast(frame.rgb, config.tracking.window_px)[v, u]
    count, needed = int((contrast >= config.tracking.textureless_contrast).sum()), config.lifecycle.return_inliers
    text = f"places to track in frame {frame.index}: {count}"
    if count < needed:
        fix = "Its surface alone carries the pose; expect doubts. Come nearer, light it better, show a textured side."
        level = Level.LOOK if count >= POSED else Level.WRONG
        return Finding(f"{name}: points", level, f"{text}; {needed} are needed to find it again", fix)
    return Finding(f"{name}: points", Level.OK, text)


def _contrast(rgb: np.ndarray, side_px: int) -> np.ndarray:
    """(H, W) standard deviation of brightness around each pixel, in grey levels."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean, square = cv2.blur(gray, (side_px, side_px)), cv2.blur(gray * gray, (side_px, side_px))
    return np.sqrt(np.maximum(square - mean * mean, 0))


def _first_masks(sequence: Sequence, config: Config) -> FirstMasks:
    """Each object's first mask that is large enough to start from, with its frame."""
    firsts: FirstMasks = {}
    for i in range(len(sequence)):
        masks = sequence.masks(i)
        if masks is None or firsts.keys() >= set(sequence.objects):
            break
        for name in sorted(masks.keys() & set(sequence.objects) - firsts.keys()):
            if masks[name].sum() < config.lifecycle.min_mask_px:
                continue
            if (frame := _readable(sequence, i)) is not None:
                firsts[name] = frame, masks[name]
    return firsts
