"""The instruments that the guide describes."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from labseq_serial.device import SerialDevice
from labseq_serial.settings import SerialSettings

from labseq import Context
from labseq.config import Document
from labseq.config.yaml_nodes import compose
from labseq.testing.fakes import FakeClock

GUIDE = Path(__file__).parents[2] / "docs" / "how-to" / "serial-devices.md"


def examples_of_the_guide() -> Iterator[tuple[str, dict[str, Any]]]:
    for text in re.findall(r"^```yaml\n(devices:.*?)^```$", GUIDE.read_text(), re.DOTALL | re.MULTILINE):
        node = compose(text, "guide")
        assert node is not None
        yield from node.plain()["devices"].items()


@pytest.mark.parametrize(("name", "example"), [*examples_of_the_guide()], ids=str)
def test_the_examples_of_the_guide_stand_their_own_dry_run(name: str, example: dict[str, Any]) -> None:
    described = {key: value for key, value in example.items() if key not in ("use", "blinding", "usb")}
    described["port"] = "simulated"
    settings = Document.parse(json.dumps({name: described}), "guide").validate(SerialSettings, (name,))
    device = SerialDevice(settings, Context(name, clock=FakeClock()))
    device.open()
    device.self_test()
    device.check_interlocks()
    for command, declared in settings.commands.items():
        for arguments in declared.extremes():
            device.command(command, **arguments)
            for argument in set(arguments) & set(settings.values):
                assert device.read(argument) == pytest.approx(arguments[argument])
    device.safe_state()
    before = device.poll()
    device.safe_state()
    assert device.poll() == before
    device.close()
