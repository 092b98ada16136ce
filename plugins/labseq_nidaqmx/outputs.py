"""Outputs of the lines on the cards, and programs of the lines as samples for them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import ConfigError, LimitError, LineProgram, LineSpec, format_quantity
from labseq_nidaqmx.settings import LevelSettings

MAX_SAMPLES: Final = 30_000_000
"""Most samples of a program, 120 MB for each port, 240 MB for each analogue output."""
_DIGITAL: Final = re.compile(r"(?P<port>(?P<device>[^/]+)/port\d+)/line(?P<bit>[12]?\d|3[01])", re.IGNORECASE)
_ANALOGUE: Final = re.compile(r"(?P<device>[^/]+)/ao\d+", re.IGNORECASE)


@dataclass(frozen=True, slots=True, eq=False)
class OutputGroup:
    """Outputs of one kind of one card, which one task of NI-DAQmx plays.

    Attributes:
        device: Name of the card, "Dev1".
        kind: "ao" or "do", as NI-DAQmx calls analogue and digital outputs.
        channels: Outputs of each channel of the task, an analogue output or lines of a port, with commas.
        low: (n_channels, n_lines), contribution of each line that is off to the value of each channel.
        high: The same for each line that is on.
    """

    device: str
    kind: str
    channels: tuple[str, ...]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def values(self, on: NDArray[np.bool_]) -> NDArray[Any]:
        """The values of the channels for states of the lines.

        Args:
            on: (n_edges, n_lines), which lines are on.

        Returns:
            (n_channels, n_edges): uint32, where bit n is line n of the port, or float64 in volts.
        """
        values = self.high @ on.T + self.low @ ~on.T
        return values.astype(np.uint32 if self.kind == "do" else np.float64)


class _Output(NamedTuple):
    """The output of a line.

    Attributes:
        kind: "ao" or "do".
        device: Name of its card.
        channel: Channel of the task, which is the output itself or its port.
        name: Its name.
        low: Its contribution to the channel's value while the line is off.
        high: The same while it is on.
    """

    kind: str
    device: str
    channel: str
    name: str
    low: float
    high: float


def output_groups(
    specs: Sequence[LineSpec], levels: Mapping[str, LevelSettings], device: str
) -> tuple[OutputGroup, ...]:
    """The outputs of the lines, analogue ones first.

    Args:
        specs: The lines.
        levels: Name of a line on an analogue output -> its levels.
        device: Name of the lines in the profile, for messages.

    Raises:
        ConfigError: A channel is not a name of NI's, or a line has no levels, or useless ones.
    """
    if unknown := [name for name in levels if name not in {spec.name for spec in specs}]:
        raise ConfigError(f"{device}: 'levels' has '{unknown[0]}', which is not a line of 'channels'")
    outputs = [_output(spec, levels.get(spec.name), device) for spec in specs]
    groups: list[OutputGroup] = []
    for kind, card in sorted({(output.kind, output.device) for output in outputs}):
        names: dict[str, list[str]] = {}
        for output in outputs:
            if (output.kind, output.device) == (kind, card):
                names.setdefault(output.channel, []).append(output.name)
        low = [[output.low * (output.channel == channel) for output in outputs] for channel in names]
        high = [[output.high * (output.channel == channel) for output in outputs] for channel in names]
        channels = tuple(",".join(lines) for lines in names.values())
        groups.append(OutputGroup(card, kind, channels, np.array(low), np.array(high)))
    return tuple(groups)


def _output(spec: LineSpec, level: LevelSettings | None, device: str) -> _Output:
    name = str(spec.channel)
    where = f"{device}: '{spec.name}' is on channel {name}"
    if digital := _DIGITAL.fullmatch(name):
        if level is not None:
            raise ConfigError(
                f"{where}, which is digital, but has 'levels'; expected an output such as Dev1/ao0"
            )
        bit = float(1 << int(digital["bit"]))
        low, high = (bit, 0.0) if spec.active_low else (0.0, bit)
        return _Output("do", digital["device"], digital["port"].lower(), name, low, high)
    if (analogue := _ANALOGUE.fullmatch(name)) is None:
        raise ConfigError(f"{where}; expected a name of NI's such as Dev1/port0/line3 or Dev1/ao0")
    if level is None or spec.active_low:
        what = "has no 'levels'" if level is None else "has 'active_low', which is for digital lines"
        raise ConfigError(f"{where} and {what}; expected `levels: {{{spec.name}: {{on: 3.3 V, off: 0 V}}}}`")
    return _Output("ao", analogue["device"], name.lower(), name, level.off, level.on)


def sample_counts(program: LineProgram, rate_hz: float, device: str) -> NDArray[np.int64]:
    """For how many samples each edge's states last. The program ends with one sample of the last states.

    Raises:
        LimitError: Edges closer together than a sample, or more samples than ``MAX_SAMPLES``.
    """
    what = f"{device}: `{program.kind}`"
    ends = np.append(program.t_s, max(program.duration_s, float(program.t_s[-1])))
    if ends[-1] * rate_hz > MAX_SAMPLES:
        limit = f"at most {format_quantity(MAX_SAMPLES / rate_hz, 'time')} at this 'rate'"
        hint = "a lower rate makes longer programs possible"
        raise LimitError(f"{what}: duration", format_quantity(float(ends[-1]), "time"), limit, hint)
    counts = np.diff(np.rint(ends * rate_hz).astype(np.int64))
    if (close := np.flatnonzero(counts[:-1] < 1)).size:
        first = int(close[0])
        before_s, t_s = program.t_s[first : first + 2].tolist()
        changes = program.on[first] != program.on[first + 1]
        names = ", ".join(f"'{line}'" for line, new in zip(program.lines, changes, strict=True) if new)
        between = f"time before the edge of {names} at {format_quantity(t_s, 'time', 7)}"
        came = format_quantity(t_s - before_s, "time")
        limit = f"at least a sample, {format_quantity(1 / rate_hz, 'time')}"
        raise LimitError(f"{what}: {between}", came, limit, "change a lead, a lag or a pulse, or the 'rate'")
    counts[-1] = max(counts[-1] + 1, 3 - len(counts))  # two in all: NI-DAQmx plays no buffer of one sample
    return counts
