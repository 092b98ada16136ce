"""A client of the application, without a network."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from labseq.model import Frame, ShotRecord
from labseq.recording.writer import RunWriter
from tests.recording.records import make_run, make_shot

TOKEN = "a token of more than sixteen"
HOST = "127.0.0.1:8642"


@dataclass
class Answer:
    status_code: int = 0
    headers: dict[str, str] = field(default_factory=dict[str, str])
    content: bytes = b""

    @property
    def text(self) -> str:
        return self.content.decode()

    def json(self) -> Any:
        return json.loads(self.content)


@dataclass
class Client:
    """Calls an ASGI application as uvicorn does."""

    app: Any
    address: str = "127.0.0.1"
    scheme: str = "http"

    def get(self, path: str, **headers: str) -> Answer:
        return self.request("GET", path, headers)

    def post(self, path: str, values: Any, **headers: str) -> Answer:
        content = values if isinstance(values, bytes) else json.dumps(values).encode()
        own = {"origin": f"{self.scheme}://{HOST}", "content-type": "application/json", **headers}
        return self.request("POST", path, own, content)

    def request(self, method: str, path: str, headers: dict[str, str], content: bytes = b"") -> Answer:
        place, _, query = path.partition("?")
        named = {"host": HOST, **{name.replace("_", "-"): value for name, value in headers.items()}}
        scope = {
            "type": "http",
            "asgi": {"version": "3.0"},
            "http_version": "1.1",
            "method": method,
            "scheme": self.scheme,
            "path": unquote(place),
            "raw_path": place.encode(),
            "root_path": "",
            "query_string": query.replace(" ", "%20").encode(),
            "headers": [(name.encode(), value.encode()) for name, value in named.items()],
            "client": (self.address, 50_000),
            "server": ("127.0.0.1", 8642),
        }
        answer = Answer()

        async def receive() -> Any:
            return {"type": "http.request", "body": content, "more_body": False}

        async def send(message: Any) -> None:
            if message["type"] == "http.response.start":
                answer.status_code = message["status"]
                answer.headers = {name.decode(): value.decode() for name, value in message["headers"]}
            else:
                answer.content += message.get("body", b"")

        asyncio.run(self.app(scope, receive, send))
        return answer


def client_of(root: Path, **access: Any) -> Client:
    from labseq.web.access import Access
    from labseq.web.app import make_app

    return Client(make_app(root, Access(**access)))


def path_of(run_dir: Path) -> str:
    return f"/api/v1/runs/{run_dir.parent.name}/{run_dir.name}"


def write_run(root: Path, n_taken: int, name: str = "compact", **record: Any) -> RunWriter:
    """Write a run that is not finished, with so many shots so far."""
    writer = RunWriter.create(root, make_run(name=name, **{"n_shots": max(1, n_taken), **record}))
    for index in range(n_taken):
        writer.write_shot(make_shot(index))
    return writer


def shot_of_frames(*frames: NDArray[np.uint16]) -> ShotRecord:
    """A shot with an image of each frame, whose sites are not known."""
    shot = make_shot(0, n_images=len(frames), batches=((1,),), sites_px=None)
    images = [
        replace(image, frame=Frame(frame, 0.045, 1.0, "camera"))
        for image, frame in zip(shot.images, frames, strict=True)
    ]
    return replace(shot, images=images)
