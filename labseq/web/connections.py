"""Limits of connections, which apply before a request reaches the application and its guard.

By itself, uvicorn reads headers of any length for any time, and counts idle connections as requests.
"""

from __future__ import annotations

import ssl
import time
from asyncio import Task, TimerHandle, Transport
from collections import Counter
from operator import attrgetter
from typing import Any, Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.utils import get_remote_addr

MAX_HEADERS: Final = 16 << 10
"""Largest request line with all headers, in bytes."""
MAX_REQUEST: Final = 128 << 10
"""Largest request, in bytes. The bodies that the API takes are smaller."""
REQUEST_S: Final = 10.0
"""Time limit from the first byte of a request, or from the connection, to its last byte, in seconds."""
MAX_IDLE: Final = 192
"""Maximum number of connections without a request in progress. Beyond that, the oldest is closed."""
MAX_IDLE_OF_ADDRESS: Final = 48
"""Maximum number of such connections from one address. A browser has six."""


class LimitedProtocol(HttpToolsProtocol):
    """A connection of a browser, with limits.

    Attributes:
        since_s: When the connection was made.
        is_idle: True if no request is in progress. A request counts once its headers are complete.

    Args:
        *args: Arguments of uvicorn.
        tls: Certificate and key. None without TLS. uvicorn would report a connection after the handshake.
        **named: Keyword arguments of uvicorn.
    """

    def __init__(self, *args: Any, tls: ssl.SSLContext | None = None, **named: Any) -> None:
        super().__init__(*args, **named)
        self._tls = tls
        self._handshake: Task[None] | None = None
        self._early: list[bytes] = []  # what came with the end of the handshake
        self.since_s: float = time.monotonic()
        self.is_idle = True
        self._n_bytes = 0  # of the request that is arriving
        self._has_headers = False
        self._late: TimerHandle | None = None

    @property
    def address(self) -> str:
        """Address of the browser."""
        return self.client[0] if self.client else ""

    def connection_made(self, transport: Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Count the connection, and close another one if there are too many."""
        self._late = self.loop.call_later(REQUEST_S, transport.abort)
        if self._tls is None:
            super().connection_made(transport)
        else:
            transport.pause_reading()  # the parser of requests must not see the handshake
            self.transport, self.client = transport, get_remote_addr(transport)
            self.connections.add(self)
            self._handshake = self.loop.create_task(self._agree(transport, self._tls))
        peers = [peer for peer in self.connections if isinstance(peer, LimitedProtocol)]
        idle = sorted((peer for peer in peers if peer.is_idle), key=attrgetter("since_s"))
        ((address, most),) = Counter(peer.address for peer in idle).most_common(1)
        if most > MAX_IDLE_OF_ADDRESS or len(idle) > MAX_IDLE:
            oldest = next(peer for peer in idle if peer.address == address)
            self.connections.discard(oldest)  # now, or a burst of connections would close the same one again
            oldest.transport.abort()

    async def _agree(self, transport: Transport, tls: ssl.SSLContext) -> None:
        """Do the handshake of TLS, then read requests."""
        try:
            encrypted = await self.loop.start_tls(transport, self, tls, server_side=True)
        except OSError as error:  # from ssl, or the connection has ended
            transport.abort()
            self.connection_lost(error)
            return
        if encrypted is None or transport.is_closing():
            self.connection_lost(ConnectionAbortedError())
            return
        super().connection_made(encrypted)
        self._handshake, early = None, self._early
        for data in early:
            self.data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._end_wait()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Read more data, unless the request is too long."""
        if self._handshake is not None:
            self._early.append(data)
            return
        if self._late is None:
            self._late = self.loop.call_later(REQUEST_S, self.transport.abort)
        self._n_bytes += len(data)
        super().data_received(data)
        is_long = self._n_bytes > (MAX_REQUEST if self._has_headers else MAX_HEADERS)
        if is_long and not self.transport.is_closing():
            self.send_400_response("The request is too long.")

    def on_headers_complete(self) -> None:
        """Begin to answer."""
        self._has_headers, self.is_idle = True, False
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """Stop the timer, because the request arrived in time."""
        self._end_wait()
        self._n_bytes, self._has_headers = 0, False
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self.is_idle = self.cycle.response_complete

    def _end_wait(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None
