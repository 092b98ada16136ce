"""`labseq web`: starts the server."""

from __future__ import annotations

import json
import os
import socket
import ssl
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from labseq.console.output import say
from labseq.errors import ConfigError, Problem
from labseq.files import data_root
from labseq.messages import install_hint, visible
from labseq.processes import Process, is_loopback
from labseq.web.access import Access, find_token, server_names

HOST: Final = "127.0.0.1"
PORT: Final = 8642
_PORTS: Final = 20
"""Number of ports that `labseq run --web` tries."""


@dataclass(frozen=True, slots=True)
class Serving:
    """Settings of the server.

    Attributes:
        host: Address to listen on.
        port: Port to listen on. 0 for any free port.
        names: Further names of the server, such as the name of a proxy.
        certificate: PEM file of the certificate, for TLS.
        key: PEM file of its key.
        control: Whether visitors may make changes.
        calibration_age_s: Age of a calibration in use at which an alarm is raised.
        ends_with: Process id. The server ends when this process does. None: at Ctrl-C.
    """

    host: str = HOST
    port: int = PORT
    names: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    control: bool = False
    calibration_age_s: float = 7 * 86_400.0
    ends_with: int | None = None


def serve(data: Path | None, serving: Serving) -> None:
    """Serve the pages of a data folder until Ctrl-C.

    Raises:
        ConfigError: The package is missing, the folder or a certificate does not exist, the port is taken,
            or notify.yaml has an error.
    """
    check_packages()
    import uvicorn

    from labseq.kernels.kernel import interpret
    from labseq.session.notices import FREE_GB, NoticeSettings
    from labseq.web.app import make_app
    from labseq.web.connections import LimitedProtocol
    from labseq.web.state import Limits

    root = (data or data_root()).expanduser().absolute()
    if data is not None and not root.is_dir():
        raise ConfigError(Problem("there is no such folder", visible(str(root)), expected="a data folder"))
    tls = _tls(serving.certificate, serving.key)
    notices = NoticeSettings.read(root)
    limits = Limits(serving.calibration_age_s, FREE_GB if notices is None else notices.free_gb)
    is_open = is_loopback(serving.host) and not serving.names
    token = "" if is_open and not serving.control else find_token()
    listener = _listener(serving.host, serving.port)
    interpret()  # plain Python is fast enough for the motion of one cycle, and numba takes 100 MB
    app = make_app(root, Access(token, server_names(serving.names), serving.control), limits)
    for line in _greeting(root, serving, listener.getsockname()[1], token):
        say(line)
    config = uvicorn.Config(
        app,  # pyright: ignore[reportArgumentType]
        # uvloop reads from a new connection although it is paused, and the handshake would lose its beginning
        loop="auto" if tls is None else "asyncio",
        http=partial(LimitedProtocol, tls=tls),  # pyright: ignore[reportArgumentType]
        log_level="critical",  # errors are in the answers
        access_log=False,
        server_header=False,
        ws="none",
        lifespan="off",
        limit_concurrency=400,
        timeout_keep_alive=20,
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    if serving.ends_with is not None:
        threading.Thread(target=_end_with, args=(serving.ends_with, server), daemon=True).start()
    with suppress(KeyboardInterrupt):
        server.run(sockets=[listener])


def check_packages() -> None:
    """Check that the extra is installed.

    Raises:
        ConfigError: A package is missing.
    """
    needed = {name: name for name in ("starlette", "uvicorn", "httptools", "uvloop")} | {"PIL": "Pillow"}
    if os.name == "nt":
        del needed["uvloop"]
    for module, name in needed.items():
        if find_spec(module) is None:
            what = f"showing runs in a browser needs {name}, which is not installed"
            raise ConfigError(Problem(what, hint=install_hint("web")))


def _tls(certificate: Path | None, key: Path | None) -> ssl.SSLContext | None:
    """The certificate and its key. None without a certificate.

    Raises:
        ConfigError: A file is missing, or is not a certificate or key.
    """
    for path in (certificate, key):
        if path is not None and not path.is_file():
            raise ConfigError(Problem("there is no such file", visible(str(path)), expected="a PEM file"))
    if certificate is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key)
    except OSError as error:
        what = f"it cannot be used: {error.strerror or error}"
        expected = "a PEM file with the certificate, and its key there or in --key"
        raise ConfigError(Problem(what, visible(str(certificate)), expected=expected)) from error
    return context


def _listener(host: str, port: int) -> socket.socket:
    """Open a listening socket.

    Raises:
        ConfigError: The address is wrong, or the port is taken.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.socket(family, socket.SOCK_STREAM)
        if os.name != "nt":  # Windows would let another process take the port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(128)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        hint = "choose another port with --port, unless the server is already running"
        raise ConfigError(Problem(f"{host}:{port} cannot be used: {reason}", hint=hint)) from error
    return listener


def _greeting(root: Path, serving: Serving, port: int, token: str) -> list[str]:
    scheme = "https" if serving.certificate else "http"
    any_address = serving.host in ("0.0.0.0", "::")  # noqa: S104 - compared, not bound
    host = serving.names[0] if serving.names else socket.gethostname() if any_address else serving.host
    host = f"[{host}]" if ":" in host else host
    query = f"?token={token}" if token else ""
    lines = [f"{scheme}://{host}:{port}/{query}", f"shows {root}; Ctrl-C ends it"]
    if not is_loopback(serving.host) and not serving.certificate:
        lines.append(
            "warning: without TLS, everybody on this network can read all traffic, including the token"
        )
    return lines


def _end_with(pid: int, server: Any) -> None:
    """Wait until a process has ended, then end the server."""
    process = _process(pid)
    while process is not None and process.is_running:
        time.sleep(2.0)
    server.should_exit = True


def _process(pid: int) -> Process | None:
    import psutil

    try:
        psutil.Process(pid)
    except psutil.Error:
        return None
    return Process(pid, 0.0, Process.current().host)


def start_for_run(root: Path) -> str:
    """Start a server for a run in its own process, unless this data folder already has one.

    Returns:
        The line to print, with the address and when it ends.

    Raises:
        ConfigError: There is no free port, or a package is missing.
    """
    check_packages()
    root = root.expanduser().absolute()
    for port in range(PORT, PORT + _PORTS):
        address = f"http://{HOST}:{port}/"
        with socket.socket() as probe:
            is_taken = probe.connect_ex((HOST, port)) == 0
        if is_taken and _serves(address, root):
            return f"{address} shows this run"
        if not is_taken:
            pid = _spawn(root, port)
            return f"{address} shows this run (process {pid}, which ends with this terminal)"
    raise ConfigError(
        Problem(f"the ports {PORT} to {PORT + _PORTS - 1} are taken", hint="start `labseq web`")
    )


def _serves(address: str, root: Path) -> bool:
    """Whether a server for this data folder answers at an address."""
    address = f"{address}api/v1/server"
    with suppress(OSError, ValueError, KeyError), urllib.request.urlopen(address, timeout=2.0) as answer:  # noqa: S310 - loopback
        return bool(json.loads(answer.read(10_000))["data"] == visible(str(root)))
    return False


def _spawn(root: Path, port: int) -> int:
    root.mkdir(parents=True, exist_ok=True)
    command = [
        sys.executable,
        "-m",
        "labseq",
        "web",
        str(root),
        f"--port={port}",
        f"--ends-with={os.getppid()}",
    ]
    # Ctrl-C in the terminal must end only the run
    own_group: dict[str, Any] = (
        {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}  # type: ignore[attr-defined]
        if os.name == "nt"
        else {"process_group": 0}
    )
    nothing = subprocess.DEVNULL
    process = subprocess.Popen(  # noqa: S603 - this Python
        command, stdin=nothing, stdout=nothing, stderr=nothing, **own_group
    )
    process.returncode = 0  # it outlives the run, so Popen must not warn that it was not waited for
    return process.pid
