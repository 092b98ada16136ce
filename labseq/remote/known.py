"""The clients that may connect to a device server, whose public keys are in its folder of keys."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from labseq.messages import format_error
from labseq.wire import keys_root, known_keys
from labseq.wire.keys import Keys

READ_S: Final = 0.2
"""Interval at which the keys are read, in seconds. Deleting a key also ends a connected client's session."""


class KnownKeys:
    """The public keys of clients, and their names.

    Attributes:
        own: Keys of this computer. None for a server that needs no keys.

    Args:
        report: Receives lines of text for the operator.
    """

    def __init__(self, own: Keys | None, report: Callable[[str], object]) -> None:
        self.own = own
        self._report = report
        self._names: Mapping[bytes, str] = known_keys(keys_root()) if own is not None else {}
        self._read_s = time.monotonic()
        self._failure = ""
        self._authenticator: Any = None

    @property
    def names(self) -> str:
        """The clients' names, for the operator."""
        return ", ".join(sorted(self._names.values())) or f"none (put public keys into {keys_root()}/known)"

    def name(self, peer: str) -> str:
        """Name of the client with this key."""
        return self._names.get(peer.encode(), "this computer")

    def client_of(self, frames: Sequence[Any]) -> object:
        """The sender of a message, as the client's key or without keys its connection."""
        return frames[0].bytes if self.own is None else frames[-1].get("User-Id")

    def is_known(self, peer: str) -> bool:
        """Whether a client's key is known, or none is needed."""
        return self.own is None or peer.encode() in self._names

    def read_again(self) -> None:
        """Read the keys if it is time. If that fails, report it once and keep the previous keys."""
        if self.own is None or time.monotonic() < self._read_s + READ_S:
            return
        self._read_s, failure = time.monotonic(), ""
        try:
            self._names = known_keys(keys_root())
        except Exception as error:  # noqa: BLE001 - whatever is wrong with them must not end the server
            failure = f"the known keys cannot be read, so the previous keys stay valid: {format_error(error)}"
        if failure and failure != self._failure:
            self._report(failure)
        self._failure = failure

    def start(self, context: Any) -> None:
        """Make the sockets of this ZeroMQ context refuse clients whose keys are unknown."""
        if self.own is not None:
            from zmq.auth.thread import ThreadAuthenticator

            self._authenticator = ThreadAuthenticator(context)
            self._authenticator.start()
            self._authenticator.configure_curve_callback("labseq", credentials_provider=self)

    def end(self) -> None:
        """Stop refusing clients."""
        if self._authenticator is not None:
            self._authenticator.stop()

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether a client with this key may connect. Called by the authenticator."""
        del domain
        return self.is_known(key.decode("ascii"))
