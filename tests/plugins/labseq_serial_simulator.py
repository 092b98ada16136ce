"""An instrument on a pty, in a process of its own, that behaves badly on request.

Its standard input takes one order per line, each answered by one line of JSON: ``fault NAME N`` for its next
N replies, ``answer HEX`` for the next one, ``say HEX`` for bytes unasked, ``speed N`` for the baud rate at
which it works, ``set NAME VALUE``, ``log`` for what it was sent,
``state`` for its values and the time (CLOCK_MONOTONIC) of its last command, ``unplug``, ``plug``.
"""

from __future__ import annotations

import json
import os
import pty
import select
import sys
import termios
import time
import tty
from pathlib import Path

NOISE = b"\xff\xfe\x00\x95\x80"
NAP_S = 0.004


class Instrument:
    """A shutter, a synthesizer and a thermometer in one."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.master = self.slave = -1
        self.log: list[str] = []
        self.commanded_s = 0.0
        self.fault, self.n_faults = "", 0
        self.speed = termios.B9600
        self.state = {"open": "0", "frequency": "100.000000", "temperature": "21.50"}
        self.came = self.answer = b""
        self.plug()

    def plug(self) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.master)
        tty.setraw(self.slave)
        new = self.link.with_name("new")
        new.symlink_to(os.ttyname(self.slave))
        new.replace(self.link)

    def unplug(self) -> None:
        os.close(self.master)
        os.close(self.slave)
        self.master = self.slave = -1
        self.came = b""

    def serve(self) -> None:
        while True:
            inputs = [0] if self.master < 0 else [0, self.master]
            ready = select.select(inputs, [], [])[0]
            if self.master in ready:
                self.take(os.read(self.master, 4096))
            elif order := sys.stdin.readline():
                print(json.dumps(self.ordered(*order.split())), flush=True)
            else:
                return

    def ordered(self, order: str, *arguments: str) -> object:
        if order == "fault":
            self.fault, self.n_faults = arguments[0], int(arguments[1])
        elif order == "speed":
            self.speed = getattr(termios, f"B{arguments[0]}")
        elif order == "set":
            self.state[arguments[0]] = arguments[1]
        elif order == "say":
            os.write(self.master, bytes.fromhex(arguments[0]))
        elif order == "answer":
            self.fault, self.n_faults, self.answer = "answer", 1, bytes.fromhex(arguments[0])
        elif order == "unplug":
            self.unplug()
        elif order == "plug":
            self.plug()
        elif order == "state":
            return self.state, self.commanded_s
        return self.log if order == "log" else None

    def take(self, data: bytes) -> None:
        self.came += data
        while b"\n" in self.came:
            line, self.came = self.came.split(b"\n", 1)
            text = line.decode("latin-1")
            self.log.append(text)
            self.commanded_s = self.commanded_s if "?" in text else time.monotonic()
            if self.n_faults:
                self.n_faults -= 1
                self.misbehave(text)
            elif (reply := self.reply(text)) is not None:
                self.say(reply + b"\n")

    def misbehave(self, text: str) -> None:
        if self.fault == "unplug":
            self.unplug()
            return
        reply = self.reply(text)
        if reply is None or self.fault == "silent":
            return
        if self.fault == "slow":
            for byte in reply + b"\n":
                select.select([], [], [], NAP_S)
                self.say(bytes([byte]))
            return
        said = {
            "garbage": NOISE + b"\n",
            "partial": reply[: len(reply) // 2],
            "other": b"WHAT\n",
            "echo": text.encode() + b"\n" + reply + b"\n",
            "two": reply + b"\n" + b"LATER\n",
            "endless": b"x" * 5_000,
            "answer": self.answer,
        }
        self.say(said[self.fault])

    def say(self, data: bytes) -> None:
        if termios.tcgetattr(self.slave)[5] != self.speed:
            data = bytes(byte ^ 0x95 | 0x80 for byte in data)
        while data:
            data = data[os.write(self.master, data) :]

    def reply(self, text: str) -> bytes | None:
        """What a good instrument says."""
        asked = {"STATE?": "open", "FREQ?": "frequency", "TEMP?": "temperature"}
        if text == "*IDN?":
            return b"LAB,SIMULATOR,0042,1.7"
        if text in asked:
            return self.state[asked[text]].encode()
        if text in ("OPEN", "CLOSE"):
            self.state["open"] = "1" if text == "OPEN" else "0"
            return b"OK"
        if text == "TOGGLE":
            self.state["open"] = "0" if self.state["open"] == "1" else "1"
            return b"OK"
        if text.startswith("FREQ "):
            self.state["frequency"] = text.removeprefix("FREQ ")
            return None
        return b"ERR -113,undefined header"


if __name__ == "__main__":
    Instrument(Path(sys.argv[1])).serve()
