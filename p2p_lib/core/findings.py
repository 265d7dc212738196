"""What somebody looked at and found: how bad it is and what to do, and how that is printed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """How bad a finding is: fine, optional and not there, worth a look, or to be mended before anything else."""

    OK = "ok"
    OPTIONAL = "-"
    LOOK = "look"
    WRONG = "WRONG"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at: its name, how it is, what was found, and what to do about it."""

    name: str
    level: Level
    text: str
    fix: str = ""

    @classmethod
    def whether(cls, ok: bool, name: str, text: str, fix: str = "", optional: bool = False) -> Finding:
        """Whether it is fine, else what mends it, and whether one can do without."""
        level = Level.OK if ok else Level.OPTIONAL if optional else Level.WRONG
        return cls(name, level, text, "" if ok else fix)

    @property
    def fine(self) -> bool:
        """Whether there is nothing to do."""
        return self.level is Level.OK

    def line(self, width: int = 0) -> str:
        """For people, the remedy under what it mends; names take up ``width`` letters."""
        found = f"{self.level:7}{self.name:{width}}  {self.text}"
        return found + f"\n{'':7}{'':{width}}  -> {self.fix}" * bool(self.fix)


def as_lines(findings: Iterable[Finding], fine: str) -> str:
    """All findings for people, and last what to mend, what to look at, or that all is ``fine``."""
    findings = list(findings)
    width = max(len(finding.name) for finding in findings)
    named = {level: ", ".join(dict.fromkeys(f.name for f in findings if f.level is level)) for level in Level}
    wrong, look = named[Level.WRONG], named[Level.LOOK]
    last = f"To mend first: {wrong}" if wrong else f"To look at before tracking: {look}" if look else fine
    return "\n".join([*(finding.line(width) for finding in findings), last])
