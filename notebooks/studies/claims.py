"""All notebooks: what the last cell claims, numbers, what they mean, and what they have to be."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

from p2p_lib.core.errors import BadInput
from p2p_lib.core.tables import as_html, as_text

#: Under which a notebook's output keeps its claims, beside the table that is shown.
CHECKS_MIME = "application/vnd.p2p.checks+json"
Value = bool | int | float | str


@dataclass(frozen=True)
class Claim:
    """A number that a notebook reports, what it means, and what it has to be.

    what      its name, with its unit in brackets
    value     True is a claim that holds, False one that does not; a number without a bar and a text are told only
    means     what it says to somebody who sees this line alone
    at_least  the bar: ``value`` must not be below; ``at_most``, not above
    """

    what: str
    value: Value
    means: str
    at_least: float | None = None
    at_most: float | None = None

    def __post_init__(self) -> None:
        value = self.value.item() if hasattr(self.value, "item") else self.value
        object.__setattr__(self, "value", value)
        if not isinstance(value, Value) or (isinstance(value, float) and not math.isfinite(value)):
            raise BadInput(f"claim {self.what!r}", repr(value), "a finite number, a bool or a string")

    def __bool__(self) -> bool:
        if isinstance(self.value, bool | str):
            return self.value is not False
        low, high = (-math.inf if self.at_least is None else self.at_least), self.at_most
        return low <= self.value <= (math.inf if high is None else high)

    @property
    def bar(self) -> str:
        """What the value has to be, in words; empty where it is told only."""
        if isinstance(self.value, bool):
            return "yes"
        bars = (("at least", self.at_least), ("at most", self.at_most))
        return " and ".join(f"{word} {limit:g}" for word, limit in bars if limit is not None)

    @property
    def told(self) -> Claim:
        """The same for information alone: nothing that it has to be."""
        value = _shown(self.value) if isinstance(self.value, bool) else self.value
        return replace(self, value=value, at_least=None, at_most=None)

    @property
    def row(self) -> dict[str, str]:
        """The claim as a row of a table."""
        good = ("holds" if self else "does not hold") if self.bar else "for information"
        return {"what": self.what, "value": _shown(self.value), "has to be": self.bar or "-", "": good} | {
            "what it means": self.means
        }


def check(*claims: Claim, bars: bool = True) -> None:
    """Show and keep what a notebook's ``checks`` cell claims; AssertionError names every claim that does not hold.

    bars  False: the bars are of other parameters than these, so all is told for information and nothing can fail
    """
    from IPython import get_ipython
    from IPython.display import publish_display_data
    from pandas import DataFrame

    if not bars:
        claims = tuple(claim.told for claim in claims)
    if get_ipython() is not None:
        table = DataFrame([claim.row for claim in claims])
        kept = [asdict(claim) for claim in claims]
        publish_display_data({CHECKS_MIME: kept, "text/html": as_html(table, words=4), "text/plain": as_text(table)})
    failed = [f"{claim.what}: {_shown(claim.value)}, not {claim.bar} ({claim.means})" for claim in claims if not claim]
    if failed:
        raise AssertionError("; ".join(failed))


def _shown(value: Value) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
