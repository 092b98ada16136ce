"""A connection to labseq that is made when needed, and again after a run has ended."""

from __future__ import annotations

import argparse
import socket
import time
from pathlib import Path
from typing import Any

from labseq_client import Answer, Leader, own_token


class Link:
    """Leads the run that now waits for `go`. For one thread.

    Args:
        host: Computer of labseq.
        port: The `port` of the device `tcp_leader`.
        token: Copy of the file `leader.token`. Default the file in labseq's state folder on this computer.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 5750, token: Path | None = None) -> None:
        self._host, self._port, self._token = host, port, token
        self._leader: Leader | None = None
        self._answer: Answer | None = None
        self._due_s = 0.0

    def go(self, text: str = "", values: dict[str, Any] | None = None) -> None:
        """Start a shot, and return as soon as labseq has accepted it.

        Args:
            text: Stored with the shot.
            values: Address -> value for this shot, as in `Leader.go`.

        Raises:
            LabseqError: labseq refuses the shot, with a reason. wait() reports a wrong value instead.
            RuntimeError: wait() was not called for the last shot.
            OSError: No run waits there, or the connection is lost.
        """
        if self._leader is not None:
            try:
                self._leader.go(text, values)
            except ConnectionError:  # that run has ended, but another one may wait
                self.close()
        if self._leader is None:
            self._connect().go(text, values)
        self._answer = None
        self._due_s = time.monotonic() + self._led().deadline_s + 1.0

    def wait(self, timeout_s: float | None = None) -> Answer | None:
        """Wait for the end of the shot. After the end, return the same answer again.

        Args:
            timeout_s: Longest time. Default a second more than labseq's deadline.

        Returns:
            The answer. None if the shot has not ended within `timeout_s`.

        Raises:
            RuntimeError: No shot was started.
            OSError: The connection is lost, or labseq missed its own deadline. Treat the atoms as not
                rearranged.
        """
        if self._answer is None:
            leader, left_s = self._led(), self._due_s - time.monotonic()
            limit_s = left_s if timeout_s is None else min(left_s, timeout_s)
            try:
                self._answer = leader.wait(max(0.001, limit_s))
            except OSError as error:
                # socket.timeout is not a TimeoutError before Python 3.10
                if not isinstance(error, socket.timeout) or time.monotonic() > self._due_s:
                    self.close()
                    raise
        return self._answer

    def abort(self) -> Answer:
        """End the shot before it next moves atoms, and wait for its end.

        Raises:
            RuntimeError: No shot was started.
            OSError: As for wait().
        """
        if self._answer is None:
            leader = self._led()
            try:
                self._answer = leader.abort()
            except OSError:
                self.close()
                raise
        return self._answer

    def state(self) -> str:
        """State of labseq, "idle", "waiting" for `go`, or "busy".

        Raises:
            LabseqError: labseq refuses the connection.
            OSError: No run is in progress there.
        """
        try:
            return (self._leader or self._connect()).state()
        except ConnectionError:
            self.close()
            return self._connect().state()

    def close(self) -> None:
        """Disconnect. A shot continues."""
        if self._leader is not None:
            self._leader.close()
        self._leader = None

    def _led(self) -> Leader:
        if self._leader is None:
            raise RuntimeError("call go() first")
        return self._leader

    def token(self) -> str:
        """The token of labseq.

        Raises:
            OSError: The token's file is missing, or this user cannot read it.
        """
        return own_token() if self._token is None else self._token.read_text().strip()

    def _connect(self) -> Leader:
        self._leader = Leader(self._host, self._port, self.token())
        return self._leader


def plain(answer: Answer) -> dict[str, Any]:
    """The content of an answer in numbers, texts and lists, with occupancies as rows of 0 and 1.

    The keys are as in labseq's answer, and `is_ready`, `is_refused`, `file`, `before` and `after` of its
    `Answer`. The last two are missing if there is no image.
    """
    told = {**answer.facts, "is_ready": answer.is_ready, "is_refused": answer.is_refused, "file": answer.file}
    if answer.images:
        told.update(before=rows(answer.before), after=rows(answer.after))
    return told


def rows(occupancy: Any) -> list[list[int]]:
    """An occupancy of labseq_client as rows of 0 and 1."""
    return [[int(atom) for atom in row] for row in occupancy]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options for labseq's address and token."""
    group = parser.add_argument_group("labseq")
    group.add_argument("--labseq-host", default="127.0.0.1", help="computer of labseq (default: this one)")
    group.add_argument("--labseq-port", type=int, default=5750, help="port of its device tcp_leader (5750)")
    about = "copy of its file leader.token (default: this user's own file on this computer)"
    group.add_argument("--labseq-token", type=Path, metavar="FILE", help=about)


def link_of(arguments: argparse.Namespace) -> Link:
    """The connection for the parsed options."""
    return Link(arguments.labseq_host, arguments.labseq_port, arguments.labseq_token)
