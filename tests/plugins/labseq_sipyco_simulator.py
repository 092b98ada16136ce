"""The part of sipyco that the ARTIQ controller uses, for machines without sipyco, which is not on PyPI.

Written after sipyco's documentation: a server hands the methods of named targets to clients, which connect
with a line that names the protocol; values are those that PYON encodes, of which this takes the types of JSON
alone; coroutines are awaited, one at a time unless `allow_parallel`; an exception of a method is raised again
in the client. It is `sipyco`, `sipyco.pc_rpc` and `sipyco.common_args` in one module.
"""

from __future__ import annotations

import argparse
import asyncio
import builtins
import contextlib
import inspect
import json
import socket
from collections.abc import Callable
from typing import Any

GREETING = b"ARTIQ pc_rpc\n"


class Server:
    def __init__(
        self, targets: dict[str, Any], description: str, builtin_terminate: bool, allow_parallel: bool
    ) -> None:
        assert builtin_terminate
        self.targets, self.description = targets, description
        self._terminated = asyncio.Event()
        self._one_at_a_time = contextlib.AsyncExitStack() if allow_parallel else asyncio.Lock()

    async def start(self, host: list[str], port: int) -> None:
        self._server = await asyncio.start_server(self._serve, host[0], port)

    async def stop(self) -> None:
        self._server.close()

    async def wait_terminate(self) -> None:
        await self._terminated.wait()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        def say(value: Any) -> None:
            writer.write(json.dumps(value).encode() + b"\n")

        with contextlib.closing(writer):
            if await reader.readline() != GREETING:
                return
            say({"targets": sorted(self.targets), "description": self.description})
            target = self.targets[(await reader.readline()).decode().strip()]
            say([name for name, _ in inspect.getmembers(target, inspect.ismethod)])
            while line := await reader.readline():
                say(await self._answer(target, json.loads(line)))

    async def _answer(self, target: Any, call: dict[str, Any]) -> dict[str, Any]:
        if call["name"] == "terminate":
            self._terminated.set()
            return {"status": "ok", "ret": None}
        try:
            async with self._one_at_a_time:
                result = getattr(target, call["name"])(*call["args"], **call["kwargs"])
                result = await result if inspect.iscoroutine(result) else result
                json.dumps(result)  # of a type that can be sent
            return {"status": "ok", "ret": result}
        except Exception as error:  # noqa: BLE001 - all are sent
            return {"status": "failed", "exception": [type(error).__name__, str(error)]}


class Client:
    def __init__(self, host: str, port: int, target_name: str) -> None:
        self._socket = socket.create_connection((host, port), 60.0)
        self._lines = self._socket.makefile("rwb")
        self._lines.write(GREETING + f"{target_name}\n".encode())
        self._lines.flush()
        assert target_name in self._next()["targets"]
        self._methods = [*self._next(), "terminate"]

    def _next(self) -> Any:
        return json.loads(self._lines.readline())

    def close_rpc(self) -> None:
        self._lines.close()
        self._socket.close()

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_") or name not in self._methods:
            raise AttributeError(name)

        def call(*args: Any, **kwargs: Any) -> Any:
            self._lines.write(json.dumps({"name": name, "args": args, "kwargs": kwargs}).encode() + b"\n")
            self._lines.flush()
            answer = self._next()
            if answer["status"] == "ok":
                return answer["ret"]
            kind, text = answer["exception"]
            raise getattr(builtins, kind, RuntimeError)(text)

        return call


def simple_network_args(parser: argparse.ArgumentParser, default_port: int) -> None:
    parser.add_argument("--bind", default=[], action="append")
    parser.add_argument("-p", "--port", default=default_port, type=int)


def verbosity_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-v", "--verbose", action="count")


def init_logger_from_args(_arguments: argparse.Namespace) -> None:
    """It only sets the level of the log."""


def bind_address_from_args(arguments: argparse.Namespace) -> list[str]:
    return ["127.0.0.1", *arguments.bind]
