"""A ZeroMQ socket (REP) of labseq, started by `python -m labseq_bridges.zeromq_server`. It needs pyzmq.

A peer connects with ZeroMQ's mechanism PLAIN. The user name is `labseq` and the password is the token. libzmq
refuses any other peer before it keeps a message. Each request is a JSON object and gets one answer:

    {"request": "go", "text": "run 17", "values": {"planner.degree_of_parallelism": 5}}
    {"request": "wait", "timeout_s": 2.5}
    {"request": "abort"}
    {"request": "state"}

`go` is answered {"answer": "busy"}, `wait` and `abort` with the result of the shot. If the shot has not
ended within `timeout_s`, `wait` is answered "busy", so that another request can come in between. A
refused request is answered {"answer": "error", "reason": "..."}.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from typing import Any

from labseq_client import LabseqError

from labseq_bridges.link import Link, add_arguments, link_of, plain

LONGEST = 65536
"""Longest request in bytes. ZeroMQ disconnects a peer that sends more."""
HANDSHAKE_MS = 2000
"""Longest time until a peer has shown the token, in milliseconds."""
MAX_WAIT_S = 3600.0
KEYS: dict[str, set[str]] = {"go": {"text", "values"}, "wait": {"timeout_s"}, "abort": set(), "state": set()}


class RequestError(Exception):
    """A request that is not passed on to labseq. The text is the reason."""


def answer_to(message: bytes, link: Link) -> dict[str, Any]:
    """The answer to a request."""
    try:
        request = _checked(message)
        return _asked(request, link)
    except (RequestError, LabseqError, RuntimeError, OSError, ValueError, LookupError) as error:
        return {"answer": "error", "reason": str(error) or type(error).__name__}


def _checked(message: bytes) -> dict[str, Any]:
    try:
        request = json.loads(message)
    except (ValueError, RecursionError):
        raise RequestError("the request is not JSON") from None
    if not isinstance(request, dict):
        raise RequestError("the request is not a JSON object")
    name = request.pop("request", None)
    if not isinstance(name, str) or name not in KEYS:
        raise RequestError(f"request is {str(name)[:40]!r}; expected {', '.join(KEYS)}")
    unknown = request.keys() - KEYS[name]
    if unknown:
        raise RequestError(f"unknown key {min(unknown)[:40]!r}; {name!r} takes {sorted(KEYS[name])}")
    return {"request": name, **request}


def _asked(request: dict[str, Any], link: Link) -> dict[str, Any]:
    name = request["request"]
    if name == "go":
        link.go(str(request.get("text", "")), _values(request.get("values", {})))
        return {"answer": "busy"}
    if name == "state":
        return {"answer": "state", "state": link.state()}
    answer = link.abort() if name == "abort" else link.wait(_timeout_s(request.get("timeout_s")))
    return {"answer": "busy"} if answer is None else plain(answer)


def _values(given: Any) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise RequestError("values must be an object of address -> value")
    return given


def _timeout_s(given: Any) -> float | None:
    if given is None:
        return None
    if not isinstance(given, (int, float)) or not 0 <= given <= MAX_WAIT_S:
        raise RequestError(f"timeout_s is {str(given)[:40]}; expected 0 to {MAX_WAIT_S:g} s")
    return max(0.001, given)


def serve(socket: Any, link: Link) -> None:
    """Answer requests one after the other, until an exception such as KeyboardInterrupt."""
    while True:
        if not socket.poll(200):  # because Ctrl-C does not end a call that has just begun to receive
            continue
        parts = socket.recv_multipart()
        socket.send(json.dumps(answer_to(b"".join(parts), link)).encode())


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the server until Ctrl-C."""
    import zmq
    from zmq.auth.thread import ThreadAuthenticator

    parser = argparse.ArgumentParser(description="ZeroMQ REP socket of labseq")
    parser.add_argument(
        "--bind", default="127.0.0.1", help="address to listen on (default: this computer only)"
    )
    parser.add_argument("-p", "--port", type=int, default=5752, help="TCP port (default: %(default)d)")
    add_arguments(parser)
    options = parser.parse_args(arguments)
    link = link_of(options)
    for number in (signal.SIGINT, signal.SIGTERM):  # a program that a shell starts with & ignores Ctrl-C
        signal.signal(number, signal.default_int_handler)
    with zmq.Context() as context, context.socket(zmq.REP) as socket, ExitStack() as stack:
        socket.maxmsgsize = LONGEST
        socket.linger = 0
        socket.handshake_ivl = HANDSHAKE_MS
        # the number of parts of a message has no limit, so only peers with the token may send messages
        socket.plain_server = True
        guard = ThreadAuthenticator(context)
        guard.start()
        stack.callback(guard.stop)
        try:
            guard.configure_plain(passwords={"labseq": link.token()})
            socket.bind(f"tcp://{options.bind}:{options.port}")
        except (OSError, zmq.ZMQError) as error:
            parser.error(f"{error}; check --labseq-token, --bind and --port")
        address = socket.getsockopt_string(zmq.LAST_ENDPOINT)
        sys.stdout.write(f"listening on {address}\n")
        sys.stdout.flush()
        with suppress(KeyboardInterrupt), closing(link):
            serve(socket, link)


if __name__ == "__main__":
    main()
