"""The verdict of a first contact, how its results differ from the driver's assumptions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, TypeAlias

from pydantic import ValidationError

from labseq.plugin import format_quantity
from labseq_spcm.limits import FRAME_BYTES, RATE_STEP_HZ
from labseq_spcm.settings import SpcmSettings

Result: TypeAlias = Mapping[str, Any]
Claim: TypeAlias = Callable[[Result, SpcmSettings], str]
"""Compares the result of a step with an assumption, and returns how they differ, "" if they agree."""

NAMING_S: Final = 0.2e-3
"""Longest time to name a small buffer that makes no difference to a shot (ours)."""
COPIED_S_PER_BYTE: Final = 1 / 50e9
"""A hand-over that takes longer copies the samples, since no processor copies at 50 GB/s (ours)."""
DELAY_TOLERANCE_S: Final = 20e-9
"""Allowed difference of the trigger's delay from the manual's (ours, the error of a scope reading)."""
LARGEST_NOTIFY_BYTES: Final = 1 << 19
"""The largest ``notify_size`` that the driver takes."""
HOT_C: Final = 80
"""Limit of both sensors (manual, p. 202)."""


def _write_speed(result: Result, settings: SpcmSettings) -> str:
    needed = FRAME_BYTES * settings.sample_rate
    speeds = {int(size): float(speed) for size, speed in result["user"]}
    speed = speeds.get(settings.notify_size, 0.0)
    enough = [size for size, speed in speeds.items() if speed >= needed and size <= LARGEST_NOTIFY_BYTES]
    hint = "no notify size is enough"
    if enough:
        size = min(enough)
        hint = f"notify_size {size} with card_buffer {max(2 * size, settings.card_buffer)} is enough"
    text = f"blocks of {settings.notify_size >> 10} KiB are written at {speed / 1e9:.3g} GB/s"
    return f"{text}, and the sample rate needs {needed / 1e9:.3g} ({hint})" if speed < needed else ""


def _room(result: Result, _settings: SpcmSettings) -> str:
    missing = result["card_buffer_bytes"] - result["fetched_before_start_bytes"]
    text = f"the card's buffer takes {missing} bytes less than its size, {result['card_buffer_bytes']}"
    return f"{text}, before the start" if missing > 0 else ""


def _copied(result: Result, _settings: SpcmSettings) -> str:
    s_per_byte = result["hand_over_s_per_byte"]
    text = "samples are copied when they are handed over"
    return f"{text}, at {1e-9 / s_per_byte:.3g} GB/s" if s_per_byte > COPIED_S_PER_BYTE else ""


def _lag(result: Result, settings: SpcmSettings) -> str:
    block_s = settings.notify_size / FRAME_BYTES / settings.sample_rate
    late, block = (format_quantity(s, "time") for s in (result["worst_s"], block_s))
    text = f"the reported position is up to {late} late, longer than a block, {block}"
    return text if result["worst_s"] > block_s else ""


def _sustained(result: Result, _settings: SpcmSettings) -> str:
    played = format_quantity(result["played_s"], "time")
    return f"the card ran dry after {played} at the sample rate" if result["ran_dry"] else ""


def _overrun(result: Result, _settings: SpcmSettings) -> str:
    text = f"a card that ran dry does not say so, since its status is {result['status_dry']:#x}"
    return "" if result["overrun"] else text


def _recovery(result: Result, _settings: SpcmSettings) -> str:
    return "" if result["recovers"] else "a card that ran dry does not start again"


def _ready(result: Result, _settings: SpcmSettings) -> str:
    return "" if result["ready"] else "a card that ran dry sets OVERRUN (0x400) and not READY"


def _bursts(result: Result, _settings: SpcmSettings) -> str:
    seen, shortest_s, whole_s = result.get("bursts"), result.get("shortest_s"), result["burst_s"]
    if seen is None:
        return "the number of bursts was not read from the oscilloscope"
    if seen < result["in_time"] or not result["in_time"]:
        return f"{seen:g} of {result['in_time']} bursts that were written over silence reached the output"
    if shortest_s is None:
        return "the length of the shortest burst was not read from the oscilloscope"
    is_cut = seen == result["in_time"] and shortest_s < 0.9 * whole_s
    return "bursts that were written over silence lost their beginning" if is_cut else ""


def _naming(result: Result, _settings: SpcmSettings) -> str:
    took_s = result["naming_64_kib_s"]
    text = f"naming a transfer buffer takes {format_quantity(took_s, 'time')}"
    return text if took_s > NAMING_S else ""


def _threads(result: Result, _settings: SpcmSettings) -> str:
    text = f"{result['failed_reads']} of {result['reads']} reads from two threads at once failed"
    return text if result["failed_reads"] else ""


def _second(result: Result, _settings: SpcmSettings) -> str:
    return "another process could not stop the card" if result["runs_after_off"] else ""


def _killed(result: Result, _settings: SpcmSettings) -> str:
    tone_s = result.get("tone_s")
    text = "the tone of a killed process went on after another process had switched the card off"
    return text if tone_s is not None and tone_s > 2.5 else ""


def _trigger(result: Result, _settings: SpcmSettings) -> str:
    delay_s = result.get("delay_s")
    differs_s = 0.0 if delay_s is None else abs(delay_s - result["manual_delay_s"])
    text = f"the trigger's delay differs from the manual's by {format_quantity(differs_s, 'time')}"
    return text if differs_s > DELAY_TOLERANCE_S else ""


def _reference(result: Result, settings: SpcmSettings) -> str:
    if settings.reference_clock is None:
        return ""
    if not result["locks"]:
        return "the card's clock does not lock on the external reference"
    made_hz = {asked_hz: actual_hz for asked_hz, actual_hz, _ in result["rates"]}[round(settings.sample_rate)]
    wanted, made = (format_quantity(hz, "frequency") for hz in (settings.sample_rate, made_hz))
    text = f"the card makes {made} from the external reference, and not the sample_rate, {wanted}"
    return text if abs(made_hz - settings.sample_rate) > RATE_STEP_HZ else ""


def _warm(result: Result, _settings: SpcmSettings) -> str:
    sensors = [result[name] for name in ("base_card_c", "front_end_c") if result[name] is not None]
    hottest_c = max(sensors, default=0)
    return f"a sensor of the card reads {hottest_c} degrees Celsius" if hottest_c > HOT_C else ""


STREAM: Final[tuple[tuple[str, Claim], ...]] = (
    ("write_speed", _write_speed),
    ("positions", _room),
    ("positions", _copied),
    ("lag", _lag),
    ("sustained", _sustained),
    ("starve", _overrun),
    ("starve", _recovery),
    ("overwrite", _bursts),
)
"""Step, and what ``stream`` assumes of its result. The mode must not be used unless all of these hold."""
ALL_MODES: Final[tuple[tuple[str, Claim], ...]] = (
    ("identity", _warm),
    ("times", _naming),
    ("starve", _ready),
    ("threads", _threads),
    ("second_process", _second),
    ("killed", _killed),
    ("trigger", _trigger),
    ("reference", _reference),
)
"""Step, and what the driver assumes in every mode. It works without."""


def judge(measured: Mapping[str, Result], settings: SpcmSettings) -> dict[str, Any]:
    """Differences from the driver's assumptions, and whether the mode ``stream`` works on this card.

    Args:
        measured: Step -> its result.
        settings: The settings of the driver.

    Returns:
        "stream", "reason", and the "settings" for which this holds.
    """
    results = {step: result for step, result in measured.items() if not {"failed", "skipped"} & result.keys()}
    present = streamed(settings)
    valid = {step: result for step, result in results.items() if result.get("settings") == present}
    against = [text for step, claim in STREAM if step in valid and (text := claim(valid[step], settings))]
    against += _refused(settings)
    missing = dict.fromkeys(step for step, _ in STREAM if step not in valid)
    against += [_missing(list(missing), [step for step in missing if step in results])] if missing else []
    others = list(_others(measured, results, settings))
    return {
        "stream": not against,
        # the page has a line for each of them
        "reason": "; ".join(part.replace("; ", ": ") for part in against + others)
        or "the card does what the driver assumes",
        "settings": present,
    }


def streamed(settings: SpcmSettings) -> dict[str, Any]:
    """The settings for which a certificate is valid. Steps record their own."""
    return settings.model_dump(include={"sample_rate", "notify_size", "card_buffer"})


def _refused(settings: SpcmSettings) -> list[str]:
    """Why the driver refuses the mode ``stream`` with settings that another mode takes."""
    try:
        SpcmSettings.model_validate(settings.model_dump() | {"mode": "stream", "trigger": "software"})
    except ValidationError as error:
        return [detail["msg"].removeprefix("Value error, ") for detail in error.errors()]
    return []


def _missing(steps: Sequence[str], outdated: Sequence[str]) -> str:
    """The steps that a certificate needs. ``outdated`` ones were measured with other settings."""
    named = [f"{step} with an oscilloscope" if step == "overwrite" else step for step in steps]
    text = f"the certificate needs the step{'s' if steps[1:] else ''} {', '.join(named)}"
    was = f" ({', '.join(outdated)} measured with another sample_rate, notify_size or card_buffer)"
    return text + was if outdated else text


def _others(
    measured: Mapping[str, Result], results: Mapping[str, Result], settings: SpcmSettings
) -> Iterator[str]:
    for step, claim in ALL_MODES:
        if step in results and (text := claim(results[step], settings)):
            yield text
    for step, result in measured.items():
        if "failed" in result:
            yield f"the step {step} failed: {result['failed']}"
