"""Start shots of labseq from another control system. Copy this file: it needs Python 3.7 or later alone.

    with Leader() as labseq:
        # load atoms here
        labseq.go("run 17")
        answer = labseq.wait()
        if answer.is_ready:
            print(answer.filling, answer.after)  # rows of booleans; an array if numpy is installed

labseq runs a sequence with a step `wait: {for: go, timeout: 10 s}`. This file speaks version 3 of the
protocol, which docs/how-to/follow.md describes.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

try:
    import numpy as np
except ImportError:
    np = None

VERSION = 3


class LabseqError(Exception):
    """labseq refused what it was sent; the text is its reason."""


class Answer:
    """How a shot ended.

    Attributes:
        is_ready: True if labseq finished its shot; False if it failed, and the atoms may be lost.
        reason: Why it failed; "" if it is ready.
        shot: Number of the shot in the run, from 0; None if no shot began.
        success: True if the last image met the target; None if no image was judged after the last moves.
        filling: Filling of the target on that image, 0 to 1; None likewise.
        file: The shot's file on labseq's computer; None if it failed. It is written just after the answer.
        images: The images of this shot since `go`, in order, as labseq describes them.
        facts: All that labseq said, times in seconds after `go`.
    """

    def __init__(self, facts: dict[str, Any]) -> None:
        self.facts = facts
        self.is_ready = facts["answer"] == "ready"
        self.reason: str = facts.get("reason", "")
        self.shot: int | None = facts.get("shot")
        self.success: bool | None = facts.get("success")
        self.filling: float | None = facts.get("filling")
        self.file: str | None = None
        if "run" in facts:
            self.file = facts["run"].rstrip("/\\") + "/" + facts["file"]
        self.images: list[dict[str, Any]] = facts.get("images", [])

    @property
    def before(self) -> Any:
        """Occupancy on the first image."""
        return self.occupancy(0)

    @property
    def after(self) -> Any:
        """Occupancy on the last image."""
        return self.occupancy(-1)

    def occupancy(self, image: int | str) -> Any:
        """Which sites hold an atom.

        Args:
            image: Number of the image from 0, from the end if negative; or its name.

        Returns:
            A list of rows of booleans, or a boolean array (n_rows, n_cols) if numpy is installed.

        Raises:
            LookupError: There is no such image.
        """
        if isinstance(image, str):
            named = [one for one in self.images if one["name"] == image]
            if not named:
                raise LookupError(f"no image '{image}'; there are: {[one['name'] for one in self.images]}")
            chosen = named[0]
        else:
            chosen = self.images[image]
        n_rows, n_cols = self.facts["shape"]
        bits = [byte >> k & 1 == 1 for byte in bytes.fromhex(chosen["occupancy"]) for k in range(7, -1, -1)]
        rows = [bits[row * n_cols : (row + 1) * n_cols] for row in range(n_rows)]
        return rows if np is None else np.array(rows, dtype=bool)

    def __repr__(self) -> str:
        """The state, the shot, and what matters most."""
        what = f"filling={self.filling}" if self.is_ready else f"reason={self.reason!r}"
        return f"<{self.facts['answer']} shot={self.shot} {what}>"


class Leader:
    """A connection to labseq, for one thread; closes at the end of a `with` block.

    Args:
        host: Computer of labseq.
        port: The `port` of the device `tcp_leader`.
        token: Text of the file `leader.token`; by default it is read from labseq's state folder on this
            computer.
        timeout_s: Longest time for labseq to answer anything but the end of a shot, in seconds.

    Attributes:
        deadline_s: Longest time from `go` to the end of the shot, as the profile sets it.
        shape: Rows and columns of the grid.

    Raises:
        LabseqError: labseq refuses the connection: the token, another leader, another version.
        OSError: No labseq listens there, or it does not answer.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = 5750, token: str | None = None, timeout_s: float = 5.0
    ) -> None:
        token = own_token() if token is None else token
        self.timeout_s = timeout_s
        self._came = b""
        self._early: deque[dict[str, Any]] = deque()
        self._is_due = False
        self._socket = socket.create_connection((host, port), timeout=timeout_s)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._send(f"hello {token} version={VERSION} form=json")
            hello = self._receive(("hello",), timeout_s)
        except BaseException:
            self._socket.close()
            raise
        self.deadline_s: float = hello["deadline_s"]
        self.shape: tuple[int, int] = tuple(hello["shape"])

    def go(self, text: str = "") -> None:
        """Start a shot; returns as soon as labseq has accepted it.

        Args:
            text: Stored with the shot, at most 190 bytes on one line.

        Raises:
            LabseqError: labseq still takes the last shot, or the text is too long.
            RuntimeError: wait() has not been called for the last `go`.
            OSError: The connection is lost.
        """
        if self._is_due:
            raise RuntimeError("call wait() for the last go first")
        self._send(f"go {text}".strip())
        answer = self._receive(("busy", "failed"), self.timeout_s)
        if answer["answer"] == "failed":
            raise LabseqError(answer["reason"])
        self._is_due = True

    def wait(self, timeout_s: float | None = None) -> Answer:
        """Wait for the end of the shot.

        Args:
            timeout_s: By default a second more than the deadline, after which labseq answers in any case.

        Raises:
            RuntimeError: No `go` waits for its answer.
            OSError: Nothing came in time (wait() may be called again), or the connection is lost. Treat the
                atoms as not rearranged.
        """
        if not self._is_due:
            raise RuntimeError("call go() first")
        limit_s = self.deadline_s + 1.0 if timeout_s is None else timeout_s
        answer = Answer(self._receive(("ready", "failed"), limit_s))
        self._is_due = False
        return answer

    def abort(self) -> Answer:
        """End the shot before it next moves atoms, and wait for its end.

        The answer is `ready` if no moves were left.

        Raises:
            RuntimeError: No shot was started.
            OSError: As for wait().
        """
        if not self._is_due:
            raise RuntimeError("call go() first")
        self._send("abort")
        return self.wait()

    def state(self) -> str:
        """What labseq does: "idle", "waiting" for `go`, or "busy"."""
        self._send("state?")
        return self._receive(("state",), self.timeout_s)["state"]

    def close(self) -> None:
        """Close the connection; a shot goes on without it."""
        self._socket.close()

    def __enter__(self) -> Leader:
        """The connection itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close it."""
        self.close()

    def _send(self, line: str) -> None:
        if "\n" in line or "\r" in line:
            raise ValueError("a line feed would begin another message")
        self._socket.settimeout(self.timeout_s)
        self._socket.sendall(line.encode() + b"\n")

    def _receive(self, words: tuple[str, ...], timeout_s: float) -> dict[str, Any]:
        """The next message that begins with one of these words; the end of a shot is kept for wait()."""
        for message in self._early:
            if message["answer"] in words:
                self._early.remove(message)
                return message
        end_s = time.monotonic() + timeout_s
        while True:
            message = self._next(end_s)
            if message["answer"] in words:
                return message
            if message["answer"] == "error":
                raise LabseqError(message["reason"])
            self._early.append(message)

    def _next(self, end_s: float) -> dict[str, Any]:
        while b"\n" not in self._came:
            self._socket.settimeout(max(0.001, end_s - time.monotonic()))
            data = self._socket.recv(65536)
            if not data:
                raise ConnectionError("labseq closed the connection")
            self._came += data
        line, _, self._came = self._came.partition(b"\n")
        text = line.decode()
        if text.startswith("{"):
            return json.loads(text)
        word, _, reason = text.partition(" ")  # before it knows the form, labseq refuses in plain text
        return {"answer": word, "reason": reason}


def own_token() -> str:
    """The token in labseq's state folder on this computer.

    Raises:
        OSError: There is none, or this user cannot read it.
    """
    if "LABSEQ_STATE" in os.environ:
        folder = Path(os.environ["LABSEQ_STATE"])
    elif sys.platform == "win32":
        folder = Path(os.environ["LOCALAPPDATA"]) / "labseq"
    elif sys.platform == "darwin":
        folder = Path.home() / "Library/Application Support/labseq"
    else:
        folder = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "labseq"
    return (folder / "leader.token").read_text().strip()
