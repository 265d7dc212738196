"""Where a frame's time goes, stage by stage."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Adds up wall-clock milliseconds per stage within a frame; ``last_ms`` is the newest frame's."""

    def __init__(self) -> None:
        self.last_ms: dict[str, float] = {}

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Times a whole frame as stage ``total`` and starts its stages at zero."""
        self.last_ms = {}
        with self("total"):
            yield

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Times one stage; entering it again in the same frame adds up."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.last_ms[stage] = self.last_ms.get(stage, 0.0) + 1e3 * (time.perf_counter() - start)
