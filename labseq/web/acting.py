"""What visitors may do if the server is started with `--control`."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, Final

from starlette.requests import Request

from labseq.config.document import Document
from labseq.config.find import is_path
from labseq.errors import ConfigError, Problem
from labseq.files import SEQUENCES, packaged_sequences_dir
from labseq.messages import clean
from labseq.queue.queue import Queue
from labseq.recording.run_file import read_state
from labseq.session.stopping import ask_to_stop
from labseq.web.endpoint import Endpoint, in_thread
from labseq.web.form import form_fields
from labseq.web.runs import MAX_NOTE, Catalogue, NoSuchRun, text_of, write_notes

MAX_BODY: Final = 64 << 10
CHECK_S: Final = 60.0
"""Longest time to check a sequence, in seconds; the first time kernels are compiled."""
_MAX_CHANGES: Final = 100


class Actions:
    """The endpoints that change something.

    Sequences are checked in a process of their own, so that the server stays small whatever plugins they use.

    Args:
        catalogue: The runs.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        self._runs = catalogue
        self._checking = Lock()
        self._schema: dict[str, Any] | None = None

    def endpoints(self) -> list[Endpoint]:
        """The endpoints, for the API."""
        run = "/runs/{day}/{name}"
        number = {"entry": "number of the entry"}
        return [
            Endpoint("/sequences", self.sequences),
            Endpoint("/sequences/{sequence}", self.form),
            Endpoint(f"{run}/stop", self.stop, method="POST", body={}),
            Endpoint(
                f"{run}/notes",
                self.notes,
                method="POST",
                body={"comment": "the comment; replaces the one before", "tags": "list of tags"},
            ),
            Endpoint(
                "/queue/add",
                self.add,
                method="POST",
                body={
                    "sequence": "name of a known sequence",
                    "profile": "name of a profile; the sequence's own by default",
                    "changes": "address -> value",
                },
            ),
            Endpoint(
                "/queue/move", self.move, method="POST", body={**number, "before": "number of another entry"}
            ),
            Endpoint("/queue/pause", self.pause, method="POST", body={"paused": "true or false"}),
        ]

    def sequences(self, _: Request) -> Any:
        """The sequences that can be queued: those in ./sequences, and those that come with labseq."""
        return {"sequences": [*_known()]}

    def form(self, request: Request) -> Any:
        """The values of a sequence, with what the schema says of each."""
        name = request.path_params["sequence"]
        path = _known().get(name)
        if path is None:
            raise NoSuchRun(f"there is no sequence '{text_of(name, 80)}'")
        data = Document.read(path).data
        return {
            "sequence": name,
            "profile": data.get("profile"),
            "fields": form_fields(data, self._schemas()),
        }

    async def stop(self, request: Request) -> Any:
        """End a run after its current shot."""
        await body_of(request)
        run = self._runs.open(request.path_params["day"], request.path_params["name"])
        if read_state(run.folder)[0] != "running":
            raise ConfigError("the run is not in progress")
        ask_to_stop(run.folder)
        return {"done": f"{run.id} ends after its current shot"}

    async def notes(self, request: Request) -> Any:
        """Replace comment and tags of a run."""
        values = await body_of(request)
        run = self._runs.open(request.path_params["day"], request.path_params["name"])
        comment, tags = values.get("comment", ""), values.get("tags", [])
        if not isinstance(comment, str) or len(comment) > MAX_NOTE:
            raise ConfigError(Problem("the comment is too long", expected=f"at most {MAX_NOTE} characters"))
        if not isinstance(tags, list) or not all(isinstance(tag, str) for tag in tags):  # pyright: ignore[reportUnknownVariableType]
            raise ConfigError(Problem("the tags are no list of texts"))
        write_notes(run.folder, comment, tags)  # pyright: ignore[reportUnknownArgumentType]
        return {"done": "kept"}

    async def add(self, request: Request) -> Any:
        """Check a known sequence with changed values, and add it at the end of the queue."""
        values = await body_of(request)
        path = _known().get(str(values.get("sequence")))
        if path is None:
            raise ConfigError(Problem("there is no such sequence", expected="one of /api/v1/sequences"))
        return await in_thread(partial(self._add, path, values))

    def _add(self, path: Path, values: Mapping[str, Any]) -> dict[str, str]:
        changes: Any = values.get("changes") or {}
        if not isinstance(changes, dict) or len(changes) > _MAX_CHANGES:  # pyright: ignore[reportUnknownArgumentType]
            raise ConfigError("the changes are no mapping of addresses to values")
        data = Document.read(path).data
        known = {field["address"] for field in form_fields(data, self._schemas())}
        if unknown := [*{str(address) for address in changes} - known]:  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
            # not what --set can do beyond: plugin folders and devices are the lab's own
            raise ConfigError(Problem(f"'{clean(unknown[0])}' is no value of the form"))
        options = [f"--set={address}={value}" for address, value in changes.items()]  # pyright: ignore[reportUnknownVariableType]
        if profile := str(values.get("profile") or ""):
            if is_path(profile):
                raise ConfigError(Problem(f"'{clean(profile)}' is a path", expected="the name of a profile"))
            options.append(f"--profile={profile}")
        command = ["queue", "add", str(path), *options]
        return {"done": self._labseq(command, {"LABSEQ_DATA": str(self._runs.root.absolute())}).strip()}

    async def move(self, request: Request) -> Any:
        """Put an entry of the queue before another one."""
        values = await body_of(request)
        Queue(self._runs.root).move(_whole(values, "entry"), _whole(values, "before"))
        return {"done": "moved"}

    async def pause(self, request: Request) -> Any:
        """Let the queue start no further entry until it is continued; a run in progress goes on."""
        is_paused = (await body_of(request)).get("paused")
        Queue(self._runs.root).pause(is_paused is True)
        return {"done": "paused" if is_paused is True else "continued"}

    def _schemas(self) -> dict[str, Any]:
        if self._schema is None:
            self._schema = json.loads(self._labseq(["schema", "sequence"], {}))
        assert self._schema is not None
        return self._schema

    def _labseq(self, arguments: list[str], variables: dict[str, str]) -> str:
        """What a command prints.

        Raises:
            ConfigError: It reports a mistake.
        """
        import os

        with self._checking:  # one at a time: each takes a core
            try:
                done = subprocess.run(  # noqa: S603 - no shell; every value is part of one argument
                    [sys.executable, "-m", "labseq", *arguments],
                    env={**os.environ, **variables},
                    stdin=subprocess.DEVNULL,
                    capture_output=True,
                    timeout=CHECK_S,
                    check=False,
                )
            except subprocess.TimeoutExpired as error:
                raise ConfigError(
                    f"checking took longer than {CHECK_S:.0f} s; use `labseq queue add`"
                ) from error
        if done.returncode:
            raise ConfigError(text_of(done.stderr.decode("utf-8", "replace").strip(), 4000))
        return done.stdout.decode("utf-8", "replace")


def _known() -> dict[str, Path]:
    """Name -> file of the sequences that can be queued."""
    found: dict[str, Path] = {}
    for folder in (Path(SEQUENCES).absolute(), packaged_sequences_dir()):
        with suppress(OSError):
            for path in sorted(folder.iterdir()):
                if path.suffix.lower() in (".yaml", ".yml") and path.is_file():
                    found.setdefault(path.stem, path)
    return found


def _whole(values: Mapping[str, Any], name: str) -> int:
    value = values.get(name)
    if type(value) is not int:
        raise ConfigError(Problem(f"'{name}' is no whole number"))
    return value


async def body_of(request: Request) -> dict[str, Any]:
    """The JSON object in the body of a request.

    Raises:
        ConfigError: It is too long, or no JSON object.
    """
    content = b""
    async for part in request.stream():
        content += part
        if len(content) > MAX_BODY:
            raise ConfigError(Problem("the request is too long", expected=f"at most {MAX_BODY >> 10} KiB"))
    try:
        values = json.loads(content or b"{}")
    except (ValueError, RecursionError) as error:
        raise ConfigError("the request is no JSON") from error
    if not isinstance(values, dict):
        raise ConfigError("the request is no JSON object")
    return values  # pyright: ignore[reportUnknownVariableType]
