"""Who is let in, and what is refused."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest

from labseq.errors import ConfigError
from labseq.web.access import COOKIE, CSP, Access, Rate, find_token
from labseq.web.app import STATIC
from labseq.web.serve import Serving, serve

from .clients import TOKEN, Client, client_of


class Clock:
    """The clock of the rates, which stands still."""

    now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr("labseq.web.access.time", found)
    return found


@pytest.fixture
def locked(tmp_path: Path) -> Client:
    return client_of(tmp_path, token=TOKEN)


ADDRESSES = ("/", "/runs", "/static/app.js", "/api/v1/now", "/api/v1/openapi.json", "/metrics", "/nothing")


@pytest.mark.parametrize("path", ADDRESSES)
def test_without_the_token_nothing_is_shown(path: str, locked: Client) -> None:
    assert locked.get(path).status_code == 401
    for wrong in ("x", TOKEN[:-1], TOKEN + "x", ""):
        assert locked.get(path, cookie=f"{COOKIE}={wrong}").status_code == 401
    answer = locked.get(f"{path}?token={'y' * 40}")
    assert answer.status_code == 401
    assert "set-cookie" not in answer.headers


def test_token_becomes_a_cookie_and_leaves_the_address(locked: Client) -> None:
    first = locked.get(f"/runs?q=a&token={TOKEN}")
    assert (first.status_code, first.headers["location"]) == (303, "/runs?q=a")
    cookie = first.headers["set-cookie"]
    assert TOKEN not in cookie
    assert all(word in cookie for word in ("HttpOnly", "SameSite=Lax", "Path=/", "Max-Age="))
    assert "Secure" not in cookie
    kept = cookie.partition(";")[0]
    for path in ("/", "/api/v1/now", "/metrics"):
        assert locked.get(path, cookie=f"other=1; {kept}").status_code == 200
    assert locked.get("/api/v1/now", authorization=f"Bearer {TOKEN}").status_code == 200
    locked.scheme = "https"
    assert "Secure" in locked.get(f"/?token={TOKEN}").headers["set-cookie"]


def test_first_visit_leads_to_no_other_server(locked: Client) -> None:
    for path in ("//evil.example/", "/\\evil.example"):
        assert locked.get(f"{path}?token={TOKEN}").headers["location"].count("/") >= 1
        assert not locked.get(f"{path}?token={TOKEN}").headers["location"].startswith(("//", "/\\", "http"))


def test_guessing_is_slowed_and_does_not_lock_out_the_others(locked: Client, clock: Clock) -> None:
    codes = [locked.get(f"/?token={i:040}").status_code for i in range(12)]
    assert codes == [401] * 10 + [429] * 2
    assert locked.get(f"/?token={TOKEN}").status_code == 429
    other = Client(locked.app, "10.0.0.7")
    assert other.get(f"/?token={TOKEN}").status_code == 303
    cookie = Access(TOKEN).cookie
    assert locked.get("/", cookie=f"{COOKIE}={cookie}").status_code == 200
    clock.now_s += 5.1
    assert locked.get("/?token=wrong").status_code == 401
    assert locked.get("/?token=wrong").status_code == 429


def test_the_right_token_is_no_guess(locked: Client, clock: Clock) -> None:
    """A program sends it with each request; a wrong one now and then does not count double."""
    for _ in range(9):
        assert locked.get("/api/v1/now", authorization="Bearer wrong").status_code == 401
    for _ in range(30):
        assert locked.get("/api/v1/now", authorization=f"Bearer {TOKEN}").status_code == 200
    assert locked.get("/api/v1/now", authorization="Bearer wrong").status_code == 401
    assert locked.get("/api/v1/now", authorization=f"Bearer {TOKEN}").status_code == 429


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:8642", 200),
        ("localhost", 200),
        ("LOCALHOST:1", 200),
        ("[::1]:8642", 200),
        ("192.168.1.5", 200),
        ("evil.example", 421),
        ("localhost.evil.example", 421),
        ("", 421),
        ("[", 421),
        ("a@127.0.0.1@evil.example", 421),
    ],
)
def test_names_that_are_not_the_servers_are_refused(host: str, status: int, tmp_path: Path) -> None:
    """A page elsewhere may point its own name at this server (DNS rebinding)."""
    assert client_of(tmp_path).get("/api/v1/server", host=host).status_code == status
    assert client_of(tmp_path, names=frozenset({"lab"})).get("/api/v1/server", host="lab").status_code == 200


@pytest.mark.parametrize("origin", ["http://[", "http://[::1", "//[x]"])
def test_an_origin_that_is_no_address_is_malformed(tmp_path: Path, origin: str) -> None:
    answer = client_of(tmp_path, may_act=True).get("/api/v1/server", origin=origin)
    assert answer.status_code == 400


def test_other_pages_cannot_read_or_act(tmp_path: Path) -> None:
    client = client_of(tmp_path, may_act=True)
    other = {"origin": "http://evil.example"}
    answer = client.get("/api/v1/now", **other)
    assert answer.status_code == 403
    assert not any(name.startswith("access-control") for name in answer.headers)
    assert client.get("/api/v1/now", sec_fetch_site="cross-site", sec_fetch_mode="no-cors").status_code == 403
    assert client.get("/", sec_fetch_site="cross-site", sec_fetch_mode="navigate").status_code == 200
    path = "/api/v1/queue/pause"
    assert client.post(path, {"paused": True}).status_code == 200
    assert client.post(path, {"paused": True}, origin="http://127.0.0.1:9").status_code == 403
    assert client.post(path, {"paused": True}, origin="null").status_code == 403
    assert client.post(path, {"paused": True}, content_type="text/plain").status_code == 403
    assert client.request("POST", path, {"content-type": "application/json"}, b"{}").status_code == 403


def test_without_control_nothing_can_be_changed(run_dir: Path) -> None:
    client = client_of(run_dir.parent.parent)
    path = f"/api/v1/runs/{run_dir.parent.name}/{run_dir.name}/notes"
    assert client.post(path, {"comment": "x"}).status_code == 405
    for method in ("PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"):
        assert client.request(method, path, {"origin": "http://127.0.0.1:8642"}).status_code == 405
    assert not (run_dir / "notes.json").exists()


def test_every_answer_has_the_headers(tmp_path: Path, locked: Client) -> None:
    client = client_of(tmp_path)
    for answer in (client.get("/"), client.get("/api/v1/now"), client.get("/nothing"), locked.get("/")):
        assert answer.headers["content-security-policy"] == CSP
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
    assert "unsafe" not in CSP


def test_pages_have_no_inline_script_or_style_and_make_no_markup_of_texts() -> None:
    for path in STATIC.glob("*.html"):
        assert "style=" not in path.read_text("utf-8")
    banned = (
        "innerHTML",
        "outerHTML",
        "insertAdjacentHTML",
        "document.write",
        "eval(",
        "http://",
        "https://",
    )
    for path in STATIC.iterdir():
        if path.name.startswith("uPlot") or path.suffix == ".svg":
            continue
        text = path.read_text("utf-8").replace("http://www.w3.org/2000/svg", "")
        assert not [word for word in banned if word in text], path


def test_too_many_requests_are_refused(tmp_path: Path, clock: Clock) -> None:
    client = client_of(tmp_path, may_act=True)
    codes = [client.get("/static/icon.svg").status_code for _ in range(601)]
    assert codes == [200] * 600 + [429]
    other = Client(client.app, "10.0.0.7")
    pauses = [other.post("/api/v1/queue/pause", {"paused": True}).status_code for _ in range(21)]
    assert pauses == [200] * 20 + [429]
    clock.now_s += 1.0
    assert [client.get("/static/icon.svg").status_code for _ in range(301)] == [200] * 300 + [429]
    assert [other.post("/api/v1/queue/pause", {}).status_code for _ in range(3)] == [200, 200, 429]
    clock.now_s += 1e6  # however long nothing was asked for
    assert [client.get("/static/icon.svg").status_code for _ in range(601)] == codes


def test_addresses_that_are_not_remembered_begin_again() -> None:
    """The limits need a bounded memory, however many addresses there are."""
    rate = Rate(0.0, 1.0)
    assert [rate.allows("a"), rate.allows("a")] == [True, False]
    for i in range(1000):
        rate.allows(str(i))
    assert rate.allows("a")


def test_connections_that_nobody_reads_are_closed(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq.web.access.SEND_S", 0.05)
    app = client_of(run_dir.parent.parent).app
    scope: dict[str, Any] = {
        "type": "http",
        "method": "GET",
        "path": "/api/v1/events",
        "query_string": b"",
        "scheme": "http",
        "headers": [(b"host", b"127.0.0.1")],
        "client": ("127.0.0.1", 1),
        "root_path": "",
    }

    async def never() -> Any:
        await asyncio.Event().wait()

    sent = list[str]()

    async def send(message: Any) -> None:
        sent.append(message["type"])
        if message["type"] == "http.response.body":
            await never()

    asyncio.run(asyncio.wait_for(app(scope, never, send), 30.0))
    assert sent == ["http.response.start", "http.response.body"]


def test_static_files_are_those_of_the_folder(client: Client) -> None:
    for name in ("..%2fapp.py", "%2e%2e/app.py", "../app.py", "app.py", "uPlot.LICENSE/.."):
        assert client.get(f"/static/{name}").status_code in (404, 405)


def test_token_is_made_once_and_only_for_this_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LABSEQ_STATE", str(tmp_path / "state"))
    token = find_token()
    assert (find_token(), len(token) >= 16) == (token, True)
    if os.name != "nt":
        assert (tmp_path / "state" / "web.token").stat().st_mode & 0o077 == 0
    (tmp_path / "state" / "web.token").write_text("short")
    with pytest.raises(ConfigError, match="too short"):
        find_token()
    monkeypatch.setenv("LABSEQ_WEB_TOKEN", "x" * 15)
    with pytest.raises(ConfigError, match="15 characters"):
        find_token()


@pytest.mark.parametrize(
    ("how", "what"),
    [
        ({"host": "no such host.invalid"}, "cannot be used"),
        ({"certificate": Path("none.pem")}, "no such file"),
        ({"certificate": Path(__file__)}, "expected a PEM file"),
    ],
)
def test_mistakes_are_reported(how: dict[str, Any], what: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=what):
        serve(tmp_path, Serving(port=0, **how))
    with pytest.raises(ConfigError, match="no such folder"):
        serve(tmp_path / "none", Serving(port=0))
