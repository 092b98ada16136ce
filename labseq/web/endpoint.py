"""Endpoints of the API: what they are, how a request is answered, and how OpenAPI describes them."""

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
_DESCRIPTIONS: Final = {
    "day": "date of the run's folder, 2026-11-20",
    "name": "name of the run's folder, 0001_compact-225",
    "shot": "index of the shot, from 0",
    "image": "index of the image in the shot, from 0",
    "attempt": "an attempt that does not count; without it the shot that counts",
    "q": "words that date, name, profile, outcome, comment or tags must contain",
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
    """An address of the API; its description is the docstring of its function.

    Attributes:
        path: Below /api/v1.
        answer: Makes the answer from the request; called in a thread unless it is a coroutine.
        query: Names of its query parameters.
        content: Media type of the answer.
        method: "GET" or "POST".
        body: Names of the values in the body of a POST, and what they are.
    """

    path: str
    answer: Callable[..., Any]
    query: tuple[str, ...] = ()
    content: str = "application/json"
    method: str = "GET"
    body: Mapping[str, str] | None = None

    @property
    def description(self) -> str:
        """What it answers."""
        return inspect.cleandoc(self.answer.__doc__ or "").partition("\n\n")[0].replace("\n", " ")


async def answered(one: Endpoint, request: Request) -> Response:
    """Answer a request; what cannot be shown is a reason in the answer, never a crash."""
    try:
        if inspect.iscoroutinefunction(one.answer):
            found = await one.answer(request)
        else:
            found = await in_thread(partial(one.answer, request))
    except NoSuchRun as error:
        return JSONResponse({"error": text_of(error)}, 404)
    except (LabseqError, OSError) as error:
        return JSONResponse({"error": text_of(error)}, 409)
    except Exception as error:  # noqa: BLE001 - a file with other values than expected
        what = f"a file of it has values that cannot be read: {format_error(error)}"
        return JSONResponse({"error": text_of(what)}, 409)
    if isinstance(found, Response):
        return found
    content = encode(to_plain(found))
    return Response(content, media_type="application/json", headers={"cache-control": "no-store"})


async def in_thread(work: Callable[[], T]) -> T:
    """Do what takes time in one of a few threads: each keeps memory of its own."""
    return await asyncio.get_running_loop().run_in_executor(_THREADS, work)


def encode(values: object) -> str:
    """A value as JSON of one line."""
    return json.dumps(values, allow_nan=False, separators=(",", ":"), default=str)


def describe(one: Endpoint) -> dict[str, Any]:
    """The operation of an endpoint for OpenAPI."""
    in_path = [part.partition("}")[0] for part in one.path.split("{")[1:]]
    parameters = [_parameter(name, "path") for name in in_path] + [_parameter(n, "query") for n in one.query]
    found: dict[str, Any] = {
        "operationId": getattr(one.answer, "__name__", "answer"),
        "summary": one.description,
        "parameters": parameters,
        "responses": {
            "200": {"description": "as described", "content": {one.content: {}}},
            "404": {"description": "there is no such thing"},
            "409": {"description": "it cannot be read, or not be done; 'error' says why"},
        },
    }
    if one.body is not None:
        keys = {name: {"description": about} for name, about in one.body.items()}
        schema = {"type": "object", "properties": keys}
        found["requestBody"] = {"required": True, "content": {"application/json": {"schema": schema}}}
    return found


def _parameter(name: str, place: str) -> dict[str, Any]:
    is_number = name in ("shot", "image", "attempt", "first", "n", "width")
    return {
        "name": name,
        "in": place,
        "required": place == "path",
        "description": _DESCRIPTIONS.get(name, name),
        "schema": {"type": "integer" if is_number else "string"},
    }
