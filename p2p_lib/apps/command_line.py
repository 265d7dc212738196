"""How the command line ``p2p`` works: commands are declared, words are read, and what goes wrong is one line."""

from __future__ import annotations

import argparse
import logging
import os
import re
import signal
import sys
import threading
import traceback
import warnings
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from shlex import quote
from tempfile import TemporaryDirectory
from typing import Any

from tqdm import tqdm

from p2p_lib import __version__
from p2p_lib.core.backends import DETECTORS, SEGMENTERS, TRACKERS
from p2p_lib.core.errors import BadInput, Doubt, Doubts, P2PError, did_you_mean, doubt, in_a_line
from p2p_lib.core.options import RunOptions, add_options
from p2p_lib.core.plugins import is_place, offered

#: Options that name parts: their kind, and the names that are ours.
_PARTS = {
    "tracker": ("tracker", TRACKERS),
    "detector": ("detector", DETECTORS),
    "masks": ("segmenter", SEGMENTERS),
    "camera": ("camera", ()),
    "format": ("dataset", ()),
}
EXIT_INTERRUPTED = 128  # and the signal's number: 130 for Ctrl-C, 143 for SIGTERM

Argument = Callable[[argparse.ArgumentParser], Any]
_COMMANDS: list[tuple[str, str, tuple[Argument, ...], Callable]] = []  # name, help, arguments, what carries it out


def arg(*flags: str, **how: Any) -> Argument:
    """What ``add_argument`` takes."""
    return lambda parser: parser.add_argument(*flags, **how)


def output(metavar: str, help: str, flag: str = "--out", **how: Any) -> Argument:
    """A folder (``metavar`` DIR) or a file that a command writes: one that cannot be is refused before it begins."""

    def add(parser: argparse.ArgumentParser) -> None:
        written = parser.add_argument(flag, type=Path, metavar=metavar, help=help, **how)
        parser.set_defaults(outputs=[*(parser.get_default("outputs") or ()), written])

    return add


def run_options(*wanted: str, **helps: str) -> Argument:
    """Options of a run (:class:`RunOptions`) that a command has as well; ``helps`` says what some mean to it."""
    return lambda parser: add_options(parser, *wanted, **helps)


def typed_options(parser: argparse.ArgumentParser) -> None:
    """All options of a run; what is not typed is no argument: a run that goes on takes it from the earlier one."""
    add_options(parser)
    options = {option.name for option in fields(RunOptions)}
    for action in parser._actions:
        if action.dest in options:
            action.default = argparse.SUPPRESS


#: What several commands take.
SEQUENCE = arg(
    "sequence", metavar="SEQ", help="a folder, synthetic/NAME or NAME@SEED (bundled), or a name below $P2P_DATA"
)
RUN = arg("run", type=Path, metavar="DIR", help="folder written by p2p run")
JSON = arg("--json", action="store_true", help="JSON instead of a table")
QUIET = arg("--quiet", action="store_true", help="no progress bar, and no word on what is waited for")
NO_BROWSER = arg("--no-browser", action="store_true", help="only say where the page is")


def command(name: str, help: str, *arguments: Argument) -> Callable:
    """Declare a command ``p2p NAME``, carried out by the function below it; its value is the exit code, None for 0."""

    def declare(function: Callable[[argparse.Namespace], int | None]) -> Callable:
        _COMMANDS.append((name, help, arguments, function))
        return function

    return declare


class Terminated(KeyboardInterrupt):
    """SIGTERM ends a command as Ctrl-C does: what is done so far is kept."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (0 fine, 2 something to mend, 130 interrupted)."""
    for library in ("OMP", "OPENBLAS", "MKL"):
        # The matrices are small: more threads cost time, most of all where other programs run. Set it to override.
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    if "" not in sys.path:
        sys.path.append("")  # --tracker mine:Tracker finds mine.py here
    arguments = parser().parse_args(argv)
    if arguments.log:
        logging.basicConfig(format="%(name)s %(levelname)s %(message)s")
        logging.getLogger("p2p_lib").setLevel(arguments.log.upper())
    ended_by, doubts = [signal.SIGINT], Doubts()

    def terminated(number: int, frame: object) -> None:
        ended_by.append(signal.Signals(number))
        raise Terminated

    in_main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, terminated) if in_main else None
    try:
        with warnings.catch_warnings():
            warnings.showwarning = partial(_show_doubt, warnings.showwarning, arguments.name, doubts)
            for of in getattr(arguments, "outputs", ()):
                check_writable(of.option_strings[0], getattr(arguments, of.dest), of.metavar == "DIR")
            _doubt_outdated(getattr(arguments, "run", None))
            return arguments.command(arguments) or 0
    except BrokenPipeError:  # the reader of our output (head, less) has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        message = _in_words(error, arguments)
        if message is None:  # a mistake of ours
            raise
        if arguments.debug:
            traceback.print_exc()
        else:
            warn(f"p2p {arguments.name}: {message}")
        return P2PError.exit_code
    except KeyboardInterrupt as interrupt:
        warn(f"p2p {arguments.name}: interrupted{f'. {interrupt}' if str(interrupt) else ''}")
        return EXIT_INTERRUPTED + ended_by[-1]
    finally:
        for line in doubts.more:
            warn(f"p2p {arguments.name}: {line}")
        if in_main:
            signal.signal(signal.SIGTERM, before)


def check_writable(option: str, path: Path | None, folder: bool) -> None:
    """Refuse a folder, or else a file, that could not be written in the end, before anyone works or waits for it."""
    if path is None:
        return
    what, kinds = f"{option} {path}", ("a folder", "a file")[:: 1 if folder else -1]
    try:
        if path.exists() and path.is_dir() != folder:
            raise BadInput(what, kinds[1], f"{kinds[0]} for the results", "Name another one.")
        above = path if path.is_dir() else next(p for p in path.absolute().parents if p.exists())
        with TemporaryDirectory(prefix=".p2p", dir=above):
            pass  # what may be written there is seen by writing alone: /proc, for one, says that all may
        if path.is_file():
            path.open("ab").close()
    except OSError as error:
        got, expected = f"what cannot be written ({error.strerror})", f"{kinds[0]} that can be written"
        raise BadInput(what, got, expected, "Name another one.") from None


def _doubt_outdated(folder: Path | None) -> None:
    """Say of an offline result that its run has gone on since, or was corrected."""
    if folder is None:
        return
    from p2p_lib.datasets.runs import read_info

    if not (read_info(folder) or {}).get("offline"):
        return
    from p2p_lib.offline.refine import outdated

    if outdated(folder):
        doubt(str(folder), "it was made of earlier poses of its run", f"Make it anew: p2p refine {folder.parent}")


def _in_words(error: Exception, arguments: argparse.Namespace) -> str | None:
    """What went wrong that a user can mend, in a line; None where that is nothing of theirs."""
    if isinstance(error, P2PError):
        return str(error)
    ran = [(f.f_globals.get("__name__"), f.f_code, line) for f, line in traceback.walk_tb(error.__traceback__)]
    entered = {code.co_qualname.partition(".")[0] for _, code, _ in ran}
    for option, place in sorted(_others_parts(arguments), key=lambda part: part[1].partition(":")[2] not in entered):
        package, name = re.split("[.:]", place)[0], place.partition(":")[2]
        theirs = [(code, line) for module, code, line in ran if str(module).partition(".")[0] == package]
        called = theirs[0][0].co_qualname if theirs else name
        # Called with what it does not take, it is not entered at all.
        if theirs or (isinstance(error, TypeError) and str(error).startswith(f"{name}.")):
            where = f" ({theirs[-1][0].co_filename}:{theirs[-1][1]})" if theirs else ""
            what = f"{type(error).__name__}: {in_a_line(error)}"
            return f"{option} {place}: {called} raised {what}{where}. --debug shows the traceback."
    if isinstance(error, OSError):  # a full disk, say
        return ": ".join(str(part) for part in (error.filename, error.strerror) if part) or str(error)
    return None


def _others_parts(arguments: argparse.Namespace) -> Iterator[tuple[str, str]]:
    """The options that name a part of somebody else's, each with its ``package.module:Class``."""
    for option, (kind, ours) in _PARTS.items():
        name = getattr(arguments, option, None)
        if isinstance(name, str) and name not in ours:
            if is_place(name):
                yield option, name
            elif (point := offered(kind).get(name)) is not None:
                yield option, point.value


def parser() -> argparse.ArgumentParser:
    """Knows the words of every command that has been declared."""
    parser = _Parser(
        prog="p2p",
        description="Point2Pose: 6D tracking and reconstruction of several unknown rigid objects in RGB-D video.",
        epilog="Start with: p2p run synthetic/crossing --out out/crossing",
    )
    parser.add_argument("--version", action="version", version=__version__)
    parser.set_defaults(debug=False, log=None)
    commands = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=_Parser)
    data = commands.add_parser("data", help="datasets and checkpoints: what they are, where, whether whole")
    actions = data.add_subparsers(metavar="ACTION", required=True, parser_class=_Parser)
    for name, help, arguments, function in _COMMANDS:
        group, word = (actions, name.removeprefix("data ")) if name.startswith("data ") else (commands, name)
        command = group.add_parser(word, help=help, description=help[0].upper() + help[1:] + ".")
        for argument in arguments:
            argument(command)
        command.add_argument("--debug", action="store_true", help="show the traceback of an error")
        command.add_argument("--log", choices=("info", "debug"), help="say on standard error what becomes of objects")
        command.set_defaults(command=function, parser=command, name=name)
    return parser


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with the words of a command in one line, and what was meant."""

    def parse_known_args(self, args=None, namespace=None):
        if args is not None and self._subparsers is None:  # before argparse misses --out where --ouput was given
            known = list(self._option_string_actions)
            for word in args[: args.index("--") if "--" in args else None]:
                name = word.partition("=")[0]
                if re.match("--[a-z]", name) and not any(option.startswith(name) for option in known):
                    self.error(f"there is no option {name}{_meant(name, known)}")
        return super().parse_known_args(args, namespace)

    def error(self, message: str):
        if choice := re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message):
            message += _meant(choice[1], re.findall(r"[\w-]+", choice[2]))
        if re.search(r"unrecognized arguments: .*\.npz", message):  # what a shell makes of maps/*.npz
            message += ". --memory takes one path: give the run's folder for all of its maps, or repeat it"
        warn(f"{self.prog}: {message.rstrip('.')}{'' if message.endswith('?') else '.'} See {self.prog} --help")
        raise SystemExit(2)


def _meant(word: str, known: list[str]) -> str:
    dashes = "--" if word.startswith("--") else ""  # which all options share, and which make none alike
    known = [option for option in known if option.startswith(dashes) and option != "--force"]  # it replaces a run
    meant = did_you_mean(word.removeprefix(dashes), [option.removeprefix(dashes) for option in known], dashes)
    return f". {meant}" if meant else ""


def as_it_began(info: Mapping[str, Any], **changes: Any) -> RunOptions:
    """What a run was asked for, with ``changes``."""
    return replace(RunOptions(**(info.get("options") or {})), **changes)


def again(info: Mapping[str, Any], out: Path, **changes: Any) -> str:
    """The command that makes a run in its folder ``out`` once more, with ``changes`` of its options."""
    asked = as_it_began(info, **changes)
    place = info["path"] or info["sequence"]
    return " ".join(["p2p run", quote(place), "--out", quote(str(out)), *asked.words()])


def unscored(not_scored: str, folder: Path) -> str:
    """Why a run is not scored, behind words that say already which run, and that it is not."""
    return not_scored.removeprefix(f"{folder}: nothing to score: ")


def warn(line: object) -> None:
    """Standard output is for results. What a bar, or a line of what is waited for, has written makes room for it."""
    tqdm.write(str(line), sys.stderr)


def open_page(url: str) -> bool:
    """Open a page in the user's browser; whether that was possible. A browser in text would take the terminal."""
    return bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ)) and webbrowser.open(url)


def _show_doubt(others: Callable, name: str, doubts: Doubts, message: Any, category: type, *where: Any) -> None:
    """A doubt is said once, however often it comes with other numbers; how often is said at the end."""
    if not isinstance(message, Doubt):
        others(message, category, *where)
        return
    if doubts.add(message):
        warn(f"p2p {name}: {message}")
