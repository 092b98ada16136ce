"""Start shots of labseq from another control system. Copy this file, which only needs Python 3.7 or later.

    with Leader() as labseq:
        # load atoms here
        labseq.go("run 17", {"shot.hold.duration": "5 ms"})
        answer = labseq.wait()
        if answer.is_ready:
            print(answer.filling, answer.after)  # rows of booleans, or an array if numpy is installed

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
from typing import Any, Callable, Mapping

try:
    import numpy as np
except ImportError:
    np = None

VERSION = 3


class LabseqError(Exception):
    """labseq refused a message. The text is labseq's reason."""


class Image:
    """An image of a shot.

    Attributes:
        name: Name in the shot's file.
        facts: Everything that labseq sent about it, with times in seconds after `go`.
    """

    def __init__(self, facts: dict[str, Any], shape: tuple[int, int]) -> None:
        self.facts = facts
        self.name: str = facts["name"]
        self._shape = shape

    @property
    def occupancy(self) -> Any:
        """The sites with atoms, as a list of rows of booleans, or an array if numpy is installed."""
        n_rows, n_cols = self._shape
        packed = bytes.fromhex(self.facts["occupancy"])
        if np is not None:
            bits = np.unpackbits(np.frombuffer(packed, np.uint8))
            return bits[: n_rows * n_cols].reshape(n_rows, n_cols).astype(bool)
        each = [byte >> k & 1 == 1 for byte in packed for k in range(7, -1, -1)]
        return [each[row * n_cols : (row + 1) * n_cols] for row in range(n_rows)]


class Answer:
    """How a shot ended.

    Attributes:
        is_ready: True if labseq finished its shot. False if it failed, so that the atoms may be lost.
        is_refused: True if labseq refused the values of `go` and so has not touched the atoms.
        reason: Why the shot failed, or "" if it is ready.
        shot: Number of the shot in the run, from 0. None if no shot began.
        success: True if the last image met the target. None if no image was judged after the last moves.
        filling: Filling of the target on that image, 0 to 1. None if no image was judged.
        file: The shot's file on labseq's computer, written just after the answer. None if the shot failed.
        images: The images of this shot since `go`, in order.
        facts: Everything that labseq sent, with times in seconds after `go`.
    """

    def __init__(self, facts: dict[str, Any]) -> None:
        self.facts = facts
        self.is_ready = facts["answer"] == "ready"
        self.is_refused: bool = facts.get("refused", False)
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
        """The sites with atoms on an image.

        Args:
            image: Name of the image, or its number from 0 (from the end if negative).

        Returns:
            A list of rows of booleans, or a boolean array (n_rows, n_cols) if numpy is installed.

        Raises:
            LookupError: There is no such image.
        """
        if isinstance(image, str):
            named = [one for one in self.images if one["name"] == image]
            if not named:
                raise LookupError(f"no image '{image}'; expected {[one['name'] for one in self.images]}")
            chosen = named[0]
        else:
            chosen = self.images[image]
        return Image(chosen, tuple(self.facts["shape"])).occupancy

    def __repr__(self) -> str:
        """The state, the shot and the main result."""
        what = f"filling={self.filling}" if self.is_ready else f"reason={self.reason!r}"
        return f"<{self.facts['answer']} shot={self.shot} {what}>"


class Leader:
    """A connection to labseq, for one thread. Closes at the end of a `with` block.

    Args:
        host: Computer of labseq.
        port: The `port` of the device `tcp_leader`.
        token: Text of the file `leader.token`. By default read from labseq's state folder on this
            computer.
        timeout_s: Longest time for labseq to answer, in seconds, except for the end of a shot.
        each_image: Ask labseq to send each image as soon as it is known, for `on_image` of wait().
        all_shots: Ask labseq to also report the end of shots that this connection did not start.

    Attributes:
        deadline_s: Longest time from `go` to the end of the shot, from the profile.
        shape: Rows and columns of the grid.

    Raises:
        LabseqError: labseq refuses the connection because of the token, another leader or the version.
        OSError: No labseq listens there, or it does not answer.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 5750,
        token: str | None = None,
        timeout_s: float = 5.0,
        *,
        each_image: bool = False,
        all_shots: bool = False,
    ) -> None:
        token = own_token() if token is None else token
        self.timeout_s = timeout_s
        self._came = b""
        self._early: deque[dict[str, Any]] = deque()
        self._is_due, self._all_shots = False, all_shots
        self._socket = socket.create_connection((host, port), timeout=timeout_s)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            asked = " images=each" * each_image + " shots=all" * all_shots
            self._send(f"hello {token} version={VERSION} form=json{asked}")
            hello = self._receive(("hello",), timeout_s)
        except BaseException:
            self._socket.close()
            raise
        self.deadline_s: float = hello["deadline_s"]
        self.shape: tuple[int, int] = tuple(hello["shape"])

    def go(self, text: str = "", values: Mapping[str, Any] | None = None) -> None:
        """Start a shot, and return as soon as labseq has accepted it.

        Args:
            text: Stored with the shot.
            values: Address -> value for this shot as for `labseq run --set`, {"shot.hold.duration": "5 ms"}.
                The sequence must allow the addresses in `leader: {may_set: [...]}`. labseq checks the values
                when a step takes this `go`. If a value is wrong, wait() returns `is_refused`.

        Raises:
            LabseqError: labseq is still taking the last shot, or text and values have more than 4,000 bytes.
            RuntimeError: wait() has not been called for the last `go`.
            OSError: The connection is lost.
        """
        if self._is_due:
            raise RuntimeError("call wait() for the last go first")
        self._send(json.dumps({"go": text, "values": dict(values or {})}))
        answer = self._receive(("busy", "failed"), self.timeout_s)
        if answer["answer"] == "failed":
            raise LabseqError(answer["reason"])
        self._is_due = True

    def set(self, values: Mapping[str, Any]) -> None:
        """Give values for the next shot, which `go` or an edge at the timing box starts.

        labseq answers when no shot is in progress.

        Args:
            values: As for go().

        Raises:
            LabseqError: A value is refused. The text is the reason.
            OSError: The connection is lost, or a shot continues for longer than `timeout_s`.
        """
        self._send(json.dumps({"set": dict(values)}))
        self._receive(("set",), self.timeout_s)

    def wait(
        self,
        timeout_s: float | None = None,
        on_image: Callable[[Image], Any] | None = None,
        on_step: Callable[[str], Any] | None = None,
        on_light: Callable[[float], Any] | None = None,
    ) -> Answer:
        """Wait for the end of the shot.

        Args:
            timeout_s: Longest time between two messages of labseq. Default a second more than the
                deadline, at which labseq always answers.
            on_image: Called with each image, if the connection was made with `each_image`.
            on_step: Called with the name of a step `leader: NAME`. Does the step, and returns at its end.
            on_light: Called with the exposure time in seconds to turn the imaging light on, and with 0 to
                turn it off.

        Raises:
            RuntimeError: No `go` waits for its answer, or labseq asks for an action without a function.
            OSError: Nothing came in time (wait() may be called again), or the connection is lost. Treat the
                atoms as not rearranged.
        """
        if not (self._is_due or self._all_shots):
            raise RuntimeError("call go() first")
        limit_s = self.deadline_s + 1.0 if timeout_s is None else timeout_s
        while True:
            message = self._receive(("ready", "failed", "image", "your", "light", "dark"), limit_s)
            word = message["answer"]
            if word in ("ready", "failed"):
                self._is_due = False
                return Answer(message)
            if word == "image":
                if on_image is not None:
                    on_image(Image(message, self.shape))
            elif word == "your":
                self._act(on_step, message["step"], "on_step")
                self._send("done")
            else:
                self._act(on_light, message.get("exposure_s", 0.0), "on_light")
                self._send("lit" if word == "light" else "dark")

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
        """State of labseq, "idle", "waiting" for `go`, or "busy"."""
        self._send("state?")
        return self._receive(("state",), self.timeout_s)["state"]

    def close(self) -> None:
        """Close the connection. A shot continues without it."""
        self._socket.close()

    def __enter__(self) -> Leader:
        """The connection itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close it."""
        self.close()

    @staticmethod
    def _act(function: Callable[[Any], Any] | None, value: Any, name: str) -> None:
        if function is None:
            raise RuntimeError(f"labseq asks for {value!r}; give wait() a function '{name}'")
        function(value)

    def _send(self, line: str) -> None:
        if "\n" in line or "\r" in line:
            raise ValueError("a line feed would begin another message")
        self._socket.settimeout(self.timeout_s)
        self._socket.sendall(line.encode() + b"\n")

    def _receive(self, words: tuple[str, ...], timeout_s: float) -> dict[str, Any]:
        """The next message that begins with one of these words. The end of a shot is kept for wait()."""
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
        word, _, reason = text.partition(" ")  # before it knows the form, labseq refuses in words
        return {"answer": word, "reason": reason}


def own_token() -> str:
    """The token in labseq's state folder on this computer.

    Raises:
        OSError: There is no token, or this user cannot read it.
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
