"""Switches a device on a serial line off from another process, with pyserial alone.

The watchdog loads this file by its path after the run that used the device has died (see
``labseq.plugin.serial.serial_emergency``). Messages are ``SerialMessage``s as JSON values.
"""

from __future__ import annotations

import importlib
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

SLICE_S: Final = 0.005
"""Longest single wait for a byte, in seconds."""
_DIFFERS: Final = "not as commanded: "
"""Beginning of a failure in which the reply was another value than expected."""
_sent: Final[dict[int, str]] = {}
"""Index of each message that is not sent again -> why it failed, or "" if it did not."""


def prepare(**_: Any) -> None:
    """Load pyserial, without using the port."""
    importlib.import_module("serial")


def off(
    port: str, options: Mapping[str, Any], messages: Sequence[Mapping[str, Any]], encoding: str, echo: bool
) -> str:
    """Open the port and send every message, even if some fail.

    A second call sends only repeatable messages.

    Args:
        port: The port, as pyserial knows it.
        options: Options of the port.
        messages: The messages to send.
        encoding: Encoding of the characters.
        echo: Whether the device repeats the messages.

    Returns:
        The sent messages, as text.

    Raises:
        OSError: The port cannot be opened, or messages failed.
    """
    serial: Any = importlib.import_module("serial")
    failures: list[str] = []
    sent: list[str] = []
    with serial.serial_for_url(port, timeout=SLICE_S, **options) as opened:
        line = _Line(opened, encoding, echo)
        for i, message in enumerate(messages):
            if i not in _sent:
                failure, is_sent = line.carry_out(message)
                if is_sent:
                    sent.append(_shown(message["send"]))
                if is_sent and not message["repeatable"]:
                    _sent[i] = failure
                failures.append(failure)
            else:
                failures.append(_sent[i])
    if any(failures):
        raise OSError(f"{port}: {'; '.join(filter(None, failures))}")
    sent_text = ", ".join(filter(None, sent))
    return f"sent {sent_text} to {port}" if sent_text else f"{port}: nothing had to be sent"


class _Line:
    """An open port."""

    def __init__(self, port: Any, encoding: str, echo: bool) -> None:
        self._port, self._encoding, self._echo = port, encoding, echo

    def carry_out(self, message: Mapping[str, Any]) -> tuple[str, bool]:
        """Send a message if necessary, and return why it failed and whether it was sent."""
        questions = message["unless"]
        answers = [self._ask(question) for question in questions]
        if questions and not any(answers):
            return "", False
        for answer in answers:
            if answer and not answer.startswith(_DIFFERS):
                return answer, False  # a toggle might turn it on
        if failure := self._ask(message):
            return failure, True
        deadline = time.monotonic() + message["within_s"]
        while failure := next(filter(None, map(self._ask, questions)), ""):
            if time.monotonic() > deadline:
                break
        return failure, True

    def _ask(self, message: Mapping[str, Any]) -> str:
        """Send a message and check the reply. Returns the error in the reply, or ""."""
        shown, within_s = _shown(message["send"]), message["within_s"]
        sent, end = (message[key].encode(self._encoding) for key in ("send", "until"))
        self._port.reset_input_buffer()  # a late reply must not count as the reply to this message
        self._port.write(sent)
        self._port.flush()
        if not end:
            time.sleep(within_s)
            return ""
        received, start = b"", len(sent) if self._echo else 0
        deadline = time.monotonic() + within_s
        while (at := received.find(end, start)) < 0:
            if time.monotonic() > deadline:
                return f"no answer to {shown}"
            received += self._port.read(max(1, self._port.in_waiting))
        reply = received[start:at].decode(self._encoding, "replace").strip()
        match = re.fullmatch(message["expect"], reply, re.DOTALL)
        if match is None or (message["error"] and re.fullmatch(message["error"], reply, re.DOTALL)):
            return f"{shown} was answered by {_shown(reply)}"
        if (expected := message["value"]) is None:
            return ""
        value: str | int = match["value"].strip()
        with suppress(ValueError):
            value = int(value) if isinstance(expected, int) else value
        if type(value) is not type(expected) or value not in (message["choices"] or [value]):
            return f"{shown} was answered by {_shown(reply)}"
        return "" if value == expected else f"{_DIFFERS}{shown} was answered by {_shown(reply)}"


def _shown(text: str) -> str:
    return ascii(text.strip())[:60]
