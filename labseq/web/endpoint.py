"""Endpoints of the API: description, answer to a request, and OpenAPI entry."""

from __future__ import annotations

import asyncio
import inspect
import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, TypeVar

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from labseq.errors import LabseqError
from labseq.messages import format_error
from labseq.plain import to_plain
from labseq.web.runs import NoSuchRun, text_of

T = TypeVar("T")
_THREADS: Final = ThreadPoolExecutor(6, "labseq web")
"""Few threads, because each keeps its own memory."""
_DESCRIPTIONS: Final = {
    "day": "date of the run's folder, 2026-11-20",
    "name": "name of the run's folder, 0001_compact-225",
    "shot": "index of the shot, from 0",
    "image": "index of the image in the shot, from 0",
    "cycle": "index of the cycle in the shot, from 0",
    "attempt": "number of an attempt that does not count (default: the attempt that counts)",
    "quantity": "quantity at the points of the scan, such as survival:before,after@target (default: what "
    "the run measures)",
    "q": "words that date, name, profile, settings, results, comment or tags must contain",
    "status": "running, complete, stopped, failed or damaged",
    "first": "number of rows to leave out",
    "n": "maximum number of rows",
    "width": "maximum height and width of the picture, in pixels",
    "kind": "which file or calibration",
    "store": "which folder of calibrations, from the list",
    "file": "name of the calibration's file",
}


@dataclass(frozen=True, slots=True)
class Endpoint:
    """An address of the API. Its description is the docstring of its function.

    Attributes:
        path: Path below /api/v1.
        answer: Makes the answer from the request. Called in a thread unless it is a coroutine.
        query: Names of its query parameters.
        content: Media type of the answer.
        method: "GET" or "POST".
        body: Names of the values in the body of a POST, and their descriptions.
    """

    path: str
    answer: Callable[..., Any]
    query: tuple[str, ...] = ()
    content: str = "application/json"
    method: str = "GET"
    body: Mapping[str, str] | None = None

    @property
    def description(self) -> str:
        """The first paragraph of its docstring."""
        return inspect.cleandoc(self.answer.__doc__ or "").partition("\n\n")[0].replace("\n", " ")


async def answer(endpoint: Endpoint, request: Request) -> Response:
    """Answer a request. An error becomes an answer that gives the reason."""
    try:
        if inspect.iscoroutinefunction(endpoint.answer):
            content = await endpoint.answer(request)
        else:
            content = await in_thread(partial(endpoint.answer, request))
    except NoSuchRun as error:
        return JSONResponse({"error": text_of(error)}, 404)
    except (LabseqError, OSError) as error:
        return JSONResponse({"error": text_of(error)}, 409)
    except Exception as error:  # noqa: BLE001 - a file with other values than expected
        message = f"one of its files has values that cannot be read: {format_error(error)}"
        return JSONResponse({"error": text_of(message)}, 409)
    if isinstance(content, Response):
        return content
    return Response(
        encode(to_plain(content)), media_type="application/json", headers={"cache-control": "no-store"}
    )


async def in_thread(work: Callable[[], T], threads: ThreadPoolExecutor = _THREADS) -> T:
    """Run a slow function in a thread, so that it does not hold up other requests."""
    return await asyncio.get_running_loop().run_in_executor(threads, work)


def encode(values: object) -> str:
    """A value as one line of JSON."""
    return json.dumps(values, allow_nan=False, separators=(",", ":"), default=str)


def describe(endpoint: Endpoint) -> dict[str, Any]:
    """The operation of an endpoint for OpenAPI."""
    in_path = [part.partition("}")[0] for part in endpoint.path.split("{")[1:]]
    parameters = [_parameter(name, "path") for name in in_path] + [
        _parameter(n, "query") for n in endpoint.query
    ]
    operation: dict[str, Any] = {
        "operationId": getattr(endpoint.answer, "__name__", "answer"),
        "summary": endpoint.description,
        "parameters": parameters,
        "responses": {
            "200": {"description": "as described", "content": {endpoint.content: {}}},
            "404": {"description": "there is no such thing"},
            "409": {"description": "it cannot be read or cannot be done, and 'error' says why"},
        },
    }
    if endpoint.body is not None:
        keys = {name: {"description": about} for name, about in endpoint.body.items()}
        schema = {"type": "object", "properties": keys}
        operation["requestBody"] = {"required": True, "content": {"application/json": {"schema": schema}}}
    return operation


def _parameter(name: str, place: str) -> dict[str, Any]:
    is_number = name in ("shot", "image", "cycle", "attempt", "first", "n", "width")
    return {
        "name": name,
        "in": place,
        "required": place == "path",
        "description": _DESCRIPTIONS.get(name, name),
        "schema": {"type": "integer" if is_number else "string"},
    }
