"""Who may use the server, and how fast: token, Host and Origin, rate limits, and the headers of answers."""

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
COOKIE_S: Final = 30 * 86_400
TOKEN_VARIABLE: Final = "LABSEQ_WEB_TOKEN"  # noqa: S105 - the name of a variable
TOKEN_FILE: Final = "web.token"  # noqa: S105 - the name of a file
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
_READING: Final = frozenset({"GET", "HEAD"})
_PER_S, _BURST = 300.0, 600.0
"""Requests of one address: a laboratory behind a proxy has only one."""
_GUESSES_PER_S, _GUESSES = 0.2, 10.0
"""Wrong tokens of one address."""
_ACTIONS_PER_S, _ACTIONS = 2.0, 20.0
"""Requests of one address that change something."""
_MAX_ADDRESSES: Final = 1000
SEND_S: Final = 60.0
"""For so long a browser may leave what is sent to it unread."""


@dataclass(slots=True)
class Rate:
    """Allows a number of events at once, and so many a second.

    Attributes:
        per_s: Events a second.
        burst: Events at once.
    """

    per_s: float
    burst: float
    _left: OrderedDict[str, tuple[float, float]] = field(
        default_factory=OrderedDict[str, tuple[float, float]]
    )

    def allows(self, who: str, cost: float = 1.0) -> bool:
        """Whether one more is allowed; it is then counted."""
        now_s = time.monotonic()
        left, then_s = self._left.pop(who, (self.burst, now_s))
        left = min(self.burst, left + (now_s - then_s) * self.per_s)
        is_allowed = left >= 1.0
        self._left[who] = (left - cost if is_allowed else left, now_s)
        while len(self._left) > _MAX_ADDRESSES:
            self._left.popitem(last=False)
        return is_allowed


@dataclass(frozen=True, slots=True)
class Access:
    """Who may use the server.

    Attributes:
        token: What a visitor must know; "" for everybody who can reach the server.
        names: Names in the address bar that are this server's, in lower case; addresses are always allowed.
        may_act: Whether visitors may change anything.
    """

    token: str = ""
    names: frozenset[str] = frozenset({"localhost"})
    may_act: bool = False

    @property
    def cookie(self) -> str:
        """The cookie of a visitor who knows the token; it does not contain it."""
        return hmac.new(self.token.encode(), b"labseq web cookie", hashlib.sha256).hexdigest()


def own_names(extra: tuple[str, ...] = ()) -> frozenset[str]:
    """Names by which this computer is known, and those of a proxy."""
    host = socket.gethostname().lower()
    return frozenset(
        {"localhost", host, f"{host.partition('.')[0]}.local", *(name.lower() for name in extra)}
    )


def find_token() -> str:
    """The token: that of LABSEQ_WEB_TOKEN, else that of this user, which is made when it is first needed.

    Raises:
        ConfigError: It is too short, or cannot be read or kept.
    """
    if given := os.environ.get(TOKEN_VARIABLE):
        if len(given) < MIN_TOKEN:
            what = f"the token in {TOKEN_VARIABLE} has {len(given)} characters"
            raise ConfigError(Problem(what, expected=f"at least {MIN_TOKEN}"))
        return given
    folder = state_root()
    if folder is None:
        raise ConfigError(Problem("there is no place for a token", hint=f"set {TOKEN_VARIABLE}"))
    path = folder / TOKEN_FILE
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


def _bad_token(path: Path, why: str) -> ConfigError:
    hint = f"delete the file, or set {TOKEN_VARIABLE}"
    return ConfigError(Problem(f"the token cannot be used: {why}", visible(str(path)), hint=hint))


class Guard:
    """ASGI middleware that lets a request through only if it is allowed to.

    Args:
        app: The application.
        access: Who may use it.
    """

    def __init__(self, app: App, access: Access) -> None:
        self._app = app
        self._access = access
        self._requests, self._wrong_tokens = Rate(_PER_S, _BURST), Rate(_GUESSES_PER_S, _GUESSES)
        self._actions = Rate(_ACTIONS_PER_S, _ACTIONS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return
        headers = _headers_of(scope)
        who = (scope.get("client") or ("",))[0]

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                known = {name.lower() for name, _ in message["headers"]}
                added = [(k.encode(), v.encode()) for k, v in _HEADERS.items() if k.encode() not in known]
                message["headers"] = [*message["headers"], *added]
            async with asyncio.timeout(SEND_S):  # a browser that no longer reads
                await send(message)

        refusal = self._refusal(scope, headers, who)
        if refusal is not None:
            await _answer(send_safely, *refusal)
        elif self._is_first_visit(scope):
            await _answer(send_safely, 303, "", self._welcome(scope))
        else:
            with suppress(TimeoutError):  # the connection is closed
                await self._app(scope, receive, send_safely)

    def _refusal(self, scope: Scope, headers: dict[str, str], who: str) -> tuple[int, str] | None:
        """Status and reason if the request is refused."""
        access = self._access
        if not self._requests.allows(who):
            return 429, "too many requests; wait a few seconds"
        host = headers.get("host", "")
        if not _is_own(host, access.names):
            return 421, "this address is not one of the server's; see `labseq web --name`"
        if not _is_same_origin(headers, host):
            return 403, "requests of other pages are refused"
        if scope["method"] not in _READING:
            if not access.may_act:
                return 405, "this page only shows; start `labseq web --control` to act"
            if "origin" not in headers or not headers.get("content-type", "").startswith("application/json"):
                return 403, "only this server's own pages may act"
            if not self._actions.allows(who):
                return 429, "too many changes; wait a few seconds"
        return self._token_refusal(scope, headers, who) if access.token else None

    def _token_refusal(self, scope: Scope, headers: dict[str, str], who: str) -> tuple[int, str] | None:
        if _is_same(_cookie_of(headers), self._access.cookie):
            return None
        offered = _token_in(scope) or headers.get("authorization", "").removeprefix("Bearer ")
        if not offered:
            return 401, "open the address with the token that `labseq web` printed"
        if not self._wrong_tokens.allows(who, cost=0.0):
            return 429, "too many wrong tokens; wait a minute"
        if _is_same(offered, self._access.token):
            return None
        self._wrong_tokens.allows(who)
        return 401, "the token is wrong; open the address that `labseq web` printed"

    def _is_first_visit(self, scope: Scope) -> bool:
        return bool(self._access.token and _token_in(scope)) and scope["method"] == "GET"

    def _welcome(self, scope: Scope) -> dict[str, str]:
        """Headers that hand over the cookie and take the token out of the address bar."""
        query = parse_qs(scope["query_string"].decode("latin-1"))
        rest = urlencode([(k, v) for k, values in query.items() for v in values if k != "token"])
        path = "/" + scope["path"].lstrip("/\\")  # "//host" would lead to another server
        cookie = f"{COOKIE}={self._access.cookie}; Path=/; HttpOnly; SameSite=Lax; Max-Age={COOKIE_S}"
        return {
            "location": urlsplit(path).path + (f"?{rest}" if rest else ""),
            "set-cookie": cookie + ("; Secure" if scope.get("scheme") == "https" else ""),
        }


def _is_same(given: str, right: str) -> bool:
    return hmac.compare_digest(given.encode(), right.encode())


def _headers_of(scope: Scope) -> dict[str, str]:
    return {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}


def _token_in(scope: Scope) -> str:
    return parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]


def _cookie_of(headers: dict[str, str]) -> str:
    pairs = (pair.strip().partition("=") for pair in headers.get("cookie", "").split(";"))
    return next((value for name, _, value in pairs if name == COOKIE), "")


def _is_own(host: str, names: frozenset[str]) -> bool:
    """Whether a Host header names this server; a page elsewhere can only point a name at it, no address."""
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
