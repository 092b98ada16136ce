"""Access to the server: token, Host and Origin, rate limits, and the security headers of answers."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import os
import secrets
import socket
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs, urlencode, urlsplit

from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import read_file, state_root
from labseq.messages import visible

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

COOKIE: Final = "labseq_web"
TOKEN_VARIABLE: Final = "LABSEQ_WEB_TOKEN"  # noqa: S105 - the name of a variable
MIN_TOKEN: Final = 16
"""Minimum number of characters of a token."""

CSP: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "font-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; require-trusted-types-for "
    "'script'"
)
_HEADERS: Final = {
    "content-security-policy": CSP,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
}
SEND_S: Final = 20.0
"""Close a connection whose browser has not read for this long, in seconds."""


@dataclass(slots=True)
class Rate:
    """Limits how often each address may do something, with a burst at once and then a steady rate.

    Attributes:
        per_s: Events per second.
        burst: Number of events at once.
        max_addresses: Number of remembered addresses. The address that was quiet longest is forgotten.
    """

    per_s: float
    burst: float
    max_addresses: int = 1000
    _left: OrderedDict[str, tuple[float, float]] = field(
        default_factory=OrderedDict[str, tuple[float, float]]
    )

    def allows(self, address: str, cost: float = 1.0) -> bool:
        """Whether an address may do it once more. If so, this counts as ``cost`` events."""
        now_s = time.monotonic()
        left, then_s = self._left.pop(address, (self.burst, now_s))
        left = min(self.burst, left + (now_s - then_s) * self.per_s)
        is_allowed = left >= 1.0
        self._left[address] = (left - cost if is_allowed else left, now_s)
        while len(self._left) > self.max_addresses:
            self._left.popitem(last=False)
        return is_allowed


@dataclass(frozen=True, slots=True)
class Access:
    """The visitors who may use the server, and what they may do.

    Attributes:
        token: What a visitor must know. "" for everybody who can reach the server.
        names: Names of this server in the address bar, in lower case. Numeric addresses are always allowed.
        may_act: Whether visitors may change anything.
    """

    token: str = ""
    names: frozenset[str] = frozenset({"localhost"})
    may_act: bool = False

    @property
    def cookie(self) -> str:
        """The cookie of a visitor who knows the token. It does not contain the token."""
        return hmac.new(self.token.encode(), b"labseq web cookie", hashlib.sha256).hexdigest()


def server_names(extra: tuple[str, ...] = ()) -> frozenset[str]:
    """Names by which this computer is known, and names of a proxy."""
    host = socket.gethostname().lower()
    return frozenset(
        {"localhost", host, f"{host.partition('.')[0]}.local", *(name.lower() for name in extra)}
    )


def find_token() -> str:
    """The token from LABSEQ_WEB_TOKEN, or else the user's token, which is created on first use.

    Raises:
        ConfigError: The token is too short, or cannot be read or stored.
    """
    if given := os.environ.get(TOKEN_VARIABLE):
        if len(given) < MIN_TOKEN:
            problem = f"the token in {TOKEN_VARIABLE} has {len(given)} characters"
            raise ConfigError(Problem(problem, expected=f"at least {MIN_TOKEN}"))
        return given
    folder = state_root()
    if folder is None:
        raise ConfigError(Problem("there is no folder to store a token in", hint=f"set {TOKEN_VARIABLE}"))
    path = folder / "web.token"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(handle, "w") as file:
                file.write(secrets.token_urlsafe(24) + "\n")
        token = read_file(path, 4096).decode("ascii", "replace").strip()
    except (OSError, RecordingError) as error:
        raise _bad_token(path, str(getattr(error, "strerror", None) or error)) from error
    if len(token) < MIN_TOKEN:
        raise _bad_token(path, "it is too short")
    return token


def _bad_token(path: Path, reason: str) -> ConfigError:
    hint = f"delete the file, or set {TOKEN_VARIABLE}"
    return ConfigError(Problem(f"the token cannot be used: {reason}", visible(str(path)), hint=hint))


class Guard:
    """ASGI middleware that refuses requests that are not allowed.

    Args:
        access: Who may use it.
    """

    def __init__(self, app: App, access: Access) -> None:
        self._app = app
        self._access = access
        # all computers of a laboratory behind a proxy share one address
        self._requests = Rate(per_s=300.0, burst=600.0)
        self._wrong_tokens = Rate(per_s=0.2, burst=10.0)
        self._actions = Rate(per_s=2.0, burst=20.0)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return
        headers = _headers_of(scope)
        address = (scope.get("client") or ("",))[0]

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name.lower() for name, _ in message["headers"]}
                added = [(k.encode(), v.encode()) for k, v in _HEADERS.items() if k.encode() not in given]
                message["headers"] = [*message["headers"], *added]
            async with asyncio.timeout(SEND_S):  # a browser that no longer reads
                await send(message)

        try:
            refusal = self._refusal(scope, headers, address)
        except ValueError:  # from urlsplit()
            refusal = 400, "a header of the request is malformed"
        if refusal is not None:
            await _answer(send_safely, *refusal)
        elif self._is_first_visit(scope):
            await _answer(send_safely, 303, "", self._welcome(scope))
        else:
            with suppress(TimeoutError):  # the connection is closed
                await self._app(scope, receive, send_safely)

    def _refusal(self, scope: Scope, headers: dict[str, str], address: str) -> tuple[int, str] | None:
        """Status and reason if the request is refused."""
        access = self._access
        if not self._requests.allows(address):
            return 429, "too many requests; wait a few seconds"
        host = headers.get("host", "")
        if not _is_of_server(host, access.names):
            return 421, "the server does not have this name; add it with `labseq web --name`"
        if not _is_same_origin(headers, host):
            return 403, "requests from other websites are refused"
        if scope["method"] not in ("GET", "HEAD"):
            if not access.may_act:
                return 405, "this server is read-only; start `labseq web --control` to make changes"
            if "origin" not in headers or not headers.get("content-type", "").startswith("application/json"):
                return 403, "only this server's own pages may change anything"
            if not self._actions.allows(address):
                return 429, "too many changes; wait a few seconds"
        return self._token_refusal(scope, headers, address) if access.token else None

    def _token_refusal(self, scope: Scope, headers: dict[str, str], address: str) -> tuple[int, str] | None:
        if _is_same(_cookie_of(headers), self._access.cookie):
            return None
        offered = _token_in(scope) or headers.get("authorization", "").removeprefix("Bearer ")
        if not offered:
            return 401, "open the address with the token that `labseq web` printed"
        if not self._wrong_tokens.allows(address, cost=0.0):
            return 429, "too many wrong tokens; wait a minute"
        if _is_same(offered, self._access.token):
            return None
        self._wrong_tokens.allows(address)
        return 401, "the token is wrong; open the address that `labseq web` printed"

    def _is_first_visit(self, scope: Scope) -> bool:
        return bool(self._access.token and _token_in(scope)) and scope["method"] == "GET"

    def _welcome(self, scope: Scope) -> dict[str, str]:
        """Headers that hand over the cookie and take the token out of the address bar."""
        query = parse_qs(scope["query_string"].decode("latin-1"))
        rest = urlencode([(k, v) for k, values in query.items() for v in values if k != "token"])
        path = "/" + scope["path"].lstrip("/\\")  # "//host" would lead to another server
        cookie = f"{COOKIE}={self._access.cookie}; Path=/; HttpOnly; SameSite=Lax; Max-Age={30 * 86_400}"
        return {
            "location": urlsplit(path).path + (f"?{rest}" if rest else ""),
            "set-cookie": cookie + ("; Secure" if scope.get("scheme") == "https" else ""),
        }


def _is_same(given: str, right: str) -> bool:
    # in constant time, so that the time of an answer tells nothing about the token
    return hmac.compare_digest(given.encode(), right.encode())


def _headers_of(scope: Scope) -> dict[str, str]:
    return {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}


def _token_in(scope: Scope) -> str:
    return parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]


def _cookie_of(headers: dict[str, str]) -> str:
    pairs = (pair.strip().partition("=") for pair in headers.get("cookie", "").split(";"))
    return next((value for name, _, value in pairs if name == COOKIE), "")


def _is_of_server(host: str, names: frozenset[str]) -> bool:
    """Whether a Host header names this server.

    Numeric addresses always do, because another site can point only a name at this server (DNS rebinding).
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    with suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    return name in names


def _is_same_origin(headers: dict[str, str], host: str) -> bool:
    origin = headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return False
    is_other = headers.get("sec-fetch-site") in ("cross-site", "same-site")
    return not is_other or headers.get("sec-fetch-mode") == "navigate"


async def _answer(send: Send, status: int, text: str, headers: dict[str, str] | None = None) -> None:
    content = f"{text}\n".encode()
    named = {"content-type": "text/plain; charset=utf-8", "cache-control": "no-store", **(headers or {})}
    encoded = [(name.encode(), value.encode("latin-1", "replace")) for name, value in named.items()]
    encoded.append((b"content-length", str(len(content)).encode()))
    await send({"type": "http.response.start", "status": status, "headers": encoded})
    await send({"type": "http.response.body", "body": content})
