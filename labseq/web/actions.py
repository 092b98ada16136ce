"""API endpoints that change something, which exist only on a server started with `--control`."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path, PureWindowsPath
from threading import Lock
from typing import Any, Final, cast

from starlette.requests import Request

from labseq.config.document import Document
from labseq.config.find import is_path
from labseq.config.yaml_nodes import compose
from labseq.errors import ConfigError, Problem
from labseq.files import SEQUENCES, packaged_sequences_dir
from labseq.messages import clean
from labseq.queue.queue import Queue
from labseq.recording.notes import Notes, write_notes
from labseq.recording.run_file import read_state
from labseq.session.stopping import ask_to_stop
from labseq.web.endpoint import Endpoint, in_thread
from labseq.web.runs import Catalogue, NoSuchRun, text_of

MAX_BODY: Final = 64 << 10
CHECK_S: Final = 60.0
"""Time limit to check a sequence, in seconds. The first check compiles kernels."""
_NOT_IN_FORM: Final = frozenset({"labseq", "name", "profile", "plugin_folders", "use", "pattern"})
"""Keys that identify the sequence rather than say how it runs."""
_LIMITS: Final = {"minimum": "min", "maximum": "max"}

Schema = Mapping[str, Any]


class Actions:
    """The endpoints that change something.

    Sequences are checked in a separate process, so that the server stays small whatever plugins they use.
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
                body={"comment": "the comment, which replaces the previous one", "tags": "list of tags"},
            ),
            Endpoint(
                "/queue/add",
                self.add,
                method="POST",
                body={
                    "sequence": "name of a known sequence",
                    "profile": "name of a profile (default: the sequence's own)",
                    "changes": "address -> value",
                },
            ),
            Endpoint(
                "/queue/move", self.move, method="POST", body={**number, "before": "number of another entry"}
            ),
            Endpoint("/queue/remove", self.remove, method="POST", body=number),
            Endpoint("/queue/resume", self.resume, method="POST", body=number),
            Endpoint("/queue/pause", self.pause, method="POST", body={"paused": "true or false"}),
        ]

    def sequences(self, _: Request) -> Any:
        """The sequences that can be queued, from ./sequences and from labseq."""
        return {"sequences": [*_sequences()]}

    def form(self, request: Request) -> Any:
        """The values of a sequence, each with its description from the schema."""
        name = request.path_params["sequence"]
        path = _sequences().get(name)
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
        if not isinstance(comment, str):
            raise ConfigError(Problem("the comment is not a text"))
        if not isinstance(tags, list) or not all(isinstance(tag, str) for tag in tags):  # pyright: ignore[reportUnknownVariableType]
            raise ConfigError(Problem("the tags are not a list of texts"))
        write_notes(run.folder, Notes.of(comment, tags))  # pyright: ignore[reportUnknownArgumentType]
        return {"done": "saved"}

    async def add(self, request: Request) -> Any:
        """Check a known sequence with changed values, and add it at the end of the queue."""
        values = await body_of(request)
        path = _sequences().get(str(values.get("sequence")))
        if path is None:
            raise ConfigError(Problem("there is no such sequence", expected="one of /api/v1/sequences"))
        return await in_thread(partial(self._add, path, values))

    def _add(self, path: Path, values: Mapping[str, Any]) -> dict[str, str]:
        changes: Any = values.get("changes") or {}
        if not isinstance(changes, dict) or len(changes) > 100:  # pyright: ignore[reportUnknownArgumentType]
            raise ConfigError("the changes are not a mapping of addresses to values")
        data = Document.read(path).data
        addresses = {field["address"] for field in form_fields(data, self._schemas())}
        if unknown := [*{str(address) for address in changes} - addresses]:  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
            # --set could also change plugin folders and devices, which visitors must not
            raise ConfigError(Problem(f"'{clean(unknown[0])}' is not a value of the form"))
        for address, value in changes.items():  # pyright: ignore[reportUnknownVariableType]
            # a mapping in place of a value could name a file
            node = compose(str(value), f"--set {address}", is_option=True)
            if node is not None and isinstance(node.value, dict | list):
                raise ConfigError(Problem(f"'{clean(str(address))}' is not a single value"))  # pyright: ignore[reportUnknownArgumentType]
        options = [f"--set={address}={value}" for address, value in changes.items()]  # pyright: ignore[reportUnknownVariableType]
        if profile := str(values.get("profile") or ""):
            if is_path(profile) or PureWindowsPath(profile).drive:
                raise ConfigError(Problem(f"'{clean(profile)}' is a path", expected="the name of a profile"))
            options.append(f"--profile={profile}")
        command = ["queue", "add", str(path), *options]
        return {"done": self._labseq(command, {"LABSEQ_DATA": str(self._runs.root.absolute())}).strip()}

    async def move(self, request: Request) -> Any:
        """Put an entry of the queue before another one."""
        values = await body_of(request)
        Queue(self._runs.root).move(_whole_number(values, "entry"), _whole_number(values, "before"))
        return {"done": "moved"}

    async def remove(self, request: Request) -> Any:
        """Take an entry out of the queue. The data of its run stay."""
        number = _whole_number(await body_of(request), "entry")
        Queue(self._runs.root).remove([number])
        return {"done": f"entry {number} is removed"}

    async def resume(self, request: Request) -> Any:
        """Put a stopped, failed or skipped entry back into the queue, which then resumes its run."""
        number = _whole_number(await body_of(request), "entry")
        Queue(self._runs.root).wait_again(number)
        return {"done": f"entry {number} waits again"}

    async def pause(self, request: Request) -> Any:
        """Let the queue start no further entry until it is resumed. A run in progress continues."""
        is_paused = (await body_of(request)).get("paused")
        Queue(self._runs.root).pause(is_paused is True)
        return {"done": "paused" if is_paused is True else "continued"}

    def _schemas(self) -> dict[str, Any]:
        if self._schema is None:
            self._schema = json.loads(self._labseq(["schema", "sequence"], {}))
        assert self._schema is not None
        return self._schema

    def _labseq(self, arguments: list[str], variables: dict[str, str]) -> str:
        """Run a labseq command and return its output.

        Raises:
            ConfigError: The command reports a mistake.
        """
        import os

        with self._checking:  # one at a time, because each takes a core
            try:
                done = subprocess.run(  # noqa: S603 - no shell, and every value is part of one argument
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


def _sequences() -> dict[str, Path]:
    """Name -> file of the sequences that can be queued."""
    files: dict[str, Path] = {}
    for folder in (Path(SEQUENCES).absolute(), packaged_sequences_dir()):
        with suppress(OSError):
            for path in sorted(folder.iterdir()):
                if path.suffix.lower() in (".yaml", ".yml") and path.is_file():
                    files.setdefault(path.stem, path)
    return files


def _whole_number(values: Mapping[str, Any], name: str) -> int:
    value = values.get(name)
    if type(value) is not int:
        raise ConfigError(Problem(f"'{name}' is not a whole number"))
    return value


async def body_of(request: Request) -> dict[str, Any]:
    """The JSON object in the body of a request.

    Raises:
        ConfigError: The body is too long, or not a JSON object.
    """
    content = b""
    async for part in request.stream():
        content += part
        if len(content) > MAX_BODY:
            raise ConfigError(Problem("the request is too long", expected=f"at most {MAX_BODY >> 10} KiB"))
    try:
        values = json.loads(content or b"{}")
    except (ValueError, RecursionError) as error:
        raise ConfigError("the request is not JSON") from error
    if not isinstance(values, dict):
        raise ConfigError("the request is not a JSON object")
    return values  # pyright: ignore[reportUnknownVariableType]


def form_fields(data: Mapping[str, Any], schema: Schema) -> list[dict[str, Any]]:
    """The values of a sequence that `--set` can change, as JSON-ready values.

    Args:
        data: The content of the sequence's file, as plain values.
        schema: The JSON schema of sequences.

    Returns:
        For each value its ``address``, ``value``, ``default``, ``about``, ``choices``, ``min`` and
        ``max``. ``value`` is "" if the file does not give one.
    """
    definitions: Schema = schema.get("definitions") or {}
    return list(_mapping_fields(data, schema, definitions, ""))[:300]


def _mapping_fields(
    data: Mapping[str, Any], schema: Schema, definitions: Schema, prefix: str
) -> Iterator[dict[str, Any]]:
    properties = _properties(schema, definitions, data)
    for key in dict.fromkeys((*data, *properties)):
        about, value = _resolved(properties.get(key) or {}, definitions), data.get(key)
        # a path would let visitors find out which files the computer has
        if key in _NOT_IN_FORM or key == "scan" or "path" in about.get("format", ""):
            continue
        address = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _mapping_fields(cast("dict[str, Any]", value), about, definitions, f"{address}.")
        elif key == "shot" and isinstance(value, list):
            yield from _step_fields(cast("list[Any]", value), about, definitions)
        elif isinstance(value, list) or (value is None and not _is_scalar(about)):
            continue
        else:
            yield _field(address, value, about)


def _step_fields(steps: list[Any], schema: Schema, definitions: Schema) -> Iterator[dict[str, Any]]:
    kinds = _properties(schema.get("items") or {}, definitions, {})
    for i, step in enumerate(steps):
        for kind, settings in cast("dict[str, Any]", step).items() if isinstance(step, dict) else ():
            if kind not in ("name", "policy"):
                about = _resolved(kinds.get(kind) or {}, definitions)
                yield from _mapping_fields(settings or {}, about, definitions, f"shot.{i}.{kind}.")


def _properties(schema: Schema, definitions: Schema, data: Mapping[str, Any]) -> dict[str, Any]:
    """The properties of a mapping, including those of the plugin that it chooses."""
    properties = dict(schema.get("properties") or {})
    for rule in schema.get("allOf") or ():
        if "$ref" in rule:
            properties |= _properties(_resolved(rule, definitions), definitions, data)
        condition: Mapping[str, Any] = rule.get("if", {}).get("properties", {})
        if condition and all(data.get(key) == value.get("const") for key, value in condition.items()):
            properties |= _properties(_resolved(rule.get("then") or {}, definitions), definitions, data)
    return properties


def _resolved(schema: Schema, definitions: Schema) -> Schema:
    """A schema with its reference filled in. With several alternatives, the first that is not null."""
    if "$ref" in schema:
        return {**(definitions.get(str(schema["$ref"]).rpartition("/")[2]) or {}), **schema}
    alternatives = [option for option in schema.get("anyOf") or () if option.get("type") != "null"]
    if alternatives:
        return {
            **_resolved(alternatives[0], definitions),
            **{k: v for k, v in schema.items() if k != "anyOf"},
        }
    return schema


def _is_scalar(schema: Schema) -> bool:
    kinds = schema.get("type")
    return "enum" in schema or not {"object", "array"} & (
        {kinds} if isinstance(kinds, str) else {*(kinds or ())}
    )


def _field(address: str, value: Any, schema: Schema) -> dict[str, Any]:
    kinds: Any = schema.get("type")
    choices = [text_of(choice, 80) for choice in schema.get("enum") or ()]
    if kinds == "boolean" or isinstance(value, bool):
        choices = ["true", "false"]
    limits = {
        name: schema[key]
        for key, name in _LIMITS.items()
        if isinstance(schema.get(key), int | float) and schema.get("maximum") != 0
    }
    return {
        "address": address,
        "value": _written(value),
        "default": _written(schema.get("default")),
        "about": text_of(schema.get("description") or "", 400),
        "choices": choices,
        **limits,
    }


def _written(value: Any) -> str:
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else text_of(value, 400)
