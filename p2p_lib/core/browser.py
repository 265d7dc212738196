"""The user's browser, where there is a desktop for it."""

from __future__ import annotations

import os
import webbrowser


def open_page(url: str) -> bool:
    """Open a page in the user's browser; whether that was possible. A browser in text would take the terminal."""
    return bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ)) and webbrowser.open(url)
