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
from p2p_lib.core.prompts import Prompt
from p2p_lib.datasets.prompts import KEYS, parse_prompts
from p2p_lib.extended.default import Point2Pose

#: What a line says.
FORM = '{"name": "mug", "points": [[x, y], ...]} or {"remove": "mug"}'
#: A reader that takes no line for so long is no longer there, and is looked for again every so often, s.
_GONE_S, _AGAIN_S = 0.5, 1.0


class Words:
    """Lines of JSON that add, correct and remove objects, as they come: by a thread that reads them, or :meth:`hear`.

    ``{"name": "mug", "points": [[320, 240]]}`` starts an object in the next frame, or corrects its mask; ``negative``
    and ``box`` as in a file of ``p2p click``, whose whole content is understood, too: a ``frame`` in it means nothing
    here. ``{"remove": "mug"}`` ends it. What does not fit is said, and changes nothing.
    """

    def __init__(self, lines: Iterable[str] | None, say: Callable[[str], object]):
        self._pending: deque[tuple[str, Prompt | None]] = deque()
        self._say = say
        self.reads = lines is not None  # by itself
        if lines is not None:
            threading.Thread(target=lambda: deque(map(self.hear, lines), 0), daemon=True).start()

    def hear(self, line: str) -> None:
        """Take in one line; what does not fit is said."""
        try:
            self._pending.extend(_parsed(line) if line.strip() else ())
        except BadInput as error:
            self._say(str(error))

    def tell(self, method: Point2Pose, frame_index: int) -> list[Prompt]:
        """Tell a tracker what was said since, before its next frame; the prompts that it took."""
        taken = []
        while self._pending:
            name, prompt = self._pending.popleft()
            try:
                if prompt is None:
                    method.remove_object(name)
                else:
                    prompt = replace(prompt, frame=frame_index)
                    method.tell(prompt)
                    taken.append(prompt)
            except BadInput as error:
                self._say(str(error))
        return taken


def _parsed(line: str) -> list[tuple[str, Prompt | None]]:
    """Object and prompt of each thing that a line says; no prompt: it is to be removed."""
    try:
        message = json.loads(line)
    except ValueError as error:
        raise BadInput("line", f"{line.strip()[:60]} ({in_a_line(error)})", FORM) from None
    if isinstance(message, dict) and message.keys() == {"remove"} and isinstance(message["remove"], str):
        return [(message["remove"], None)]
    if isinstance(message, dict) and "objects" in message:
        prompts = parse_prompts(message)
    elif isinstance(message, dict) and {"name"} < message.keys() <= KEYS:
        prompts = parse_prompts({"objects": [message]})
    else:
        known = isinstance(message, dict) and "name" in message
        odd = sorted(message.keys() - KEYS) if known else []
        where = f"Say where it is: {', '.join(sorted(KEYS - {'name', 'frame'}))}."
        fix = f"{odd[0]!r} is not known. {did_you_mean(odd[0], KEYS) or where}" if odd else where if known else ""
        raise BadInput("line", line.strip()[:60], FORM, fix)
    return [(prompt.name, prompt) for prompt in prompts]


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
