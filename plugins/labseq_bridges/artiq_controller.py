"""An ARTIQ controller of labseq, started by `python -m labseq_bridges.artiq_controller -p 5751`.

It needs sipyco, which comes with ARTIQ. Entry of `device_db.py`, for a controller on the computer of
the ARTIQ master:

    "labseq": {
        "type": "controller",
        "host": "::1",
        "port": 5751,
        "command": "python -m labseq_bridges.artiq_controller -p {port} --bind {bind}",
    },

sipyco knows no passwords, and evaluates calls as Python. Anyone who can connect to its port can start shots
and run programs with your rights.
"""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Sequence
from contextlib import closing
from typing import Any

from labseq_bridges.link import Link, add_arguments, link_of, plain, rows

SLICE_S = 0.02
"""Other calls wait this long while an experiment waits for the end of a shot."""


class Labseq:
    """The RPC target. Its results are numbers, texts and lists, which every ARTIQ version can transfer."""

    def __init__(self, link: Link) -> None:
        self._link = link

    def ping(self) -> bool:
        """Answer the controller manager, which restarts a controller that does not answer. Always True."""
        return True

    def go(self, text: str = "", values: dict[str, Any] | None = None) -> None:
        """Start a shot, and return as soon as labseq has accepted it. See ``labseq_client.Leader.go``."""
        self._link.go(text, values)

    async def wait(self) -> dict[str, Any]:
        """Wait for the shot's end, and get `is_ready`, `reason`, `filling`, `before`, `after` and more."""
        while True:
            answer = self._link.wait(SLICE_S)
            if answer is not None:
                return plain(answer)
            await asyncio.sleep(0)

    def occupancy(self, image: int | str = -1) -> list[list[int]]:
        """The atoms on an image of the last shot, as rows of 0 and 1.

        Args:
            image: Name of the image, or its number from 0 (from the end if negative).

        Raises:
            RuntimeError: The last shot has not ended.
            LookupError: There is no such image.
        """
        answer = self._link.wait(0.001)
        if answer is None:
            raise RuntimeError("the shot has not ended; call wait() first")
        return rows(answer.occupancy(image))

    def abort(self) -> dict[str, Any]:
        """End the shot before it next moves atoms, and wait for its end, as in ``wait``."""
        return plain(self._link.abort())

    def state(self) -> str:
        """State of labseq, "idle", "waiting" for `go`, or "busy"."""
        return self._link.state()


async def serve(target: Labseq, hosts: Any, port: int) -> None:
    """Serve until a client such as the controller manager calls `terminate`."""
    from sipyco.pc_rpc import Server  # pyright: ignore[reportMissingImports] - it is not on PyPI

    # in parallel, so that a dashboard can abort the shot for which an experiment waits
    server = Server(
        {"labseq": target}, "labseq rearranges atoms", builtin_terminate=True, allow_parallel=True
    )
    await server.start(hosts, port)
    try:
        await server.wait_terminate()
    finally:
        await server.stop()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the controller."""
    from sipyco import common_args  # pyright: ignore[reportMissingImports] - likewise

    parser = argparse.ArgumentParser(description="ARTIQ controller of labseq")
    common_args.simple_network_args(parser, 5751)
    common_args.verbosity_args(parser)
    add_arguments(parser)
    options = parser.parse_args(arguments)
    common_args.init_logger_from_args(options)
    hosts = common_args.bind_address_from_args(options)
    with closing(link_of(options)) as link:
        asyncio.run(serve(Labseq(link), hosts, options.port))


if __name__ == "__main__":
    main()
