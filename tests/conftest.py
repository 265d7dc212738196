"""Shared fixtures. The suite passes without any data beside the project; tests that want some say so."""

import os
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of third-party test data (``$P2P_SHARED_DATA``, default ``../shared/data``); skips where absent."""
    folder = Path(os.environ.get("P2P_SHARED_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"test data not present at {folder} (set P2P_SHARED_DATA)")
    return folder
