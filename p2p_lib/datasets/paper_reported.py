"""The numbers that the paper reports: ``data_manifests/paper_reported.json``, the only place they come from.

Failures stand as the paper prints them, and a printed mean is kept as printed, whatever its row gives.
"""

from __future__ import annotations

from functools import cache
from typing import Literal

from pydantic import model_validator

from p2p_lib.core import paths
from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.manifests import Text
from p2p_lib.datasets.schema import Strict, read_json

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


class ReportedTable(Strict):
    """A typeset table. ``label`` is its LaTeX label, ``dataset`` the manifest's name."""

    label: Text
    title: Text
    dataset: Text
    columns: list[Column]
    rows: list[Row]

    @model_validator(mode="after")
    def _rectangular(self) -> ReportedTable:
        for row in self.rows:
            if len(row.values) not in (0, len(self.columns)):
                raise ValueError(f"{row.method} {row.metric}: {len(row.values)} values for {len(self.columns)} columns")
        return self


class Statement(Strict):
    """A number of the running text, or the two ends of a range: what it is, the section, of which method or setting."""

    key: Text
    where: Text
    of: str
    value: float | list[float]
    unit: str
    note: str = ""


class PaperReported(Strict):
    """All of it."""

    citation: Text
    tables: list[ReportedTable]
    text: list[Statement]

    def table(self, label: str) -> ReportedTable:
        """The table of this LaTeX label."""
        found = [table for table in self.tables if table.label == label]
        if not found:
            raise BadInput("table", repr(label), "one of " + ", ".join(table.label for table in self.tables))
        return found[0]

    def statement(self, key: str, of: str = "") -> Statement:
        """The number of the text with this key (and of this method)."""
        found = [passage for passage in self.text if passage.key == key and of in ("", passage.of)]
        if len(found) != 1:
            raise BadInput("number", f"{key} {of}".strip(), "one of " + ", ".join(f"{s.key} {s.of}" for s in self.text))
        return found[0]


@cache
def paper_reported() -> PaperReported:
    """What the paper reports; :class:`BadInput` names the field where the file is wrong."""
    what = f"the paper's numbers (see {__name__})"
    return read_json(paths.manifest_dir() / paths.PAPER_REPORTED, PaperReported, what)
