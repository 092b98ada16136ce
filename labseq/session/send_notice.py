"""Sends one notice, read as JSON from stdin, in a process started by :mod:`labseq.session.notices`."""

from __future__ import annotations

import http.client
import json
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from labseq.files import share_with_group
from labseq.plain import now_utc

MAX_S: Final = 20.0
"""Maximum time for the program and for the address, in seconds each."""


def send(task: Mapping[str, Any]) -> list[str]:
    """Send a notice to the program and the address, if they are set.

    Returns:
        The failures, one text for each.
    """
    command, webhook, notice = task["command"], task["webhook"], task["notice"]
    ways: dict[str, Callable[[], object]] = {}
    if command:
        ways[command[0]] = lambda: _run([*command, notice["text"]])
    if webhook:  # the rest of an address may hold a secret
        ways[urlsplit(webhook).hostname or "webhook"] = lambda: _post(webhook, notice)
    failures: list[str] = []
    for name, way in ways.items():
        try:
            way()
        except TimeoutError:
            failures.append(f"{name} did not answer within {MAX_S:g} s")
        except (OSError, ValueError, http.client.HTTPException, subprocess.SubprocessError) as error:
            failures.append(f"{name}: {type(error).__name__}: {error}")
    return failures


def _run(command: Sequence[str]) -> None:
    subprocess.run(command, stdin=subprocess.DEVNULL, timeout=MAX_S, check=True)  # noqa: S603 - the user's own


def _post(address: str, notice: Mapping[str, str]) -> None:
    head = {"Content-Type": "application/json"}
    request = urllib.request.Request(address, json.dumps(notice).encode(), head, method="POST")  # noqa: S310 - http(s), by the settings' pattern
    with urllib.request.urlopen(request, timeout=MAX_S):  # noqa: S310
        pass


def main() -> None:
    """Send the notice, and add failures to the log."""
    task = json.load(sys.stdin)
    if failures := send(task):
        with Path(task["log"]).open("a", encoding="utf-8") as log:
            share_with_group(Path(task["log"]))
            log.writelines(
                f"{now_utc('seconds')} {failure}; not sent: {task['notice']['text']}\n"
                for failure in failures
            )


if __name__ == "__main__":
    main()
