"""`labseq devices` and `labseq safe`."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from labseq.assembly.options import DryRun
from labseq.console.errors import report
from labseq.console.output import report_compiling, say
from labseq.console.report import Column, aligned, reporting, table
from labseq.console.text import time_text
from labseq.errors import ConfigError, DeviceError, Problem
from labseq.kernels.kernel import announcing
from labseq.messages import clean
from labseq.safety.devices import CheckedDevice, DevicesReport, check_devices
from labseq.safety.safe import make_profile_safe, stand_by


@dataclass(frozen=True, slots=True)
class Versions:
    """The installed version of a library or firmware, and the versions that the driver was tried with."""

    here: str
    tried: str

    @property
    def differs(self) -> bool:
        """True if the driver was tried, but not with the installed version."""
        return bool(self.tried) and self.here not in self.tried.split(", ")


@dataclass(frozen=True, slots=True)
class DeviceRow:
    """A device of a profile, see :class:`labseq.safety.devices.CheckedDevice`.

    Attributes:
        reason: Why it failed, on one line; None if it works.
    """

    name: str
    plugin: str
    ok: bool
    reason: str | None
    model: Any
    serial_number: Any
    firmware: Any
    versions: Mapping[str, Versions]
    versions_failure: str | None
    latency_s: float | None
    self_test: bool
    described: Mapping[str, Any]

    @classmethod
    def of(cls, device: CheckedDevice, plugin: str) -> DeviceRow:
        """The row of a checked device."""
        return cls(
            name=device.name,
            plugin=plugin,
            ok=device.ok,
            reason=_reason(device) or None,
            model=device.described.get("model"),
            serial_number=device.described.get("serial_number"),
            firmware=device.described.get("firmware"),
            versions={what: Versions(*versions) for what, versions in device.versions.items()},
            versions_failure=None if device.unversioned is None else str(device.unversioned),
            latency_s=device.latency_s,
            self_test=device.tested,
            described=device.described,
        )


def _reason(device: CheckedDevice) -> str:
    errors = (
        ("", device.failure),
        ("NOT SAFE: ", device.unsafe),
        ("could not be closed: ", device.unclosed),
    )
    texts = [f"{about}{error}" for about, error in errors if error is not None]
    return "; ".join(line for text in texts for line in text.splitlines())


def _named(value: Any) -> str:
    return "-" if value in (None, "") else clean(str(value))


DEVICES: Final[Sequence[Column[DeviceRow]]] = (
    Column("device", lambda device: device.name),
    Column("plugin", lambda device: device.plugin),
    Column("model", lambda device: _named(device.model)),
    Column("serial number", lambda device: _named(device.serial_number)),
    Column("firmware", lambda device: _named(device.firmware)),
    Column("latency", lambda device: time_text(device.latency_s), right=True),
    Column("state", lambda device: device.reason or ("ok" if device.self_test else "ok, no self test")),
)
VERSIONS: Final = ("device", "version of", "here", "tried with", "")


@dataclass(frozen=True, slots=True)
class Devices:
    """The devices of a profile.

    Attributes:
        problems: Mistakes in the profile. Empty if its devices were opened.
    """

    devices: Sequence[DeviceRow]
    warnings: Sequence[str]
    problems: Sequence[Problem] = ()

    def as_text(self) -> list[str]:
        """A row per device, then a row for each of their versions."""
        versions = [
            (device.name, what, clean(one.here) or "unknown", one.tried or "none", "differs" * one.differs)
            for device in self.devices
            for what, one in device.versions.items()
        ]
        versions += [
            (device.name, "-", f"cannot be read: {clean(device.versions_failure)}", "-", "")
            for device in self.devices
            if device.versions_failure is not None
        ]
        return [*table(self.devices, DEVICES), *(["", *aligned([VERSIONS, *versions])] if versions else [])]


def show_devices(profile: str, overrides: Sequence[str], dry_run: DryRun, *, as_json: bool) -> int:
    """Check the devices of a profile, and print a table.

    Returns:
        The exit code: 0 if all devices work, 3 if a device failed, else 2 if one could not be constructed.

    Raises:
        ConfigError: The profile has an error. No device was opened.
        DeviceError: Another process uses the same devices. None was opened.
        StopRequested: Ctrl-C or SIGTERM stopped it. The devices tested so far were printed.
    """
    with reporting(as_json=as_json) as show:
        with announcing(report_compiling):
            checked = check_devices(profile, overrides, dry_run)
        for warning in checked.warnings:
            say(f"warning: {warning}", stream=sys.stderr)
        rows = [DeviceRow.of(device, checked.plugins[device.name]) for device in checked.devices]
        show(Devices(rows, checked.warnings))
    if checked.stopped is not None:
        raise checked.stopped
    return exit_code(checked)


def exit_code(report: DevicesReport) -> int:
    """0 if all devices work, 3 if one failed, else 2 if one could not be constructed."""
    if any(not device.ok and device.constructed for device in report.devices):
        return DeviceError.exit_code
    return 0 if all(device.ok for device in report.devices) else ConfigError.exit_code


def secure_profile(profile: str, overrides: Sequence[str], *, end: bool | None = None) -> int:
    """Make a profile's devices safe, and print a line for each.

    Args:
        end: Whether to end a process that uses them first. None asks in a terminal, and otherwise ends it.

    Returns:
        The exit code: 0 if every device is safe and the profile has no error, 3 if a device
        failed, else 2.
    """

    def may_end(text: str) -> bool:
        return _asks_to_end(text) if end is None else end

    secured = make_profile_safe(profile, overrides, _Lines(), may_end=may_end)
    if secured.problems is not None:
        report(secured.problems)
    if any(secured.attempted.values()):
        return DeviceError.exit_code
    return ConfigError.exit_code if secured.refused or secured.problems else 0


def _asks_to_end(text: str) -> bool:
    """Ask whether to end the process that uses a device. True without a terminal to ask in."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return True
    try:
        answer = input(f"{text}. End it first, so that its devices are made safe? [Y/n] ")
    except EOFError:
        return True
    return not answer.strip().lower().startswith("n")


def stand_by_for(profile: str, overrides: Sequence[str]) -> None:
    """Stand by for a profile's devices until Ctrl-C, and print what happens."""
    stand_by(profile, overrides, _Lines(), say)


class _Lines:
    """Implements ``RunObserver`` by printing a line per device."""

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        if name == "safe_state":
            state = "safe" if values["ok"] else f"NOT SAFE: {values['error']}"
            say(f"{values['device']:<20} {state}")
        elif name == "closed" and not values["ok"]:
            say(f"{values['device']:<20} could not be closed: {values['error']}")
        elif name == "warning":
            say(f"warning: {values['text']}")
