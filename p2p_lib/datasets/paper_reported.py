"""The numbers that the paper reports: ``data_manifests/paper_reported.json``, the only place they come from.

Failures stand as the paper prints them. A printed mean is kept as printed, whatever its row gives:
:func:`recomputed_means` says where the two differ and how many failures a mean leaves out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from pydantic import ValidationError, model_validator

from p2p_lib.core import paths
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets.manifests import Strict, Text

FAIL = "fail"


class Column(Strict):
    """What one column is of: a sequence as the paper names it, and the object where several are in it."""

    sequence: Text
    object: str = ""


class Row(Strict):
    """One method's line of a table.

    metric  adds_auc, add_auc (percent over 0 to 0.1 m), chamfer_cm
    cad     whether the method is given the object's CAD model
    values  one for each column, in its order; "fail" as the paper prints it. Empty where only a mean is printed
    mean    as printed; std likewise, None where none is printed
    """

    metric: Literal["adds_auc", "add_auc", "chamfer_cm"]
    method: Text
    cad: bool
    values: list[float | Literal["fail"]]
    mean: float
    std: float | None = None


class Table(Strict):
    """A typeset table. ``label`` is its LaTeX label, ``dataset`` the manifest's name."""

    label: Text
    title: Text
    dataset: Text
    columns: list[Column]
    rows: list[Row]

    @model_validator(mode="after")
    def _rectangular(self) -> Table:
        for row in self.rows:
            if len(row.values) not in (0, len(self.columns)):
                raise ValueError(f"{row.method} {row.metric}: {len(row.values)} values for {len(self.columns)} columns")
        return self

    def row(self, method: str, metric: str) -> Row:
        """The line of a method and metric."""
        found = [row for row in self.rows if (row.method, row.metric) == (method, metric)]
        if not found:
            known = ", ".join(sorted({f"{row.method} {row.metric}" for row in self.rows}))
            raise BadInput(self.label, f"{method} {metric}", f"one of {known}")
        return found[0]


class Statement(Strict):
    """A number of the running text.

    key         what it is, such as ``recovered_events``
    where       the section it stands in
    of          the method or setting
    value       one number, or the two ends of a range; unit in words
    """

    key: Text
    where: Text
    of: str
    value: float | list[float]
    unit: str
    note: str = ""


class PaperReported(Strict):
    """All of it."""

    citation: Text
    tables: list[Table]
    text: list[Statement]

    def table(self, label: str) -> Table:
        """The table of this LaTeX label."""
        found = [table for table in self.tables if table.label == label]
        if not found:
            raise BadInput("table", repr(label), "one of " + ", ".join(table.label for table in self.tables))
        return found[0]

    def statement(self, key: str, of: str = "") -> Statement:
        """The number of the text with this key (and of this method)."""
        found = [said for said in self.text if said.key == key and of in ("", said.of)]
        if len(found) != 1:
            raise BadInput("number", f"{key} {of}".strip(), "one of " + ", ".join(f"{s.key} {s.of}" for s in self.text))
        return found[0]


@cache
def paper_reported() -> PaperReported:
    """What the paper reports; :class:`BadInput` names the field where the file is wrong."""
    path = paths.manifest_dir() / paths.PAPER_REPORTED
    try:
        return PaperReported.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise MissingData(str(path), "no such file, expected the paper's numbers") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise BadInput(str(path), f"{where}: {first['msg']}", "the paper's numbers (see its module)") from None


@dataclass(frozen=True)
class Mean:
    """A printed mean beside what its row gives.

    printed       as in the paper
    of_successes  over the values that are numbers
    of_all        with a failure as 0 (an area under a curve; NaN for the Chamfer distance, which has no worst value)
    failures      how many of the ``count`` values are failures
    """

    table: str
    method: str
    metric: str
    printed: float
    of_successes: float
    of_all: float
    failures: int
    count: int

    @property
    def differs(self) -> bool:
        """Whether the printed mean is not that of the successes, rounded to two places either way."""
        return abs(self.printed - self.of_successes) > 0.005 + 1e-9


def recomputed_means() -> list[Mean]:
    """Every printed mean that has a row of values, in the tables' order."""
    means = []
    for table in paper_reported().tables:
        for row in table.rows:
            if not row.values:
                continue
            good = np.array([value for value in row.values if value != FAIL], float)
            count = len(row.values)
            whole = float("nan") if row.metric == "chamfer_cm" and len(good) < count else good.sum() / count
            key = (table.label, row.method, row.metric, row.mean)
            means.append(Mean(*key, float(good.mean()), float(whole), count - len(good), count))
    return means
