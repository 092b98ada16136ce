"""Limits of the card, and the values that its registers take.

Source, where no other is named: Spectrum's manual "M4i.66xx/M4i.96xx", chapters on analog
outputs, generation modes and trigger. Behaviour that the manual does not describe is as ColdMatter (EDMSuite,
``HANDOFF.md``) measured on an M4i.9622-x8.

A refused value leaves the old one in place, as on the card. Values that the simulator does not model are
refused as well, with a text that says so, rather than taken without effect.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from labseq_spcm_sim import registers as r


@dataclass(frozen=True, slots=True)
class CardModel:
    """One model of the M4i.66xx and M4i.96xx families.

    Attributes:
        name: Product name.
        card_type: Value of the register SPC_PCITYP.
        n_channels: Number of outputs.
        modes: The card modes that its licence and firmware allow.
        memory_samples: On-board memory in samples of 16 bit, shared by the active channels.
        sample_rate_hz: Lowest and highest sample rate.
        rate_gaps_hz: Sample rates that the clock cannot make, as pairs (from, to).
        rate_step_hz: Granularity of the sample rate.
        amplitude_mv: Smallest and largest amplitude into 50 Ohm, in millivolts.
        low_path_mv: The hysteresis between the amplifier's two paths. Above the second value the low path is
            left, below the first the high path.
        relay_s: How long the output is off when the path changes.
        output_relay_s: How long an output is off after its relay was closed (ours, as the path's relay).
        bus_bytes_per_s: Speed of transfers from the PC.
        pcie: Generation and lanes of its slot.
        temperature_c: Temperature of the base card's sensor, in degrees Celsius (ours).
        amplifier_c: Temperature of the amplifiers' sensor.
        reference_hz: The signal at the clock input, 0 for none.
        reference_divider: The PLL divides it by this, and multiplies the result by whole numbers (ours).
        firmware_type: 1 for its own, 2 for the recovery firmware.
        continuous_bytes: Length of the driver's continuous buffer, which a user sets up, none by default.
    """

    name: str = "M4i.6631-x8"
    card_type: int = 0x76631
    n_channels: int = 2
    modes: int = r.SPC_REP_STD_SINGLE | r.SPC_REP_FIFO_SINGLE | r.SPC_REP_STD_SEQUENCE
    memory_samples: int = 2 * 1024**3
    sample_rate_hz: tuple[float, float] = (50e6, 1.25e9)
    rate_gaps_hz: tuple[tuple[float, float], ...] = ((750e6, 757e6), (1125e6, 1145e6))
    rate_step_hz: int = 8
    amplitude_mv: tuple[int, int] = (80, 2000)
    low_path_mv: tuple[int, int] = (420, 480)
    relay_s: float = 10e-3
    output_relay_s: float = 10e-3
    bus_bytes_per_s: float = 2.8e9
    pcie: tuple[int, int] = (2, 8)
    temperature_c: int = 45
    amplifier_c: int = 50
    reference_hz: float = 10e6
    reference_divider: int = 16
    firmware_type: int = 1
    continuous_bytes: int = 0


M4I6631: Final = CardModel()
M4I6621: Final = CardModel("M4i.6621-x8", 0x76621, sample_rate_hz=(50e6, 625e6), amplitude_mv=(80, 2500))
M4I6622: Final = replace(M4I6621, name="M4i.6622-x8", card_type=0x76622, n_channels=4)
MODELS: Final = {
    model.name: model
    for model in (
        M4I6631,
        M4I6621,
        M4I6622,
        replace(M4I6621, name="M4i.9621-x8", card_type=0x79621),
        replace(M4I6622, name="M4i.9622-x8", card_type=0x79622),
    )
} | {"M4i.6631-x8-hbw": replace(M4I6631, amplitude_mv=(80, 480))}
"""Cards by name."""

FIRMWARE: Final = 1
"""Version of the main control's firmware (ours)."""
OUTPUT_FIFO_BYTES: Final = 192 * 1024
"""Size of the FIFO between the on-board memory and the outputs (manual, "Output latency")."""
PLL_LOCK_S: Final = 200e-3
"""The longest time in which the PLL locks (manual, "PLL Locking Error")."""
MEMORY_STEP: Final = 32
"""Step and minimum of the memory size, in samples per channel."""
MAX_LOOPS: Final = 2**32 - 1
MAX_SEGMENTS: Final = 1 << 16
MAX_STEPS: Final = 4096
MAX_LOOPS_OF_STEP: Final = (1 << 20) - 1
"""Most loops of a step of the sequence mode."""


def trigger_delay_s(sample_rate_hz: float) -> float:
    """Delay from the trigger to the first sample, 476.5 clocks above 625 MS/s, else 238.5, and 16 ns."""
    return (476.5 if sample_rate_hz > 625e6 else 238.5) / sample_rate_hz + 16e-9


Number = int | float


class Refusal(Exception):  # noqa: N818 - an answer of the card, not a fault of the program
    """The card refuses a call.

    Attributes:
        code: The vendor's error code.
        text: Reason of the refusal.
    """

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code
        self.text = text


@dataclass(frozen=True, slots=True)
class ErrorInfo:
    """The error that blocks the driver.

    Attributes:
        code: The vendor's code, 0 for none.
        register: The register that was accessed.
        value: The value for it.
        text: Reason of the error.
    """

    code: int = r.ERR_OK
    register: int = 0
    value: Number = 0
    text: str = ""


class Setup:
    """The set-up registers of one card.

    Args:
        model: The card.
    """

    def __init__(self, model: CardModel) -> None:
        self.model = model
        self._values: dict[int, Number] = {**_DEFAULTS, **_outputs(model), **_fixed(model)}
        self._locked: list[int] = []
        self.write_to_card()

    def __contains__(self, register: int) -> bool:
        return register in self._values

    def __getitem__(self, register: int) -> int:
        return int(self._values[register])

    def write_to_card(self) -> bool:
        """Send all values to the card, as WRITESETUP and the start do. Before, only the driver has them.

        Returns:
            Whether the PLL had to lock on an external reference that has changed.

        Raises:
            Refusal: It cannot, as that reference is missing, or has another frequency.
        """
        clock = [self[register] for register in (r.SPC_CLOCKMODE, r.SPC_REFERENCECLOCK, r.SPC_SAMPLERATE)]
        is_external = clock[0] == r.SPC_CM_EXTREFCLOCK
        if is_external and abs(clock[1] - self.model.reference_hz) > 1e-4 * clock[1]:
            raise Refusal(r.ERR_CLOCKNOTLOCKED, "the clock is not locked")
        has_changed, self._locked = is_external and clock != self._locked, clock
        self._on_card = dict(self._values)
        return has_changed

    def on_card(self, register: int) -> int:
        """The value that the card works with."""
        return int(self._on_card[register])

    @property
    def mode(self) -> int:
        """The card mode."""
        return self[r.SPC_CARDMODE]

    @property
    def channels(self) -> list[int]:
        """The active channels."""
        return [channel for channel in range(self.model.n_channels) if self[r.SPC_CHENABLE] >> channel & 1]

    @property
    def frame_bytes(self) -> int:
        """Bytes of one sample of all active channels."""
        return 2 * len(self.channels)

    def write(self, register: int, value: Number, *, running: bool) -> None:
        """Take a value.

        Raises:
            Refusal: Unknown or fixed register, value out of range, or not while running.
        """
        rule = _RULES.get(register) if register in self._values else None
        if rule is None:
            if register in self._values:
                raise Refusal(r.ERR_NOWRITEALLOWED, "this register can only be read")
            raise Refusal(r.ERR_REG, UNKNOWN)
        if running and register not in _WHILE_RUNNING:
            raise Refusal(r.ERR_RUNNING, "card is still running, access not possible")
        self._values[register] = rule(self, value)


UNKNOWN: Final = "the simulator does not know this register"
Rule = Callable[[Setup, Number], Number]


def refuse(value: Number, expected: str) -> Refusal:
    """The card's answer to a value out of range."""
    return Refusal(r.ERR_VALUE, f"value {value} not allowed; expected {expected}")


def stepped(value: Number, low: float, high: float, step: float = 1) -> Number:
    """A value rounded to a step.

    Raises:
        Refusal: It is out of range.
    """
    if not low <= value <= high:
        raise refuse(value, f"{low:g} to {high:g}")
    return round(value / step) * step


def within(low: float, high: float, step: float = 1) -> Rule:
    """A range and a step. A value between two steps is refused."""

    def rule(_setup: Setup, value: Number) -> Number:
        if low <= value <= high and value % step:
            raise refuse(value, f"a multiple of {step:g}")
        return stepped(value, low, high, step)

    return rule


def one_of(*allowed: int) -> Rule:
    """Some values, and no others."""

    def rule(_setup: Setup, value: Number) -> Number:
        if value not in allowed:
            raise refuse(value, " or ".join(map(str, allowed)))
        return int(value)

    return rule


def modelled(*allowed: int) -> Rule:
    """Values that the simulator models. The real card may know more."""

    def rule(_setup: Setup, value: Number) -> Number:
        if value not in allowed:
            raise Refusal(
                r.ERR_FNCNOTSUPPORTED,
                f"the simulator models only {', '.join(hex(known) for known in allowed)}",
            )
        return int(value)

    return rule


def _sample_rate(setup: Setup, value: Number) -> Number:
    model = setup.model
    for start, end in model.rate_gaps_hz:
        if start < value < end:
            raise refuse(value, f"a rate outside of the clock's gap from {start:g} to {end:g} S/s")
    if setup[r.SPC_CLOCKMODE] == r.SPC_CM_EXTREFCLOCK:
        step_hz = setup[r.SPC_REFERENCECLOCK] / model.reference_divider
        return round(stepped(value, *model.sample_rate_hz, step_hz))
    return stepped(value, *model.sample_rate_hz, model.rate_step_hz)


def _memory_size(setup: Setup, value: Number) -> Number:
    most = setup.model.memory_samples // len(setup.channels)
    return within(MEMORY_STEP, most, MEMORY_STEP)(setup, value)


def _channels(setup: Setup, value: Number) -> Number:
    """One, two or all four of the card's channels."""
    if not 0 < value < 1 << setup.model.n_channels or int(value).bit_count() == 3:
        raise refuse(value, "a mask of one, two or four channels of the card")
    return int(value)


def _amplitude(setup: Setup, value: Number) -> Number:
    return within(*setup.model.amplitude_mv)(setup, value)


def _power_of_two(_setup: Setup, value: Number) -> Number:
    whole = int(stepped(value, 1024, 4 * 1024**3))
    if whole & (whole - 1):
        raise refuse(value, "a power of two")
    return whole


_SWITCH: Final = one_of(0, 1)
_STOP_LEVEL: Final = one_of(
    r.SPCM_STOPLVL_ZERO, r.SPCM_STOPLVL_LOW, r.SPCM_STOPLVL_HIGH, r.SPCM_STOPLVL_HOLDLAST
)
_MODES: Final = (r.SPC_REP_STD_SINGLE, r.SPC_REP_FIFO_SINGLE, r.SPC_REP_STD_SEQUENCE)

_SETTINGS: Final[dict[int, tuple[Rule, Number]]] = {
    r.SPC_TIMEOUT: (within(0, 2**31 - 1), 0),
    r.SPC_CARDMODE: (modelled(*_MODES), r.SPC_REP_STD_SINGLE),
    r.SPC_CHENABLE: (_channels, 3),
    r.SPC_MEMSIZE: (_memory_size, 32),
    r.SPC_SEGMENTSIZE: (within(16, 8 * 1024**3 - 16, 16), 16),
    r.SPC_LOOPS: (within(0, MAX_LOOPS), 1),
    r.SPC_SAMPLERATE: (_sample_rate, 1.25e9),
    r.SPC_CLOCKMODE: (modelled(r.SPC_CM_INTPLL, r.SPC_CM_EXTREFCLOCK), r.SPC_CM_INTPLL),
    r.SPC_REFERENCECLOCK: (within(10e6, 1.25e9), 10_000_000),
    r.SPC_TRIG_ORMASK: (modelled(r.SPC_TMASK_NONE, r.SPC_TMASK_EXT0), r.SPC_TMASK_NONE),
    r.SPC_TRIG_ANDMASK: (modelled(r.SPC_TMASK_NONE), r.SPC_TMASK_NONE),
    r.SPC_TRIG_TERM: (_SWITCH, 0),
    r.SPC_TRIG_EXT0_MODE: (modelled(r.SPC_TM_NONE, r.SPC_TM_POS, r.SPC_TM_NEG, r.SPC_TM_BOTH), r.SPC_TM_NONE),
    r.SPC_TRIG_EXT0_LEVEL0: (lambda _, value: stepped(value, -10_000, 10_000, 10), 0),
    r.SPC_DATA_OUTBUFSIZE: (_power_of_two, 4 * 1024**3),
}
"""Register -> its rule, and its value after power-on."""
AMPLITUDES: Final = {r.SPC_AMP0 + 100 * channel: channel for channel in range(4)}
OUTPUTS: Final = {r.SPC_ENABLEOUT0 + 100 * channel: channel for channel in range(4)}
"""Register -> channel."""
_OUTPUT_RULES: Final = {
    **dict.fromkeys(AMPLITUDES, _amplitude),
    **dict.fromkeys(OUTPUTS, _SWITCH),
    **{r.SPC_FILTER0 + 100 * channel: _SWITCH for channel in range(4)},
    **{r.SPC_CH0_STOPLEVEL + channel: _STOP_LEVEL for channel in range(4)},
}
_RULES: Final = {register: rule for register, (rule, _) in _SETTINGS.items()} | _OUTPUT_RULES
_DEFAULTS: Final = {register: value for register, (_, value) in _SETTINGS.items()}
_WHILE_RUNNING: Final = {r.SPC_TIMEOUT, *AMPLITUDES, *OUTPUTS}


def _outputs(model: CardModel) -> dict[int, Number]:
    """The registers of the outputs that a card has, after power-on."""
    values: dict[int, Number] = {}
    for channel in range(model.n_channels):
        values[r.SPC_AMP0 + 100 * channel] = min(1000, model.amplitude_mv[1])
        values[r.SPC_ENABLEOUT0 + 100 * channel] = values[r.SPC_FILTER0 + 100 * channel] = 0
        values[r.SPC_CH0_STOPLEVEL + channel] = r.SPCM_STOPLVL_ZERO
    return values


def _fixed(model: CardModel) -> dict[int, Number]:
    return {
        r.SPC_SAMPLERATE: int(model.sample_rate_hz[1]),
        r.SPC_PCITYP: model.card_type,
        r.SPC_FNCTYPE: r.SPCM_TYPE_AO,
        r.SPC_PCIEXPGENERATION: model.pcie[0],
        r.SPC_PCIEXPLANES: model.pcie[1],
        r.SPC_PCIMEMSIZE: 2 * model.memory_samples,
        r.SPC_PCIFEATURES: r.SPCM_FEAT_SEQUENCE,
        r.SPC_PCIEXTFEATURES: r.SPCM_FEAT_EXTFW_AWG,
        r.SPC_MIINST_MODULES: 1,
        r.SPC_MIINST_CHPERMODULE: model.n_channels,
        r.SPC_MIINST_BYTESPERSAMPLE: 2,
        r.SPC_MIINST_BITSPERSAMPLE: 16,
        r.SPC_MIINST_MAXADCVALUE: 32767,
        r.SPC_MIINST_MINADCLOCK: int(model.sample_rate_hz[0]),
        r.SPC_MIINST_MAXADCLOCK: int(model.sample_rate_hz[1]),
        r.SPC_MIINST_ISDEMOCARD: 0,
        r.SPC_READAOGAINMIN: model.amplitude_mv[0],
        r.SPC_READAOGAINMAX: model.amplitude_mv[1],
        r.SPC_MON_TC_BASE_CTRL: model.temperature_c,
        r.SPC_MON_TC_MODULE_0: 0,  # not used (manual, temperature sensors)
        r.SPC_MON_TC_MODULE_1: model.amplifier_c,
        r.SPCM_FW_CTRL: 1 << 16 | FIRMWARE,
        r.SPCM_FW_CTRL_ACTIVE: model.firmware_type << 28 | FIRMWARE << 16,
        r.SPC_AVAILCARDMODES: model.modes,
        r.SPC_AVAILMEMSIZE_MIN: MEMORY_STEP,
        r.SPC_AVAILMEMSIZE_MAX: model.memory_samples,
        r.SPC_AVAILMEMSIZE_STEP: MEMORY_STEP,
        r.SPC_SEQMODE_AVAILMAXSEGMENT: MAX_SEGMENTS,
        r.SPC_SEQMODE_AVAILMAXSTEPS: MAX_STEPS,
        r.SPC_SEQMODE_AVAILMAXLOOP: MAX_LOOPS_OF_STEP,
        r.SPC_SEQMODE_AVAILFEATURES: r.SPCSEQ_ENDLOOPONTRIG | r.SPCSEQ_END,
    }
