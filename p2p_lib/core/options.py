"""The options of a run, declared once: they serve ``p2p run``, Python, plans of benchmarks and ``run.json``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

from p2p_lib.core import config as configuration
from p2p_lib.core.backends import (
    ALIASES,
    DEFAULT_DETECTOR,
    DEFAULT_SEGMENTER,
    DEFAULT_TRACKER,
    DETECTORS,
    SEGMENTERS,
    TRACKERS,
    is_segmenter,
)
from p2p_lib.core.config import Config
from p2p_lib.core.errors import BadInput
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.paths import full, named_path


def pairs(given: Iterable[str], option: str, form: str) -> dict[str, str]:
    """``["a=1", ...]``, as an option collects them, to ``{"a": "1", ...}``; ``form`` is how each is written."""
    found = {}
    for item in given:
        name, equals, value = (part.strip() for part in item.partition("="))
        if not (name and equals and value):
            raise BadInput(option, repr(item), form)
        found[name] = value
    return found


def names(given: str | None) -> tuple[str, ...] | None:
    """``"a,b"`` to ``("a", "b")``; None where nothing is named."""
    return tuple(part.strip() for part in (given or "").split(",") if part.strip()) or None


def _typed(help: str, *, flag: str = "", read: Callable[[Any], Any] | None = None, **how: Any) -> dict[str, Any]:
    """How a field is typed: ``read`` makes its value of what ``argparse.add_argument(flag, **how)`` collects."""
    return {"flag": flag, "read": read, "how": {"help": help, **how}}


_PRESET = _typed("paper or default: parameters only, never backends")
_CONFIG = _typed("TOML file with [stage] key = value", flag="--config", type=Path, metavar="FILE")
_SET = _typed(
    "change one parameter; repeatable",
    flag="--set",
    read=partial(pairs, option="--set", form="stage.key=value"),
    action="append",
    metavar="STAGE.KEY=VALUE",
)
_SEED = _typed("of every random choice of the tracker (default 0); a scene's: synthetic/NAME@N", type=int, metavar="N")
_DEVICE = _typed("where surfaces are kept and fused: cpu (default), cuda or cuda:N")
_OWN = "or your own as package.module:Class"
_TRACKER = _typed(f"2D point tracker: {', '.join(TRACKERS)} (default {DEFAULT_TRACKER}), {_OWN}", metavar="NAME")
_DETECTOR = _typed(f"source of points: {', '.join(DETECTORS)} (default {DEFAULT_DETECTOR}), {_OWN}", metavar="NAME")
#: Where masks come from, beside folders. A segmenter's name stands for clicks with that segmenter.
MASK_SOURCES = ("dataset", "first", "clicks", *SEGMENTERS)
_MASKS = _typed(
    "dataset (all its masks), first (each object's first), clicks (--prompts, or drawn from the first masks), "
    f"{', '.join(SEGMENTERS)} or package.module:Class (clicks, with that segmenter), "
    "FOLDER (default: dataset; with --prompts clicks)",
    metavar="SOURCE",
)
_PROMPTS = _typed("what starts objects and corrects masks (see p2p click)", type=Path, metavar="FILE")
_MEMORY = _typed(
    "look for an object that an earlier run learnt (its maps/OBJECT.npz; a run's folder: all of them), as NAME=PATH "
    "under another name; repeatable, no clicks needed",
    action="append",
    metavar="[NAME=]PATH",
)
_FROZEN = _typed("keep the maps of --memory as they are: nothing is added", action="store_true")
_SAVE_MASKS = _typed("keep the masks used as DIR/masks/OBJECT/*.png", action="store_true")
_SKIP_BAD = _typed("skip frames whose images are missing or unreadable, and count them", action="store_true")
_FORMAT = _typed(
    "layout: ho3d, bop, tum, open3d, ycbmultitrack, ycbineoat, folder (default: recognised), or a package.module:load"
)
_DEPTH_SCALE = _typed("metres per raw depth unit (default 0.001)", type=float, metavar="M")
_OBJECTS = _typed("track only these objects", read=names, metavar="A,B")
_START = _typed("first frame", type=int, metavar="I")
_STOP = _typed("one past the last frame", type=int, metavar="J")
_MODELS = _typed(
    "models for scoring",
    read=partial(pairs, option="--models", form="NAME=PATH"),
    nargs="+",
    action="extend",
    metavar="NAME=PATH",
)
_SIZES = _typed(
    "known lengths of objects, cm, to compare with the measured ones",
    flag="--size",
    read=partial(pairs, option="--size", form="NAME=CM"),
    nargs="+",
    action="extend",
    metavar="NAME=CM",
)


def lengths_m(given: Mapping[str, Any] | None, objects: Iterable[str], fix: str = "") -> dict[str, float]:
    """``{"mug": "9.5"}``, as ``--size mug=9.5`` gives centimetres, to metres.

    :class:`BadInput` for what is no size, or, with ``fix``, of none of the ``objects``.
    """
    found: dict[str, float] = {}
    if unknown := sorted((given or {}).keys() - set(objects)):
        raise BadInput("size", f"the name {unknown[0]!r}", f"one of the objects: {', '.join(objects)}", fix)
    for name, cm in (given or {}).items():
        try:
            found[name] = float(cm) / 100
        except (TypeError, ValueError):
            found[name] = float("nan")
        if not 0 < found[name] < 100:
            raise BadInput(f"size of {name!r}", repr(cm), "its longest side in centimetres, as --size mug=9.5")
    return found


@dataclass(frozen=True)
class MaskSource:
    """Where masks come from: one of :data:`MASK_SOURCES`, or a ``folder``; and who looks after the other frames."""

    name: str
    segmenter: str
    folder: str | None = None

    @property
    def every_mask(self) -> bool:
        """Whether the masks of all frames are used."""
        return self.name not in ("first", "clicks")


@dataclass(frozen=True)
class RunOptions:
    """What one may ask of a run, beside the sequence and the folder of its results.

    ``tracker`` may be a tracker itself, ``prompts`` a file or values, ``settings`` is ``{"stage.key": value}``,
    ``models`` object to file. None leaves the choice to the configuration or to the sequence.
    """

    preset: str | None = field(default=None, metadata=_PRESET)
    config_file: str | Path | None = field(default=None, metadata=_CONFIG)
    settings: Mapping[str, Any] | None = field(default=None, metadata=_SET)
    seed: int | None = field(default=None, metadata=_SEED)
    device: str | None = field(default=None, metadata=_DEVICE)
    tracker: str | PointTracker = field(default=DEFAULT_TRACKER, metadata=_TRACKER)
    detector: str = field(default=DEFAULT_DETECTOR, metadata=_DETECTOR)
    masks: str | None = field(default=None, metadata=_MASKS)
    prompts: str | Path | Iterable[Any] | None = field(default=None, metadata=_PROMPTS)
    memory: Sequence[str | Path] | None = field(default=None, metadata=_MEMORY)
    frozen: bool = field(default=False, metadata=_FROZEN)
    save_masks: bool = field(default=False, metadata=_SAVE_MASKS)
    skip_bad: bool = field(default=False, metadata=_SKIP_BAD)
    format: str | None = field(default=None, metadata=_FORMAT)
    depth_scale: float | None = field(default=None, metadata=_DEPTH_SCALE)
    objects: Sequence[str] | None = field(default=None, metadata=_OBJECTS)
    start: int = field(default=0, metadata=_START)
    stop: int | None = field(default=None, metadata=_STOP)
    models: Mapping[str, str | Path] | None = field(default=None, metadata=_MODELS)
    sizes: Mapping[str, Any] | None = field(default=None, metadata=_SIZES)

    @classmethod
    def of_arguments(cls, arguments: argparse.Namespace) -> RunOptions:
        """The options among a command's arguments; the others keep their defaults."""
        given = {}
        for option in fields(cls):
            if hasattr(arguments, option.name):
                value, read = getattr(arguments, option.name), option.metadata["read"]
                given[option.name] = read(value) if read and value is not None else value
        return cls(**given)

    def mask_source(self) -> MaskSource:
        """Where masks come from."""
        asked = self.masks or ("clicks" if self.prompts or self.memory else "dataset")
        asked = ALIASES.get(asked, asked).removeprefix("dataset:")
        if not asked:
            raise BadInput("masks", repr(self.masks), "a folder, or one of " + ", ".join(MASK_SOURCES))
        if is_segmenter(asked):
            return MaskSource("clicks", asked)
        return MaskSource(asked, DEFAULT_SEGMENTER, None if asked in MASK_SOURCES else asked)

    def config(self) -> Config:
        """The parameters: preset, then file, then single settings, then device and seed."""
        config = configuration.preset(self.preset or "default")
        if self.config_file is not None:
            config = configuration.from_toml(self.config_file, config if self.preset else None)
        config = config.with_values(dict(self.settings or {}), source="--set")
        chosen = {"device": self.device, "seed": self.seed}
        return config.with_values({key: value for key, value in chosen.items() if value is not None})

    def as_dict(self) -> dict[str, Any]:
        """Plain values that make the same options again, for ``run.json``; prompts given as values are left out."""
        given = {option.name: getattr(self, option.name) for option in fields(self)}
        given["tracker"] = self.tracker if isinstance(self.tracker, str) else self.tracker.name
        given["prompts"] = self.prompts if isinstance(self.prompts, str | Path) else None
        return json.loads(json.dumps(given, default=str))

    def words(self) -> list[str]:
        """The options that are not as they are by default, as one types them: ``["--stop 60", "--save-masks"]``."""
        given = self.as_dict()
        return [_word(of, given[of.name]) for of in fields(self) if given[of.name] not in (of.default, [])]


def located(asked: Mapping[str, Any], sequence: str | Path | None) -> dict[str, Any]:
    """Options as :meth:`RunOptions.as_dict` gives them, with whole paths, which mean the same from any folder.

    A folder of masks that is inside the ``sequence`` stays the name that it has there.
    """
    found = dict(asked)
    found |= {key: str(full(asked[key])) for key in ("config_file", "prompts") if asked.get(key)}
    if folder := RunOptions(masks=asked.get("masks") or None).mask_source().folder:
        inside = sequence is not None and (Path(sequence) / folder).is_dir()
        found["masks"] = folder if inside else str(full(folder))
    if models := asked.get("models"):
        found["models"] = {name: str(full(path)) for name, path in models.items()}
    if memory := asked.get("memory"):
        named = [named_path(given) for given in memory]
        found["memory"] = [f"{name}={full(path)}" if name is not None else str(full(path)) for name, path in named]
    return found


def differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> tuple[str, str]:
    """What two runs were asked for where it differs, as one types it: ``("--stop 60", "no --stop")``."""
    said: tuple[list[str], list[str]] = ([], [])
    for of in fields(RunOptions):
        pair = [asked.get(of.name, of.default) for asked in (one, other)]
        if pair[0] == pair[1]:
            continue
        if any(isinstance(value, Mapping) for value in pair):  # of these only the values that differ
            a, b = (dict(value or {}) for value in pair)
            pair = [dict(a.items() - b.items()) or None, dict(b.items() - a.items()) or None]
        for words, value in zip(said, pair, strict=True):
            words.append(_word(of, value))
    return " ".join(said[0]), " ".join(said[1])


def _flag(option: Field) -> str:
    return option.metadata["flag"] or "--" + option.name.replace("_", "-")


def _word(option: Field, value: Any) -> str:
    """An option with its value, as one types it; ``no --option`` where it is not typed."""
    flag = _flag(option)
    if value == option.default or value == []:
        return f"no {flag}"
    if value is True:
        return flag
    said = [",".join(value) if isinstance(value, list) else str(value)]
    if isinstance(value, Mapping):
        said = [f"{name}={of}" for name, of in value.items()]
    elif option.metadata["how"].get("action") == "append":
        said = value
    return " ".join(f"{flag} {quote(one)}" for one in said)


def add_options(parser: argparse.ArgumentParser, *wanted: str, **helps: str) -> None:
    """Make command-line arguments of the fields of :class:`RunOptions` that are wanted; none named: of all.

    helps  further fields, with what they mean to this command where that is not what they mean to a run
    """
    for option in fields(RunOptions):
        if option.name in (*wanted, *helps) or not (wanted or helps):
            how = {**option.metadata["how"], "dest": option.name, "default": option.default}
            parser.add_argument(_flag(option), **how | ({"help": helps[option.name]} if option.name in helps else {}))
