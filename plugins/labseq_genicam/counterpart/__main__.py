"""The process of a simulated camera; its parent talks to it through its standard input and output."""

from __future__ import annotations

import os
import queue
import signal
import sys

from labseq_genicam.aravis.camera import Camera
from labseq_genicam.aravis.errors import AravisError
from labseq_genicam.counterpart.camera import SimulatedCamera
from labseq_genicam.counterpart.faults import Faults, faults_from, setup_from
from labseq_genicam.counterpart.messages import (
    DONE,
    EXPOSE,
    FAULTS,
    IMAGE,
    NO_IMAGE,
    READY,
    REFUSED,
    Channel,
    Exposure,
)


class Process:
    """The camera and the way to its parent.

    Args:
        channel: Messages from and to the parent.
    """

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._images: queue.SimpleQueue[bytearray | None] = queue.SimpleQueue()
        self._other: Camera | None = None

    def run(self) -> None:
        """Be a camera until the parent is gone."""
        message = self._channel.receive()
        if message is None:
            return
        setup = setup_from(message[1])
        try:
            self._camera = SimulatedCamera(setup, self._expose)
            self._occupy(setup.faults)
        except AravisError as error:
            self._channel.send(REFUSED, str(error).encode())
            return
        self._channel.send(READY, self._camera.address.encode())
        while (message := self._channel.receive()) is not None:
            kind, data = message
            if kind == FAULTS:
                self._camera.faults = faults_from(data)
                self._occupy(self._camera.faults)
                self._channel.send(DONE)
            elif kind in (IMAGE, NO_IMAGE):
                self._images.put(data if kind == IMAGE else None)

    def _expose(self, exposure: Exposure) -> bytearray | None:
        try:
            self._channel.send(EXPOSE, exposure.packed())
        except OSError:
            os._exit(0)
        return self._images.get()

    def _occupy(self, faults: Faults) -> None:
        """Be the other application that controls the camera, or stop being it."""
        if faults.is_busy and self._other is None:
            self._other = Camera(self._camera.address)
        elif not faults.is_busy and self._other is not None:
            self._other.close()
            self._other = None


def main() -> None:
    """Run until the parent is gone, then end at once, whatever the camera is doing."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when it ends
    output = os.dup(1)
    os.dup2(2, 1)  # what libraries print does not go among the messages
    reader = os.fdopen(0, "rb", buffering=0)
    writer = os.fdopen(output, "wb", buffering=0)
    Process(Channel(reader, writer)).run()
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
