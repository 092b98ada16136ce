"""``labseq devices``: what is connected, and whether it works."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from labseq.cli.check import refusal
from labseq.cli.output import columns, stdout_to_stderr, say, report_compiling
from labseq.config.wording import clean
from labseq.errors import ConfigError, DeviceError
from labseq.kernels.compile import announcing
from labseq.recording.plain import dumps
from labseq.session import CheckedDevice, DevicesReport, check_devices
from labseq.session.choosing import DryRun
from labseq.units import format_quantity

_HEADER = ("device", "plugin", "model", "serial number", "firmware", "latency", "state")


def show_devices(profile: str, overrides: Sequence[str], dry_run: DryRun, *, as_json: bool) -> int:
    """Check the devices of a profile, and print a table of them.

    Args:
        profile: Name or path of the profile.
        overrides: ``"address=value"`` strings.
        dry_run: "off", "full" or "fast".
        as_json: Whether to print everything as one line of JSON, alone on stdout.

    Returns:
        The exit code: 0 if all is well, 3 if a device failed, 2 if only some could not be constructed.

    Raises:
        ConfigError: The profile is wrong; no device was touched.
        DeviceError: Somebody else uses the same devices; none was touched.
        StopRequested: Ctrl-C or SIGTERM came meanwhile; told are the devices that were tried.
    """
    answer = stdout_to_stderr() if as_json else None
    try:
        with announcing(report_compiling):
            report = check_devices(profile, overrides, dry_run)
    except BaseException as error:
        if answer is not None:
            answer(refusal(error))
        raise
    for warning in report.warnings:
        say(f"warning: {warning}", stream=sys.stderr)
    if answer is not None:
        answer(dumps(_as_values(report)))
    else:
        say(*table(report))
    if report.stopped is not None:
        raise report.stopped
    return exit_code(report)


def exit_code(report: DevicesReport) -> int:
    """3 if a device failed, else 2 if one could not be constructed, else 0."""
    if any(not found.ok and found.constructed for found in report.devices):
        return DeviceError.exit_code
    return 0 if all(found.ok for found in report.devices) else ConfigError.exit_code


def table(report: DevicesReport) -> list[str]:
    """A row per device."""
    rows = [_HEADER, *(_row(found, report.plugins[found.name]) for found in report.devices)]
    return columns(rows, right=(_HEADER.index("latency"),))


def _row(found: CheckedDevice, plugin: str) -> tuple[str, ...]:
    told = (found.described.get(key) for key in ("model", "serial_number", "firmware"))
    identity = ("-" if value in (None, "") else clean(str(value)) for value in told)
    latency = "-" if found.latency_s is None else format_quantity(found.latency_s, "time")
    state = _reason(found) or ("ok" if found.tested else "ok, no self test")
    return found.name, plugin, *identity, latency, state


def _reason(found: CheckedDevice) -> str:
    """What went wrong, on one line; "" if nothing did."""
    parts = [("", found.failure), ("NOT SAFE: ", found.unsafe), ("could not be closed: ", found.unclosed)]
    texts = [f"{about}{error}" for about, error in parts if error is not None]
    return "; ".join(line for text in texts for line in text.splitlines())


def _as_values(report: DevicesReport) -> dict[str, Any]:
    devices = [
        {
            "name": found.name,
            "plugin": report.plugins[found.name],
            "ok": found.ok,
            "reason": _reason(found) or None,
            "model": found.described.get("model"),
            "serial_number": found.described.get("serial_number"),
            "firmware": found.described.get("firmware"),
            "latency_s": found.latency_s,
            "self_test": found.tested,
            "described": found.described,
        }
        for found in report.devices
    ]
    return {"devices": devices, "warnings": report.warnings, "problems": []}
