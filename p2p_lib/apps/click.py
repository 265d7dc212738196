"""Clicks on objects, collected in the browser: what ``p2p click`` and notebooks call.

A page of the standard library's web server shows the frames to those on this machine who know its address; clicks make
prompts (:mod:`p2p_lib.datasets.prompts`). In a notebook a :class:`Clicker` shows the page by itself.
"""

from __future__ import annotations

import json
import re
import secrets
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any

import cv2
import numpy as np

from p2p_lib.apps.command_line import open_page
from p2p_lib.core.colours import OBJECTS
from p2p_lib.core.config import Config, preset
from p2p_lib.core.earlier import selected
from p2p_lib.core.errors import BadInput, Doubt, P2PError
from p2p_lib.core.files import parse_json
from p2p_lib.core.mask_length import doubt_growth, mask_length_m, whole_length_m
from p2p_lib.core.prompts import Prompt, check_depth
from p2p_lib.core.types import Frame
from p2p_lib.datasets.mask_log import load_masks
from p2p_lib.datasets.prompts import as_entry, load_prompts, parse_prompts, prompts_by_frame, run_lengths, save_prompts
from p2p_lib.datasets.runs import Run
from p2p_lib.datasets.sequence import Sequence

#: Object to a frame and its mask (H, W) bool there.
FirstMasks = dict[str, tuple[Frame, np.ndarray]]
HOST = "127.0.0.1"
PAGE = Path(__file__).with_name("click.html")
_LARGEST_BODY = 1 << 24
_HERE = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d+)?")
_JSON, _HTML, _PNG = "application/json", "text/html; charset=utf-8", "image/png"


class Clicker(AbstractContextManager):
    """A page that is being served, a context manager; ``prompts`` is what was saved last.

    url   where the page is; a word in it keeps others out
    path  the file that saving writes; the prompts it holds already are shown to begin with
    run   whose masks are shown where nothing is said, to be mended
    """

    def __init__(self, sequence: Sequence, path: str | Path, frame: int = 0, port: int = 0, run: Run | None = None):
        if not 0 <= frame < len(sequence):
            raise BadInput("frame", frame, f"a number from 0 to {len(sequence) - 1}")
        self.sequence, self.path, self.first, self.run = sequence, Path(path), frame, run
        self.prompts: tuple[Prompt, ...] = load_prompts(path) if self.path.is_file() else _of_run(run)
        self.image_png = lru_cache(maxsize=8)(self._image_png)
        self._finished, self._segmenting = Event(), Lock()
        try:
            self._server = ThreadingHTTPServer((HOST, port), type("Handler", (_Handler,), {"clicker": self}))
        except OSError as error:
            free = f"a free port ({error.strerror})"
            raise BadInput("port", port, free, "Leave --port out: one is chosen.") from None
        self._server.daemon_threads = True
        # Whoever does not know this word, another user of this machine say, gets no answer.
        self.token = secrets.token_urlsafe(16)
        self.url = f"http://{HOST}:{self._server.server_address[1]}/{self.token}/"
        Thread(target=self._server.serve_forever, daemon=True).start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Until the page has saved and finished; whether it has within the time."""
        return self._finished.wait(timeout_s)

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()

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
            "names": list(self.run.objects if self.run else self.sequence.objects),
            "run": self.run is not None,
            "colours": OBJECTS,
            "objects": [as_entry(prompt) for prompt in self.prompts],
        }

    def _image_png(self, i: int) -> bytes:
        return cv2.imencode(".png", cv2.cvtColor(self.sequence.frame(i).rgb, cv2.COLOR_RGB2BGR))[1].tobytes()

    def kept_masks(self, i: int) -> dict[str, np.ndarray]:
        """The masks (H, W) bool of a frame that are known without clicks: the run's."""
        return self.run.masks(self.sequence, i) if self.run else {}

    def masks(self, content: object) -> dict[str, Any]:
        """What the prompts of a frame, as the page sends them, make of it, and what is doubtful about them.

        ``masks`` are run lengths of each object that its prompts can start, or of which the run kept a mask, which they
        correct.
        """
        given = content if isinstance(content, dict) else {}
        frame, prompts = given.get("frame"), parse_prompts(given) if given.get("objects") else ()
        if not isinstance(frame, int) or not 0 <= frame < len(self.sequence):
            raise BadInput("frame", repr(frame), f"a number from 0 to {len(self.sequence) - 1}")
        kept = self.kept_masks(frame)
        made, doubts = self.made(prompts, kept)
        found = kept | made
        return {"masks": {name: run_lengths(mask)["counts"] for name, mask in found.items()}, "doubts": doubts}

    def made(
        self, prompts: Iterable[Prompt], kept: Mapping[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], list[str]]:
        """The mask (H, W) bool of each object that its prompts can start, or whose ``kept`` mask (H, W) they correct.

        And what is doubtful about them.
        """
        was = {name: mask for name, mask in kept.items() if mask.any()}
        with self._segmenting, warnings.catch_warnings(record=True) as doubts:
            warnings.simplefilter("always", Doubt)
            made = clicked_masks(self.sequence, [p for p in prompts if p.starts or p.name in was], was=was)
            for name in made.keys() & was.keys():
                frame, mask = made[name]
                length_m = mask_length_m(frame, mask, self.sequence.camera)
                doubt_growth(name, frame.index, length_m, self._before_m(name, frame, was[name]))
        texts = [str(doubt.message) for doubt in doubts if issubclass(doubt.category, Doubt)]
        return {name: mask for name, (_, mask) in made.items()}, texts

    def _before_m(self, name: str, frame: Frame, kept: np.ndarray) -> np.ndarray:
        """Lengths of an object's masks before a frame of the run, m; without a run that of the mask that is kept."""
        if (log := load_masks(self.run.path).get(name) if self.run else None) is not None:
            whole_m = np.where(log.at_the_border(self.sequence.camera), np.nan, log.size_m)
            return whole_m[log.frame_index < frame.index]
        return np.array([whole_length_m(frame, kept, self.sequence.camera)])

    def checked(self, content: object, started: Iterable[str] = ()) -> tuple[Prompt, ...]:
        """The prompts that the page sends; objects that are ``started`` may be corrected alone."""
        prompts = parse_prompts(content)
        by_frame = prompts_by_frame(prompts, range(len(self.sequence)), self.sequence.camera, started)
        check_depths(self.sequence, [prompt for of_frame in by_frame.values() for prompt in of_frame])
        return prompts

    def save(self, content: object) -> str:
        """Check prompts as the page sends them, and write the file; :class:`BadInput` says what does not fit.

        ``finish`` beside the objects ends the waiting for the page, which otherwise goes on. Gives what is to be said
        anew and why, "" where all was taken.
        """
        prompts = self.checked(content)
        save_prompts(self.path, prompts)
        self.prompts = prompts
        if isinstance(content, dict) and content.get("finish"):
            self._finished.set()
        return ""


def _of_run(run: Run | None) -> tuple[Prompt, ...]:
    """What a run was started from, as far as it keeps that: of a mask it keeps the size alone."""
    kept = (run.info.get("prompts") or ()) if run else ()
    given = [entry for entry in kept if "mask_px" not in entry]
    return parse_prompts({"objects": given}) if given else ()


def first_change(before: Iterable[Prompt], after: Iterable[Prompt]) -> int | None:
    """The first frame of which other things are said; None where nothing has changed."""
    one, other = ({(prompt.frame, json.dumps(as_entry(prompt))) for prompt in prompts} for prompts in (before, after))
    return min((frame for frame, _ in one ^ other), default=None)


def clicked_masks(
    sequence: Sequence,
    prompts: Iterable[Prompt],
    config: Config | None = None,
    was: Mapping[str, np.ndarray] | None = None,
) -> FirstMasks:
    """Each object's first mask, as the built-in segmenter cuts it out of the frame that its first prompt is of.

    was  objects' masks (H, W) bool in that frame, which the prompts correct
    """
    config, was = config or preset(), was or {}
    found: FirstMasks = {}
    for i, of_frame in prompts_by_frame(prompts, range(len(sequence)), sequence.camera, was).items():
        frame = sequence.frame(i)
        new = [prompt for prompt in of_frame if prompt.name not in found]
        masks, _ = selected(frame, new, sequence.camera, config.segmentation, was)
        found |= {name: (frame, mask) for name, mask in masks.items()}
    return found


def check_depths(sequence: Sequence, prompts: Iterable[Prompt]) -> None:
    """Refuse clicks and boxes without depth: a run would end there."""
    for prompt in prompts:
        check_depth(prompt, sequence.frame(prompt.frame))


def invite(clicker: Clicker, say: Callable[[str], object], open_browser: bool, more: str = "") -> None:
    """Say where the page is, and open it where there is a desktop."""
    say(f"Click in your browser at {clicker.url}{more}")
    if open_browser:
        open_page(clicker.url)


def wait_for_clicks(clicker: Clicker, say: Callable[[str], object], open_browser: bool = True) -> tuple[Prompt, ...]:
    """What the page saves: says where the page is, opens it where there is a desktop, waits, closes.

    Ctrl-C before anything was saved is passed on.
    """
    before = clicker.prompts
    with clicker:
        invite(clicker, say, open_browser, " and press Save and finish there; Ctrl-C here ends it, too.")
        try:
            clicker.wait()
        except KeyboardInterrupt:
            if clicker.prompts is before:
                raise
    return clicker.prompts


class _Handler(BaseHTTPRequestHandler):
    clicker: Clicker
    protocol_version = "HTTP/1.1"
    timeout = 60  # seconds for whoever sends nothing more

    def _place(self) -> str | None:
        """What is asked for below the page's address; a refusal and None for whoever comes in another's name."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        token, slash, place = self.path.removeprefix("/").partition("/")
        # A page from elsewhere whose name leads to this machine says that name; one that sends something, its own.
        if not _HERE.fullmatch(host) or origin not in (None, f"http://{host}"):
            self._refuse(HTTPStatus.FORBIDDEN, "expected Host and Origin of this machine")
        elif not slash or not secrets.compare_digest(token.encode(), self.clicker.token.encode()):
            self._refuse(HTTPStatus.NOT_FOUND, "no such page: take the whole address that was printed")
        else:
            return place
        return None

    def do_GET(self) -> None:
        place = self._place()
        if place is None:
            return
        what, _, number = place.partition("/")
        if place == "":
            self._answer(PAGE.read_bytes(), _HTML)
        elif place == "session":
            self._answer(json.dumps(self.clicker.session()).encode(), _JSON)
        elif what == "frame" and number.isdecimal() and int(number) < len(self.clicker.sequence):
            try:
                self._answer(self.clicker.image_png(int(number)), _PNG)
            except P2PError as error:
                self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
        else:
            self._refuse(HTTPStatus.NOT_FOUND, f"{place}: no such page")

    def do_POST(self) -> None:
        place, length = self._place(), self.headers.get("Content-Length", "")
        if place is None:
            return None
        # Pages of other sites cannot send this type here without being asked first, which this server never is.
        answers = {"prompts": self._save, "masks": self.clicker.masks}
        if place not in answers or self.headers.get_content_type() != _JSON:
            return self._refuse(HTTPStatus.NOT_FOUND, f"expected JSON, sent to {' or '.join(answers)}")
        if not length.isdecimal() or int(length) > _LARGEST_BODY:
            return self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {_LARGEST_BODY} bytes")
        try:
            answer = answers[place](parse_json(self.rfile.read(int(length)), "prompts", "JSON as the page sends it"))
        except P2PError as error:
            return self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        except OSError as error:
            return self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, f"{self.clicker.path}: {error.strerror}")
        return self._answer(json.dumps(answer).encode(), _JSON)

    def _save(self, content: object) -> dict[str, str]:
        again = self.clicker.save(content)
        return {"saved": str(self.clicker.path), "again": again}

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
