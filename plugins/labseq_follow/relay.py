"""A separate process that answers `go` while the run writes a shot.

Encoding a shot keeps Python's interpreter lock for several milliseconds at a time, so no thread of the run
can answer within one. The process shares the socket of the control system. It receives for the run, and
answers `go` with a line that the run has given it in advance. It imports only the standard library.
"""

from __future__ import annotations

import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from typing import Final

ANSWERED: Final = b"\x06"
"""Encloses the time of an answered `go`. Removed from the bytes that a control system sends."""
LONGEST: Final = 4000
"""More bytes than this without a line feed are passed on, and the run replies that the line is too long."""
GO: Final = re.compile(rb'\s*(go(\s|$)|\{\s*"go")')
"""The beginning of a `go`, as words or as a JSON object."""
EXIT_S: Final = 2.0


class Relay:
    """The process for one control system. Started before it connects, because starting takes a moment.

    Attributes:
        received: Socket with the bytes of the control system. It ends when the control system leaves.
    """

    def __init__(self) -> None:
        self.received, theirs = socket.socketpair()
        self._answer = b""
        with theirs:
            command = [sys.executable, "-I", "-S", __file__, str(theirs.fileno())]
            # in a session of its own, so that Ctrl-C at the terminal ends the run alone
            self._process = subprocess.Popen(  # noqa: S603 - this file
                command, pass_fds=[theirs.fileno()], start_new_session=True, stdin=subprocess.DEVNULL
            )

    def serve(self, leader: socket.socket) -> None:
        """Start to receive from a control system."""
        socket.send_fds(self.received, [b"\n"], [leader.fileno()])
        self.received.setblocking(False)

    def expect(self, answer: bytes) -> None:
        """Answer the next `go` with this line, once. "" leaves it to the run."""
        if answer != self._answer:
            self._answer = answer
            with suppress(OSError):  # the process has ended, which ``received`` shows
                self.received.send(answer or b"\n")

    def finish(self) -> bytes:
        """Stop answering. Returns bytes that were received, and perhaps answered, but not yet read."""
        rest = b""
        with suppress(OSError):
            self.received.shutdown(socket.SHUT_WR)
            self.received.settimeout(EXIT_S)
            while data := self.received.recv(4096):
                rest += data
        return rest

    def close(self) -> None:
        """End the process."""
        self.received.close()
        try:
            self._process.wait(EXIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def can_relay() -> bool:
    """Whether this system can pass a socket to another process in this way. Windows cannot."""
    return hasattr(socket, "send_fds")


def _relay(run: socket.socket, leader: socket.socket) -> None:
    """Receive, answer and pass on, until either side ends."""
    begun, orders = b"", b""
    answer = b""
    run.setblocking(True)
    while True:
        readable = select.select([run, leader], [], [])[0]
        # the run's earlier messages, which the control system could not answer yet, come first
        while select.select([run], [], [], 0)[0]:
            said = run.recv(4096)
            if not said:
                return
            *complete, orders = (orders + said).split(b"\n")
            answer = complete[-1] if complete else answer
        if leader not in readable:
            continue
        try:
            came = leader.recv(4096)
        except BlockingIOError:
            continue
        except OSError:
            came = b""
        *lines, begun = (begun + came.replace(ANSWERED, b"?")).split(b"\n")
        for line in lines:
            mark = b""
            if answer and GO.match(line) and len(line) <= LONGEST:
                with suppress(OSError):
                    leader.send(answer + b"\n")
                # the run may read it much later, but a monotonic time is the same in all processes
                answer, mark = b"", b"%s%.6f%s" % (ANSWERED, time.monotonic(), ANSWERED)
            run.sendall(mark + line + b"\n")
        if begun and (not came or len(begun) > LONGEST):
            run.sendall(begun)
            begun = b""
        if not came:
            return


def main(fileno: int) -> None:
    """Wait for the control system's socket, then serve it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        with suppress(OSError):  # if the system does not allow it, other programs may delay the answer
            # above all ordinary programs, and below the thread of a shot's steps, which has 20
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    with socket.socket(fileno=fileno) as run:
        _, fds, _, _ = socket.recv_fds(run, 1, 1)
        if fds:
            with socket.socket(fileno=fds[0]) as leader, suppress(OSError):
                _relay(run, leader)


if __name__ == "__main__":
    main(int(sys.argv[1]))
