"""Clicks on objects, collected in the browser: what ``p2p click`` and notebooks call.

A page of the standard library's web server, on this machine alone, shows the frames; clicks make prompts
(:mod:`p2p_lib.datasets.prompts`). In a notebook a :class:`Clicker` shows the page by itself.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Event, Thread
from typing import Any

import cv2

from p2p_lib.core.browser import open_page
from p2p_lib.core.errors import BadInput, P2PError
from p2p_lib.core.prompts import Prompt, check_depth
from p2p_lib.datasets.prompts import load_prompts, parse_prompts, prompts_by_frame, save_prompts
from p2p_lib.datasets.sequence import Sequence

HOST = "127.0.0.1"
PAGE = Path(__file__).with_name("click.html")
_LARGEST_BODY = 1 << 20
_JSON, _HTML, _PNG = "application/json", "text/html; charset=utf-8", "image/png"


class Clicker:
    """A page that is being served, a context manager; ``prompts`` is what was saved last.

    url   where the page is
    path  the file that saving writes; the prompts it holds already are shown to begin with
    """

    def __init__(self, sequence: Sequence, path: str | Path, frame: int = 0, port: int = 0):
        if not 0 <= frame < len(sequence):
            raise BadInput("frame", frame, f"a number from 0 to {len(sequence) - 1}")
        self.sequence, self.path, self.first = sequence, Path(path), frame
        self.prompts: tuple[Prompt, ...] = load_prompts(path) if self.path.is_file() else ()
        self.image_png = lru_cache(maxsize=8)(self._image_png)
        self._saved = Event()
        try:
            self._server = ThreadingHTTPServer((HOST, port), type("Handler", (_Handler,), {"clicker": self}))
        except OSError as error:
            free = f"a free port ({error.strerror})"
            raise BadInput("port", port, free, "Leave --port out: one is chosen.") from None
        self._server.daemon_threads = True
        self.url = f"http://{HOST}:{self._server.server_address[1]}/"
        Thread(target=self._server.serve_forever, daemon=True).start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Until the page's Save was accepted; whether it was within the time."""
        return self._saved.wait(timeout_s)

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> Clicker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" width="100%" height="720" style="border:0"></iframe>'

    def session(self) -> dict[str, Any]:
        """What the page needs to know."""
        return {
            "sequence": self.sequence.name,
            "frames": len(self.sequence),
            "first": self.first,
            "width": self.sequence.camera.width,
            "height": self.sequence.camera.height,
            "names": list(self.sequence.objects),
            "file": str(self.path),
            "objects": [prompt.as_dict() for prompt in self.prompts],
        }

    def _image_png(self, i: int) -> bytes:
        return cv2.imencode(".png", cv2.cvtColor(self.sequence.frame(i).rgb, cv2.COLOR_RGB2BGR))[1].tobytes()

    def save(self, content: object) -> None:
        """Check prompts as the page sends them, and write the file; :class:`BadInput` says what does not fit."""
        prompts = parse_prompts(content)
        by_frame = prompts_by_frame(prompts, range(len(self.sequence)), self.sequence.camera)
        for i, said in by_frame.items():
            for prompt in said:
                check_depth(prompt, self.sequence.frame(i))
        save_prompts(self.path, prompts)
        self.prompts = prompts
        self._saved.set()


def check_writable(path: Path) -> None:
    """Refuse a file that could not be written in the end, before anyone works for it."""
    folder = next(p for p in path.absolute().parents if p.exists())
    if path.is_dir() or not folder.is_dir() or not os.access(path if path.exists() else folder, os.W_OK):
        what = "a folder" if path.is_dir() else "what cannot be written"
        raise BadInput(f"--out {path}", what, "a file in a folder that can be written")


def wait_for_clicks(clicker: Clicker, say: Callable[[str], object], open_browser: bool = True) -> tuple[Prompt, ...]:
    """What the page saves: says where the page is, opens it where there is a desktop, waits, closes."""
    with clicker:
        say(f"Click in your browser at {clicker.url} and press Save there; Ctrl-C here gives up.")
        if open_browser:
            open_page(clicker.url)
        clicker.wait()
    return clicker.prompts


class _Handler(BaseHTTPRequestHandler):
    clicker: Clicker
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        what, _, number = self.path.strip("/").partition("/")
        if self.path == "/":
            self._answer(PAGE.read_bytes(), _HTML)
        elif self.path == "/session":
            self._answer(json.dumps(self.clicker.session()).encode(), _JSON)
        elif what == "frame" and number.isdecimal() and int(number) < len(self.clicker.sequence):
            try:
                self._answer(self.clicker.image_png(int(number)), _PNG)
            except P2PError as error:
                self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
        else:
            self._refuse(HTTPStatus.NOT_FOUND, f"{self.path}: no such page")

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        # Pages of other sites cannot send this type here without being asked first, which this server never is.
        if self.path != "/prompts" or self.headers.get_content_type() != _JSON:
            return self._refuse(HTTPStatus.NOT_FOUND, "expected JSON, sent to /prompts")
        if not length.isdecimal() or int(length) > _LARGEST_BODY:
            return self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {_LARGEST_BODY} bytes")
        try:
            self.clicker.save(json.loads(self.rfile.read(int(length))))
        except (P2PError, ValueError) as error:
            return self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        except OSError as error:
            return self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, f"{self.clicker.path}: {error.strerror}")
        self._answer(json.dumps({"saved": str(self.clicker.path)}).encode(), _JSON)

    def _answer(self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self.close_connection = True  # what was sent may not have been read
        self._answer(json.dumps({"error": why}).encode(), _JSON, status)

    def log_message(self, *_: object) -> None:
        """The terminal is for the user."""
