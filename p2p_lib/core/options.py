"""The options of a run, declared once: they serve ``p2p run``, Python, plans of benchmarks and ``run.json``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from p2p_lib.core import config as configuration
from p2p_lib.core.backends import DEFAULT_DETECTOR, DEFAULT_TRACKER, DETECTORS, SEGMENTERS, TRACKERS
from p2p_lib.core.config import Config
from p2p_lib.core.errors import BadInput
from p2p_lib.core.interfaces import PointTracker


def pairs(option: str, form: str) -> Callable[[Iterable[str] | None], dict[str, str]]:
    """A reader of ``["a=1", ...]``, as an option collects them, to ``{"a": "1", ...}``."""

    def read(given: Iterable[str] | None) -> dict[str, str]:
        found = {}
        for item in given or ():
            name, equals, value = item.partition("=")
            if not (name and equals and value):
                raise BadInput(option, repr(item), form)
            found[name] = value
        return found

    return read


def names(given: str | None) -> tuple[str, ...] | None:
    """``"a,b"`` to ``("a", "b")``; None where nothing is named."""
    return tuple(part for part in (given or "").split(",") if part) or None


def _option(default: Any, help: str, *, flag: str = "", read: Callable[[Any], Any] | None = None, **argument: Any):
    """A field. ``read`` makes its value of what ``argparse.add_argument(flag, **argument)`` collects."""
    return field(default=default, metadata={"flag": flag, "read": read, "argument": {"help": help, **argument}})


@dataclass(frozen=True)
class RunOptions:
    """What one may ask of a run, beside the sequence and the folder of its results.

    ``tracker`` may be a tracker itself, ``prompts`` a file or values, ``objects`` any names, ``settings``
    ``{"stage.key": value}`` and ``models`` object to file. None leaves the choice to the configuration or the sequence.
    """

    preset: str | None = _option(None, "paper or default: parameters only, never backends")
    config_file: str | Path | None = _option(
        None, "TOML file with [stage] key = value", flag="--config", type=Path, metavar="FILE"
    )
    settings: Mapping[str, Any] | None = _option(
        None,
        "change one parameter; repeatable",
        flag="--set",
        read=pairs("--set", "stage.key=value"),
        action="append",
        metavar="STAGE.KEY=VALUE",
    )
    seed: int | None = _option(None, "of every random choice (default 0)", type=int, metavar="N")
    device: str | None = _option(None, "where surfaces are fused and refined: cpu (default), cuda or cuda:N")
    tracker: str | PointTracker = _option(
        DEFAULT_TRACKER, f"2D point tracker: {', '.join(TRACKERS)} (default {DEFAULT_TRACKER})", metavar="NAME"
    )
    detector: str = _option(
        DEFAULT_DETECTOR, f"source of new points: {', '.join(DETECTORS)} (default {DEFAULT_DETECTOR})", metavar="NAME"
    )
    masks: str | None = _option(
        None,
        f"dataset, dataset:FOLDER, {', '.join(SEGMENTERS)} (default: dataset; with --prompts builtin)",
        metavar="SOURCE",
    )
    prompts: str | Path | Iterable[Any] | None = _option(
        None, "clicks on the objects (see p2p click)", type=Path, metavar="FILE"
    )
    save_masks: bool = _option(False, "keep the masks used as DIR/masks/OBJECT/*.png", action="store_true")
    format: str | None = _option(
        None, "layout: ho3d, bop, ycbmultitrack, ycbineoat, folder (default: recognised)", metavar="FORMAT"
    )
    depth_scale: float | None = _option(None, "metres per raw depth unit (default 0.001)", type=float, metavar="M")
    objects: Sequence[str] | None = _option(None, "track only these objects", read=names, metavar="A,B")
    start: int = _option(0, "first frame", type=int, metavar="I")
    stop: int | None = _option(None, "one past the last frame", type=int, metavar="J")
    models: Mapping[str, str | Path] | None = _option(
        None,
        "models for scoring",
        read=pairs("--models", "NAME=PATH"),
        nargs="+",
        action="extend",
        metavar="NAME=PATH",
    )

    @classmethod
    def of_arguments(cls, arguments: argparse.Namespace) -> RunOptions:
        """The options among a command's arguments; the others keep their defaults."""
        given = {}
        for option in fields(cls):
            if hasattr(arguments, option.name):
                value, read = getattr(arguments, option.name), option.metadata["read"]
                given[option.name] = read(value) if read else value
        return cls(**given)

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


def add_options(parser: argparse.ArgumentParser, *wanted: str, **helps: str) -> None:
    """Make command-line arguments of these fields of :class:`RunOptions`; none named: of all.

    helps  field to what it means to this command, where that is not what it means to a run
    """
    for option in fields(RunOptions):
        if not wanted or option.name in wanted:
            flag = option.metadata["flag"] or "--" + option.name.replace("_", "-")
            argument = {**option.metadata["argument"], "dest": option.name, "default": option.default}
            if option.name in helps:
                argument["help"] = helps[option.name]
            parser.add_argument(flag, **argument)
