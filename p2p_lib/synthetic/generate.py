"""Writes a scenario as a YCBMultiTrack folder, with exact poses and masks; cached by its configuration."""

from __future__ import annotations

import fcntl
import hashlib
import inspect
import json
import os
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData, did_you_mean
from p2p_lib.core.files import check_new
from p2p_lib.core.paths import cache_dir
from p2p_lib.core.progress import progress_bar
from p2p_lib.datasets.bop import write_models, write_scene
from p2p_lib.datasets.sequence import SYNTHETIC, open_sequence
from p2p_lib.datasets.ycbmultitrack import write_truth
from p2p_lib.synthetic.exposure import exposed
from p2p_lib.synthetic.noise import (
    NOISE,
    Sensor,
    in_motion,
    kept_frames,
    measured_colour,
    measured_depth,
    measured_mask,
)
from p2p_lib.synthetic.render import Rendering
from p2p_lib.synthetic.scenarios import SCENARIOS
from p2p_lib.synthetic.scene import Scenario
from p2p_lib.synthetic.shadows import shadowed
from p2p_lib.synthetic.shapes import Mesh

_MODEL_POINTS = 6000
_PER_OBJECT = ("masks", "models")
_DONE = "scenario.json"


def scenario_dir(name: str, seed: int = 0, *, progress: bool = True, **overrides: object) -> Path:
    """The folder of a synthetic sequence in the YCBMultiTrack layout, rendered first if the cache lacks it.

    ``overrides`` are the scenario's own parameters (``contrast``, ``frames``) or fields of
    :class:`~p2p_lib.synthetic.noise.Sensor`. With ``progress`` a terminal shows how far rendering is. Raises
    :class:`BadInput` for an unknown name or parameter.
    """
    own, sensor = _settings(name, seed, overrides)
    settings = {"name": name, "seed": int(seed), **own, "sensor": asdict(sensor), "generator": generator_version()}
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]
    folder = cache_dir() / "synthetic" / f"{name}-{key}"
    if (folder / _DONE).is_file():
        return folder
    with _alone(folder) as unfinished:
        if not (folder / _DONE).is_file():
            shutil.rmtree(folder, ignore_errors=True)
            title, shown = f"rendering synthetic/{name}", progress and sys.stderr.isatty()
            write_scenario(unfinished, SCENARIOS[name](seed, **own), sensor, seed, title, shown)
            (unfinished / _DONE).write_text(json.dumps(settings, indent=1, sort_keys=True))
            os.rename(unfinished, folder)
    return folder


def write_scenario(
    folder: Path,
    scenario: Scenario,
    sensor: Sensor,
    seed: int,
    title: str = "rendering",
    progress: bool = False,
    stop: int | None = None,
) -> None:
    """Renders a scenario into ``folder``, which is made: colour, depth, and the truth per labelled body.

    stop  one past the last frame; those before it are as they are in the whole film
    """
    labelled = {k: body for k, body in enumerate(scenario.bodies, 1) if body.labelled}
    for name in ("rgb", "depth", *(f"{kind}/{body.name}" for kind in _PER_OBJECT for body in labelled.values())):
        (folder / name).mkdir(parents=True, exist_ok=True)
    still = bool((scenario.T_world_cam == scenario.T_world_cam[0]).all())
    work = partial(_write_frame, folder, scenario, sensor, seed, scenario.empty(0) if still else None)
    with ThreadPoolExecutor(min(8, len(os.sched_getaffinity(0)))) as pool:
        frames = kept_frames(scenario.frames, sensor, np.random.default_rng([seed, 5]))
        frames = frames[frames < (scenario.frames if stop is None else stop)]
        done = pool.map(work, frames.tolist())
        visible = list(progress_bar(title, len(frames), shown=progress, iterable=done, leave=False))
    np.savetxt(folder / "cam_K.txt", scenario.camera.K, fmt="%.6f")
    np.savetxt(folder / "times.txt", frames / scenario.fps, fmt="%.6f")
    for k, body in labelled.items():
        T_cam_model = se3.inverse(scenario.T_world_cam[frames]) @ body.T_world_model[frames]
        uv_px = scenario.camera.project(se3.transform(T_cam_model, body.mesh.vertices))
        labelled_in, inside = (
            np.array([k in seen for seen in visible]),
            np.asarray(scenario.camera.inside(uv_px).any(1)),
        )
        write_truth(folder, body.name, [f"{t:06d}" for t in frames], T_cam_model, labelled_in, inside)
        points, _ = body.mesh.sample(_MODEL_POINTS, np.random.default_rng(k))
        np.savetxt(folder / f"models/{body.name}/points.xyz", points, fmt="%.6f")
        _write_obj(folder / f"models/{body.name}", body.mesh)


def write_sequence(
    name: str,
    out: str | Path,
    seed: int = 0,
    noise: str = "realsense",
    models: str | Path = "",
    bop: bool = False,
    progress: bool = False,
    stop: int | None = None,
) -> Path:
    """What ``p2p synth`` does: a scenario as a YCBMultiTrack folder ``out``, which must not hold anything yet.

    noise   a key of :data:`~p2p_lib.synthetic.noise.NOISE`
    models  a folder of YCB models, for the scenarios that take them
    bop     writes the BOP scene ``out/bop/test/000001`` and its models besides
    stop    one past the last frame

    ``scenario.json`` says what it is made of. Raises :class:`BadInput` for what does not fit.
    """
    out = Path(out).expanduser()
    own, _ = _settings(name, seed, {"models": str(models)} if models else {})
    if noise not in NOISE:
        raise BadInput("noise", repr(noise), "one of " + ", ".join(NOISE))
    if stop is not None and stop < 1:
        raise BadInput("stop", stop, "one past the last frame, from 1")
    check_new(out)
    scenario = SCENARIOS[name](seed, **own)
    write_scenario(out, scenario, NOISE[noise], seed, f"rendering {name}", progress, stop)
    made = {"name": name, "seed": seed, "noise": noise, "sensor": asdict(NOISE[noise]), "objects": scenario.objects}
    made |= {} if stop is None else {"stop": stop}
    (out / _DONE).write_text(json.dumps(made | {"generator": generator_version()}, indent=1, sort_keys=True) + "\n")
    if bop:
        ids = write_scene(out / "bop/test/000001", open_sequence(out, format="ycbmultitrack"))
        write_models(out / "bop/models", {k: out / f"models/{name}/textured.obj" for name, k in ids.items()})
    return out


def generator_version() -> str:
    """A hash of the generator's own source: whatever changes it makes new folders."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"\0".join(f.read_bytes() for f in files)).hexdigest()[:12]


def photograph(
    scenario: Scenario, sensor: Sensor, seed: int, t: int, room: Rendering | None = None
) -> tuple[np.ndarray, np.ndarray, Rendering]:
    """Frame ``t`` as the sensor delivers it: rgb (H, W, 3) uint8, depth_m (H, W), and the exact image.

    ``room`` is the empty scene at this frame's camera pose, where the caller already has it.
    """
    rng = np.random.default_rng([seed, 2, t])
    if room is not None and scenario.light.shadow:
        # As they are in the middle of the exposure: the edges of a shadow are soft as it is.
        room = shadowed(room, scenario.placed(t), scenario.camera, scenario.T_world_cam[t], scenario.light)
    exact = scenario.rendered(t, room)
    own = sensor.motion_blur * scenario.shutter_s * scenario.fps
    rgb, during = exposed(scenario, t, min(max(sensor.shutter_share, own), 1.0), int(sensor.blur_samples), exact, room)
    phase = np.random.default_rng([seed, 3]).uniform(0, 2 * np.pi)
    gain = 1 + sensor.exposure * np.sin(2 * np.pi * t / (4 * scenario.fps) + phase)
    depth_m = measured_depth(exact, scenario.camera, sensor, rng)
    if own > 0 and during:
        # The imagers of depth have a bright projector of their own: half the time is enough.
        half = during[len(during) // 4 : -(len(during) // 4) or None]
        depth_m = in_motion(depth_m, half, sensor, np.random.default_rng([seed, 7, t]))
    return measured_colour(rgb, sensor, gain, rng), depth_m, exact


def _write_frame(
    folder: Path, scenario: Scenario, sensor: Sensor, seed: int, room: Rendering | None, t: int
) -> set[int]:
    """Renders and writes frame t; returns the labels that are visible in it."""
    rgb, depth_m, exact = photograph(scenario, sensor, seed, t, room)
    _save(folder / f"rgb/{t:06d}.jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    depth_mm = np.minimum(np.round(depth_m * 1000), 65534).astype(np.uint16)
    _save(folder / f"depth/{t:06d}.png", depth_mm, [cv2.IMWRITE_PNG_COMPRESSION, 2])
    for k, body in enumerate(scenario.bodies, 1):
        if body.labelled:
            mask = measured_mask(exact.label == k, sensor, np.random.default_rng([seed, 6, t, k]))
            where = folder / f"masks/{body.name}/{t:06d}.png"
            _save(where, mask.astype(np.uint8) * 255, [cv2.IMWRITE_PNG_COMPRESSION, 2])
    return set(np.unique(exact.label).tolist())


def _save(path: Path, image: np.ndarray, options: list[int]) -> None:
    if not cv2.imwrite(str(path), image, options):
        raise OSError(f"{path} could not be written: is the disk full?")


def _write_obj(folder: Path, mesh: Mesh) -> None:
    """``textured.obj`` with its material and texture."""
    import trimesh
    from PIL import Image

    corners = np.arange(mesh.faces.size)
    material = trimesh.visual.material.SimpleMaterial(Image.fromarray(mesh.texture), name="texture_map")
    visual = trimesh.visual.TextureVisuals(mesh.uv.reshape(-1, 2), material)
    loose = trimesh.Trimesh(mesh.vertices[mesh.faces.ravel()], corners.reshape(-1, 3), visual=visual, process=False)
    loose.export(folder / "textured.obj", digits=6)


def _settings(name: str, seed: int, overrides: dict) -> tuple[dict, Sensor]:
    """The scenario's own parameters and the sensor; unknown names and keys are refused."""
    if name not in SCENARIOS:
        meant = did_you_mean(name, SCENARIOS, SYNTHETIC)
        known = "one of " + ", ".join(SYNTHETIC + k for k in sorted(SCENARIOS))
        raise BadInput("synthetic sequence", f"{name!r} ({meant})" if meant else repr(name), known)
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise BadInput(f"{SYNTHETIC}{name} seed", repr(seed), "a whole number, 0 or above")
    taken = list(inspect.signature(SCENARIOS[name]).parameters.values())[1:]
    own = {p.name: p.default for p in taken if p.kind is not p.KEYWORD_ONLY}
    keys = [*own, *(f.name for f in fields(Sensor))]
    for key in overrides.keys() - keys:
        raise BadInput(f"{SYNTHETIC}{name} parameter", repr(key), "one of " + ", ".join(keys))
    sensor = Sensor(**{k: v for k, v in overrides.items() if k not in own})
    return own | {k: v for k, v in overrides.items() if k in own}, sensor


@contextmanager
def _alone(folder: Path) -> Iterator[Path]:
    """An empty folder beside ``folder`` to work in, while no other process makes the same; removed if work fails."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = open(folder.with_name(f".{folder.name}.lock"), "w")
    except OSError as error:
        fix = "Set P2P_CACHE to a folder that can be written."
        raise MissingData(f"cache folder {folder.parent}", f"cannot be written ({error.strerror})", fix) from error
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        unfinished = folder.with_name(f".{folder.name}.unfinished")
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        try:
            yield unfinished
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
