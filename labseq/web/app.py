"""The web application: pages and their files, the API and the metrics."""

from __future__ import annotations

import importlib
import mimetypes
import threading
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from PIL import Image
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from labseq.web.access import Access, App, Guard
from labseq.web.actions import Actions
from labseq.web.api import BASE, Api
from labseq.web.endpoint import Endpoint, answer, in_thread
from labseq.web.runs import Catalogue
from labseq.web.state import Limits

STATIC: Final = Path(__file__).parent / "static"
PLAYER: Final = Path(str(files("labseq.pictures") / "player.js"))
PAGES: Final = (
    *("/", "/now", "/scan", "/runs", "/compare", "/queue", "/calibrations", "/api"),
    *("/runs/{day}/{name}", "/runs/{day}/{name}/shots/{shot}"),
)
"""Addresses of pages. All show the same HTML file, whose script shows what the address asks for."""
_KINDS: Final = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".html": "text/html"}


def make_app(root: Path, access: Access | None = None, limits: Limits | None = None) -> App:
    """The whole application, with its guard.

    Args:
        access: Who may use it. Default: everybody who can reach it, without changing anything.
        limits: When alarms are raised.
    """
    allowed = access or Access()
    catalogue = Catalogue(root)
    importlib.import_module("scipy.special")  # takes 0.3 s, which the first answer should not
    Image.preinit()  # takes 0.1 s, likewise
    threading.Thread(target=catalogue.warm, daemon=True).start()
    api = Api(catalogue, limits or Limits(), Actions(catalogue).endpoints() if allowed.may_act else ())
    paths = (*sorted(STATIC.iterdir()), PLAYER)
    static = {path.name: _read_static(path) for path in paths if path.suffix in _KINDS}
    page = static["index.html"]

    async def show_page(_: Request) -> Response:
        return _respond_with(page)

    async def show_file(request: Request) -> Response:
        file = static.get(request.path_params["file"])
        return _respond_with(file) if file is not None else PlainTextResponse("there is no such file\n", 404)

    async def show_api(_: Request) -> Response:
        return JSONResponse(api.openapi())

    async def show_metrics(_: Request) -> Response:
        text = await in_thread(api.metrics)
        return Response(text, media_type="text/plain; version=0.0.4")

    routes = [
        *(Route(path, show_page) for path in PAGES),
        Route("/static/{file}", show_file),
        Route(f"{BASE}/openapi.json", show_api),
        Route("/metrics", show_metrics),
        *map(_route, api.endpoints()),
    ]
    return Guard(Starlette(routes=routes, exception_handlers={404: _missing}), allowed)


def _route(endpoint: Endpoint) -> Route:
    return Route(BASE + endpoint.path, partial(answer, endpoint), methods=[endpoint.method])


def _read_static(path: Path) -> tuple[bytes, str]:
    return path.read_bytes(), _KINDS.get(path.suffix) or mimetypes.guess_type(path.name)[0] or "text/plain"


def _respond_with(file: tuple[bytes, str]) -> Response:
    content, kind = file
    return Response(content, media_type=kind, headers={"cache-control": "no-cache"})


async def _missing(_: Request, error: Any) -> Response:
    return JSONResponse({"error": "there is no such page"}, getattr(error, "status_code", 404))
