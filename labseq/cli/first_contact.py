"""`labseq first-contact`: asks, reads the answers, and prints the table of steps and the page."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from labseq.assembly.options import DryRun
from labseq.console.output import report_compiling, say, write_text
from labseq.errors import ConfigError, DeviceError, StopRequested, one_of
from labseq.guard import StopFlag
from labseq.kernels.kernel import announcing
from labseq.roles.first_contact import ContactStep, Reading
from labseq.safety.first_contact import Contact, Wanted, meet_devices
from labseq.units import EXAMPLES, format_quantity, parse_quantity

INSTRUMENTS: Final = {
    "scope": "an oscilloscope with 50 Ohm inputs at both outputs, and no amplifier",
    "reference": "a 10 MHz reference at the clock input",
}


def meet(
    profile: str,
    wanted: Wanted,
    overrides: Sequence[str],
    dry_run: DryRun,
    *,
    instruments: Sequence[str],
    yes: bool,
) -> int:
    """Take the steps of a first contact, write its files, and print what they say.

    Returns:
        The exit code: 0, or 3 if a step failed.

    Raises:
        ConfigError: The profile or an option has an error, or no terminal can answer.
        DeviceError: A device cannot be opened, or is not safe.
    """
    for name in instruments:
        if name not in INSTRUMENTS:
            raise ConfigError(
                f"--with: there is no instrument '{name}'; expected {one_of(list(INSTRUMENTS))}"
            )
    dialogue = _Terminal(instruments, asks=not yes)
    with announcing(report_compiling):
        contacts = meet_devices(profile, wanted, overrides, dry_run, dialogue, _warn)
    return DeviceError.exit_code if any(contact.failed for contact in contacts) else 0


def _warn(text: str) -> None:
    say(f"warning: {text}", stream=sys.stderr)


class _Terminal:
    """Implements ``Dialogue`` with questions at the terminal.

    Args:
        instruments: Connected instruments. With ``asks``, the user is asked about the others.
        asks: Whether to ask before each step.
    """

    def __init__(self, instruments: Sequence[str], *, asks: bool) -> None:
        self._connected = dict.fromkeys(instruments, True)
        self._asks = asks

    def may_take(self, device: str, step: ContactStep, stop: StopFlag) -> bool:
        """Ask before each step, and once for its instrument."""
        if step.needs and not self._has(step.needs, stop):
            say(f"{device}  {step.name:<16} left out, because it needs {INSTRUMENTS[step.needs]}")
            return False
        say(f"{device}  {step.name}: {step.does}")
        if step.prepare:
            say(f"  connect and set: {step.prepare}")
        return not self._asks or _answer("  take this step? [Y/n] ", stop).lower() not in ("n", "no")

    def _has(self, instrument: str, stop: StopFlag) -> bool:
        if instrument not in self._connected:
            question = f"is there {INSTRUMENTS[instrument]}? [y/N] "
            self._connected[instrument] = self._asks and _answer(question, stop).lower() in ("y", "yes")
        return self._connected[instrument]

    def reads(self, reading: Reading, stop: StopFlag) -> float | None:
        """Ask for a reading until it makes sense."""
        example = EXAMPLES[reading.dimension] if reading.dimension != "fraction" else "12"
        while text := _answer(f"  read {reading.about} (such as {example}, or nothing if not read): ", stop):
            try:
                value = parse_quantity(text, reading.dimension)
            except ValueError as error:
                say(f"  {error}")
                continue
            if reading.low <= value <= reading.high:
                return value
            low, high = (_quantity(limit, reading.dimension) for limit in (reading.low, reading.high))
            say(f"  {text} is out of range; expected {low} to {high}")
        return None

    def ended(self, result: Mapping[str, Any]) -> None:
        """Print how the step ended."""
        if "failed" in result:
            say(f"  FAILED: {result['failed']}")
        elif "skipped" in result:
            say(f"  nothing to measure: {result['skipped']}")
        else:
            say("  done, the outputs are off")

    def written(self, contact: Contact) -> None:
        """Write the page, and print its path and the next command."""
        page = contact.path.with_suffix(".md")
        write_text(page, page_text(contact))
        say("", *_summary(contact, page))


def _quantity(value: float, dimension: str) -> str:
    return f"{value:g}" if dimension == "fraction" else format_quantity(value, dimension)


def _answer(question: str, stop: StopFlag) -> str:
    """The user's answer. A request to stop ends the wait, which ``input`` alone would not obey.

    Raises:
        ConfigError: The user cannot answer, because stdin is closed.
        StopRequested: Ctrl-C.
    """
    sys.stdout.write(question)
    sys.stdout.flush()
    lines = list[str]()
    reader = threading.Thread(target=lambda: lines.append(sys.stdin.readline()), daemon=True)
    reader.start()
    try:
        while reader.is_alive():
            stop.wait(0.05)
    except StopRequested:
        say("")  # so that the next line does not begin behind the question
        raise
    if not lines or not lines[0]:
        say("")  # the same for the error
        hint = "give --yes, and --with for instruments, or use a terminal to type their readings"
        raise ConfigError(f"there is no terminal that could answer; {hint}")
    return lines[0].strip()


def _summary(contact: Contact, page: Path) -> list[str]:
    content = contact.content
    card = content["card"]
    lines = [f"{contact.device}: {card['model']}, serial number {card['serial']}"]
    verdict = content["verdict"]
    if "stream" in verdict:
        lines.append(f"mode stream: {'may be used' if verdict['stream'] else 'must not be used'}")
    lines += [f"verdict: {verdict['reason']}", f"file: {contact.path}", f"page: {page}"]
    return lines


# The page


def page_text(contact: Contact) -> str:
    """The file as a page to read, in Markdown."""
    content = contact.content
    card, computer = content["card"], content["computer"]
    simulated = " (simulated)" if card["simulated"] else ""
    facts = [
        ("serial number", card["serial"]),
        ("driver", card["driver"]),
        ("firmware", card["firmware"]),
        ("computer", computer["node"]),
        ("labseq", content["labseq"]),
        ("time", content["ended_utc"]),
    ]
    lines = [f"# First contact: {card['model']}{simulated}", "", *_table(facts), "", "## Verdict", ""]
    lines += [f"- {part}" for part in content["verdict"]["reason"].split("; ")]
    if "stream" in content["verdict"]:
        lines += ["", f"Mode `stream`: {'yes' if content['verdict']['stream'] else 'no'}."]
    for step, result in content["measured"].items():
        lines += ["", f"## {step}", "", *_table(_rows(result, contact.units))]
    lines += [
        "",
        f"labseq reads `{contact.path.name}` in the same folder, which has all digits, in SI units.",
    ]
    return "\n".join([*lines, "It has a digest, and must not be edited.", ""])


def _table(rows: Sequence[tuple[str, str]]) -> list[str]:
    return ["| | |", "|---|---|", *(f"| {label} | {cell} |" for label, cell in rows)]


def _rows(
    result: Mapping[str, Any], units: Mapping[str, Sequence[str]], prefix: str = ""
) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in result.items():
        unit = next((unit for unit in _UNITS if key.endswith(f"_{unit}")), "")
        words = key.removesuffix(f"_{unit}").split("_")
        label = prefix + " ".join(_SPELLED.get(word, word) for word in words)
        if isinstance(value, Mapping):
            rows += _rows(value, units, f"{label}, ")
        else:
            rows.append((label, _cell(value, units.get(key, (unit,)))))
    return rows


def _cell(value: Any, units: Sequence[str]) -> str:
    """A result in the units of its columns. A list becomes one or several lines of a table."""
    if isinstance(value, list):
        items: list[Any] = value
        by_column = len(items) == len(units) > 1 and not isinstance(items[0], list)
        cells = (_cell(item, units[i : i + 1] if by_column else units) for i, item in enumerate(items))
        return (", " if by_column else "; ").join(cells) or "none"
    if value is None:
        return "not known"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return _UNITS.get(units[0], "{:.6g}".format)(value)
    return str(value).replace("|", "\\|")


def _size(n_bytes: float) -> str:
    for unit, factor in (("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)):
        if n_bytes and not n_bytes % factor:
            return f"{n_bytes // factor} {unit}"
    return f"{n_bytes} bytes"


_SPELLED: Final = {"kib": "KiB", "mib": "MiB", "pcie": "PCIe", "dds": "DDS"}
_UNITS: Final[Mapping[str, Callable[[float], str]]] = {
    "s_per_byte": lambda value: f"{value * 1e9:.3g} ns per byte",
    "hz_per_s": "{:.6g} Hz/s".format,
    "bytes_per_s": lambda value: f"{value / 1e9:.3g} GB/s",
    "s": lambda value: format_quantity(value, "time"),
    "hz": lambda value: format_quantity(value, "frequency", 6),
    "v": lambda value: format_quantity(value, "voltage"),
    "mv": lambda value: format_quantity(value / 1e3, "voltage"),
    "c": "{:g} degrees Celsius".format,
    "deg": "{:.6g} degrees".format,
    "bytes": _size,
    "bits": "{:#x}".format,
}
"""How the page writes numbers, by the suffix of their names. Longer suffixes come first."""
