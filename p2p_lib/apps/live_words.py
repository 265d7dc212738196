"""What goes in and out of ``p2p live`` while it runs: words on its objects, and lines of estimates over a network."""

from __future__ import annotations

import json
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from urllib.parse import urlsplit

from p2p_lib.core.errors import BadInput, MissingData, P2PError, did_you_mean, in_a_line
from p2p_lib.core.prompts import Prompt, doubt_spelling
from p2p_lib.core.types import Frame
from p2p_lib.datasets.prompts import KEYS, parse_prompts
from p2p_lib.extended.default import Point2Pose

#: What a line says.
FORM = '{"name": "mug", "points": [[x, y], ...]} or {"remove": "mug"}'
#: So many of the frames that were tracked last may be named in lines.
KEPT = 60
#: A reader that takes no line for so long is no longer there, and is looked for again every so often, s.
_GONE_S, _AGAIN_S = 0.5, 1.0


class Words:
    """Lines of JSON that add, correct and remove objects, as they come: by a thread that reads them, or :meth:`hear`.

    ``{"name": "mug", "points": [[320, 240]]}`` starts an object in the next frame, or corrects its mask; ``negative``
    and ``box`` as in a file of ``p2p click``, whose whole content is understood, too. With a ``frame`` it is said of
    that one, which has to be one of the last :data:`KEPT` that were tracked. ``{"remove": "mug"}`` ends it. What does
    not fit is said, and changes nothing.
    """

    def __init__(self, lines: Iterable[str] | None, say: Callable[[str], object]):
        # With the frame that each is of, or whether its prompt names one.
        self._pending: deque[tuple[str, Prompt | None, Frame | bool]] = deque()
        self._say = say
        self.reads = lines is not None  # by itself
        self._seen: deque[Frame] = deque(maxlen=KEPT if self.reads else 0)
        if lines is not None:
            threading.Thread(target=lambda: deque(map(self.hear, lines), 0), daemon=True).start()

    def hear(self, line: str) -> None:
        """Take in one line; what does not fit is said."""
        try:
            self._pending.extend(_parsed(line) if line.strip() else ())
        except BadInput as error:
            self._say(str(error))

    def add(self, prompts: Iterable[Prompt], then: Frame) -> None:
        """Take in what is said of a frame, however long ago that was."""
        self._pending.extend((prompt.name, prompt, then) for prompt in prompts)

    def tell(self, method: Point2Pose, frame: Frame) -> list[Prompt]:
        """Tell a tracker what was said since, before its next frame; the prompts that it took."""
        taken = []
        while self._pending:
            name, prompt, of = self._pending.popleft()
            try:
                if prompt is None:
                    method.remove_object(name)
                else:
                    then = of if isinstance(of, Frame) else self._kept(prompt) if of else None
                    prompt = replace(prompt, frame=frame.index)
                    doubt_spelling(name, method.objects)
                    method.tell(prompt, then)
                    taken.append(prompt)
            except BadInput as error:
                self._say(str(error))
        self._seen.append(frame)
        return taken

    def _kept(self, prompt: Prompt) -> Frame:
        """The frame whose number a prompt names."""
        for frame in self._seen:
            if frame.index == prompt.frame:
                return frame
        expected = f"one of the last {KEPT} that were tracked"
        fix = "Click on a newer image; without a frame the next one is meant."
        raise BadInput(f"prompt of {prompt.name!r}", f"frame {prompt.frame}", expected, fix)


def _parsed(line: str) -> list[tuple[str, Prompt | None, bool]]:
    """Object and prompt of each thing that a line says, and whether it names a frame; no prompt: it is removed."""
    try:
        message = json.loads(line)
    except ValueError as error:
        raise BadInput("line", f"{line.strip()[:60]} ({in_a_line(error)})", FORM) from None
    if isinstance(message, dict) and message.keys() == {"remove"} and isinstance(message["remove"], str):
        return [(message["remove"], None, False)]
    if isinstance(message, dict) and {"name"} < message.keys() <= KEYS:
        message = {"objects": [message]}
    if not isinstance(message, dict) or "objects" not in message:
        known = isinstance(message, dict) and "name" in message
        odd = sorted(message.keys() - KEYS) if known else []
        where = f"Say where it is: {', '.join(sorted(KEYS - {'name', 'frame'}))}."
        fix = f"{odd[0]!r} is not known. {did_you_mean(odd[0], KEYS) or where}" if odd else where if known else ""
        raise BadInput("line", line.strip()[:60], FORM, fix)
    prompts = zip(message["objects"], parse_prompts(message), strict=True)
    return [(prompt.name, prompt, "frame" in entry) for entry, prompt in prompts]


@contextmanager
def outlet(to: str, say: Callable[[str], object]) -> Iterator[Callable[[str], None]]:
    """What sends lines to ``tcp://HOST:PORT`` or, one a datagram, to ``udp://HOST:PORT``.

    Tracking goes on where a reader goes away, or takes no line for half a second: that is said, the lines are lost, and
    another one that listens there gets those from then on.
    """
    reader, ended = _connected(to), threading.Event()

    def look_again() -> None:
        nonlocal reader
        while not ended.wait(_AGAIN_S):
            with suppress(P2PError):
                reader = _connected(to)
                say(f"{to} takes lines again.")
                return

    def send(line: str) -> None:
        if reader.fileno() < 0:  # gone
            return
        try:
            reader.sendall(f"{line}\n".encode())
        except OSError as error:
            if reader.type == socket.SOCK_DGRAM and not isinstance(error, TimeoutError):
                return  # nobody listens yet, or any more: datagrams are for whoever is there
            say(f"{to} takes no more lines ({in_a_line(error)}); tracking goes on, and a reader is waited for.")
            reader.close()
            threading.Thread(target=look_again, daemon=True).start()

    try:
        yield send
    finally:
        ended.set()
        reader.close()


def _connected(to: str) -> socket.socket:
    try:
        at = urlsplit(to)
        kind = {"tcp": socket.SOCK_STREAM, "udp": socket.SOCK_DGRAM}[at.scheme]
        host, port = at.hostname, at.port
        if not host or port is None:
            raise ValueError
    except (KeyError, ValueError):
        raise BadInput("to", repr(to), "tcp://HOST:PORT or udp://HOST:PORT") from None
    found: P2PError = MissingData(to, "no such host")
    with suppress(socket.gaierror):
        for family, _, _, _, address in socket.getaddrinfo(host, port, type=kind):
            made = socket.socket(family, kind)
            made.settimeout(_GONE_S)
            try:
                made.connect(address)
            except OSError as error:
                made.close()
                found = MissingData(to, f"nobody listens there ({in_a_line(error)})", "Start the reader first.")
            else:
                return made
    raise found
