"""Numbers in the names of images: whether those of two folders count alike, and how to make them so."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

import numpy as np

#: A video of colour alone, by its ending.
VIDEOS = (".mp4", ".avi", ".mov", ".webm", ".m4v", ".mkv")
#: Numbers of two images that belong together go on alike, to this share of a step.
_OUT_OF_STEP = 0.75
#: Two folders of one video may differ by so many images, or by this share of them, where a program lost the last ones.
_FEW, _FEW_SHARE = 2, 0.05


@dataclass(frozen=True)
class Count:
    """Names that differ in a number alone, which ends them and goes up by one: ``frame_000017.png`` and so on.

    digits  to which the numbers are filled up with zeros; 0: they are not
    """

    prefix: str
    digits: int
    first: int
    last: int
    suffix: str

    @classmethod
    def of(cls, files: Sequence[Path]) -> Count | None:
        """How files, in their order, are counted; None where their names have no such numbers."""
        parts = [re.fullmatch(r"(.*?)(\d+)", path.stem) for path in files]
        if not files or not all(parts):
            return None
        named = {(part[1], path.suffix) for part, path in zip(parts, files, strict=True) if part}
        texts = [part[2] for part in parts if part]
        numbers = list(map(int, texts))
        if len(named) > 1 or numbers != list(range(numbers[0], numbers[0] + len(files))):
            return None
        ((prefix, suffix),) = named
        (digits, *others) = set(map(len, texts))
        digits = 0 if others or digits == 1 else digits
        return cls(prefix, digits, numbers[0], numbers[-1], suffix)

    @property
    def form(self) -> str:
        """The number's form in C's words: ``%06d``."""
        return f"%0{self.digits}d" if self.digits else "%d"


def out_of_step(files: Sequence[Path], reference: Sequence[Path]) -> int | None:
    """The first image after which the numbers, the last ones in the names, of two folders no longer count alike.

    None where they do, or count something else than images or time.
    """
    found = [[re.findall(r"\d+", path.stem) for path in paths] for paths in (files, reference)]
    if len(files) < 3 or not all(numbers for of in found for numbers in of):
        return None
    own, other = (np.array([float(numbers[-1]) for numbers in of]) for of in found)
    step, other_step = np.median(np.diff(own)), np.median(np.diff(other))
    if not 0 < step <= 2 * other_step or not other_step <= 2 * step:
        return None
    jumps = np.flatnonzero(np.abs(np.diff(own - other)) > _OUT_OF_STEP * step)
    return int(jumps[0]) if len(jumps) else None


def numbered_apart(files: Sequence[Path], reference: Sequence[Path]) -> str:
    """What to do where the images of two folders belong together in their order, and are only numbered otherwise.

    Of as many as there are in the other one, each number is off by the same. Of a few more or less, one counts from 0,
    the other from 1. Empty where nothing speaks for it.
    """
    own, other = Count.of(files), Count.of(reference)
    if own is None or other is None or own.first == other.first:
        return ""
    apart = abs(len(files) - len(reference))
    if apart and ({own.first, other.first} != {0, 1} or apart > max(_FEW, _FEW_SHARE * len(reference))):
        return ""
    later, to, there = (own, other, files[0]) if own.first > other.first else (other, own, reference[0])
    folder, down = there.parent, later.first - to.first
    old = f"{_quoted(later.prefix)}$(printf {later.form} $k){later.suffix}"
    new = f"{_quoted(to.prefix)}$(printf {to.form} $((k - {down}))){later.suffix}"
    return (
        f"those here count from {own.first}, those there from {other.first} (ffmpeg begins with 1, or with "
        f"-start_number 0 with 0). Rename those in {folder}, and take none out: cd {quote(str(folder))} && "
        f"for k in $(seq {later.first} {later.last}); do mv {old} {new}; done"
    )


def frames_of(video: Path, folder: Path, depth: Sequence[Path]) -> str:
    """How ffmpeg makes images of a video in a folder, called as the depth images are, or else in their order."""
    count = Count.of(depth) or Count("", 6, 0, 0, "")
    name = f"{folder}/{count.prefix.replace('%', '%%')}{count.form}.png"
    made = "" if folder.is_dir() else f"mkdir {quote(str(folder))} && "
    how = f"-fps_mode passthrough -start_number {count.first}"
    return f"{video.name} is a video; its images: {made}ffmpeg -i {quote(str(video))} {how} {quote(name)}"


def _quoted(text: str) -> str:
    return quote(text) if text else ""
