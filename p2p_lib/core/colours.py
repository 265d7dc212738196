"""Objects' colours, wherever they are drawn; those of plots and statuses are in :mod:`p2p_lib.figures.style`."""

from __future__ import annotations

from collections.abc import Iterable

#: Of objects, in the order in which a sequence names them.
OBJECTS = ("#0072B2", "#E69F00", "#00CCAA", "#EE0066", "#6B4E23", "#CC88EE", "#440088", "#222222")


def object_colours(names: Iterable[str]) -> dict[str, str]:
    """Object to its colour ``#RRGGBB``, by its place in the sequence; beyond eight objects they come round again."""
    return {name: OBJECTS[k % len(OBJECTS)] for k, name in enumerate(names)}


def rgb(colour: str) -> tuple[int, int, int]:
    """``#RRGGBB`` as three numbers 0..255, red first."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue
