"""Light that an EM register must not see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from labseq.errors import DeviceError
from labseq.lines import blinding_lines

if TYPE_CHECKING:
    from labseq.sequencer.guard import Guard
    from labseq.sequencer.lab import Lab


@dataclass(frozen=True, slots=True)
class Blinding:
    """When a device's light blinds a camera with EM gain: while one of its values is one of these.

    Attributes:
        value: Name of the value, as ``Device.read`` takes it.
        when: What it is while the light is on.
    """

    value: str
    when: tuple[Any, ...]


def check_blinding(lab: Lab, guard: Guard) -> None:
    """Refuse an exposure with EM gain while light is on that would age or destroy the register.

    Raises:
        DeviceError: Such a light is on; nothing was exposed.
    """
    em_gain = lab.step_context.camera.em_gain
    if em_gain <= 1.0:
        return
    if lines := blinding_lines(lab.line_specs, "image"):
        text = f"no exposure with an EM gain of {em_gain:g}: the line '{lines[0]}' is on during `image`"
        raise DeviceError(
            "camera", f"{text}, and the profile marks it as blinding; take `image` out of its `on`"
        )
    for name, state in _on(lab, lab.blinding, guard).items():
        text = f"no exposure with an EM gain of {em_gain:g} while '{name}' is on (its value is {state!r})"
        raise DeviceError("camera", f"{text}; the profile marks it as blinding: turn it off before the image")


def _on(lab: Lab, marks: Mapping[str, Blinding], guard: Guard) -> dict[str, Any]:
    """The marked devices whose light is on, and what they say."""
    said = {
        name: guard.call(name, lab.timeouts.call_s, lab.devices[name].read, mark.value)
        for name, mark in marks.items()
    }
    return {name: value for name, value in said.items() if value in marks[name].when}
