"""`labseq devices`, `labseq safe` and `labseq plugins`."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from labseq.assembly.plugin_choice import DryRun, load_plugins
from labseq.config.document import plugin_paths
from labseq.config.profile import load_profile
from labseq.console.errors import json_errors, report
from labseq.console.output import as_line, report_compiling, say, stdout_to_stderr
from labseq.console.text import columns
from labseq.errors import ConfigError, DeviceError
from labseq.kernel import announcing
from labseq.messages import clean
from labseq.plugins import PluginHost, PluginInfo
from labseq.safety.devices import CheckedDevice, DevicesReport, check_devices
from labseq.safety.safe import make_profile_safe, stand_by
from labseq.units import format_quantity

_HEADER = ("device", "plugin", "model", "serial number", "firmware", "latency", "state")


def show_devices(profile: str, overrides: Sequence[str], dry_run: DryRun, *, as_json: bool) -> int:
    """Check the devices of a profile, and print a table of them.

    Returns:
        The exit code: 0 if all devices work, 3 if one failed, else 2 if one could not be constructed.

    Raises:
        ConfigError: The profile has an error; no device was opened.
        DeviceError: Another process uses the same devices; none was opened.
        StopRequested: It was stopped by Ctrl-C or SIGTERM; the devices tested so far were printed.
    """
    answer = stdout_to_stderr() if as_json else None
    try:
        with announcing(report_compiling):
            report = check_devices(profile, overrides, dry_run)
    except BaseException as error:
        if answer is not None:
            answer(json_errors(error))
        raise
    for warning in report.warnings:
        say(f"warning: {warning}", stream=sys.stderr)
    if answer is not None:
        answer(as_line(_as_values(report)))
    else:
        say(*table(report))
    if report.stopped is not None:
        raise report.stopped
    return exit_code(report)


def exit_code(report: DevicesReport) -> int:
    """0 if all devices work, 3 if one failed, else 2 if one could not be constructed."""
    if any(not found.ok and found.constructed for found in report.devices):
        return DeviceError.exit_code
    return 0 if all(found.ok for found in report.devices) else ConfigError.exit_code


def table(report: DevicesReport) -> list[str]:
    """A row per device; below it one for each of their versions."""
    rows = [_HEADER, *(_row(found, report.plugins[found.name]) for found in report.devices)]
    versions = [
        (found.name, what, clean(here) or "unknown", tried or "none", "differs" * differs)
        for found in report.devices
        for what, (here, tried) in found.versions.items()
        for differs in [bool(tried) and here not in tried.split(", ")]
    ]
    versions += [
        (found.name, "-", f"cannot be read: {clean(str(found.unversioned))}", "-", "")
        for found in report.devices
        if found.unversioned is not None
    ]
    below = ["", *columns([("device", "version of", "here", "tried with", ""), *versions])]
    return [*columns(rows, right=(_HEADER.index("latency"),)), *(below if versions else ())]


def _row(found: CheckedDevice, plugin: str) -> tuple[str, ...]:
    values = (found.described.get(key) for key in ("model", "serial_number", "firmware"))
    identity = ("-" if value in (None, "") else clean(str(value)) for value in values)
    latency = "-" if found.latency_s is None else format_quantity(found.latency_s, "time")
    state = _reason(found) or ("ok" if found.tested else "ok, no self test")
    return found.name, plugin, *identity, latency, state


def _reason(found: CheckedDevice) -> str:
    """Why a device failed, on one line; "" if it works."""
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
            "versions": {
                what: {"here": here, "tried": tried} for what, (here, tried) in found.versions.items()
            },
            "versions_failure": None if found.unversioned is None else str(found.unversioned),
            "latency_s": found.latency_s,
            "self_test": found.tested,
            "described": found.described,
        }
        for found in report.devices
    ]
    return {"devices": devices, "warnings": report.warnings, "problems": []}


def secure_profile(profile: str, overrides: Sequence[str], *, end: bool | None = None) -> int:
    """Make a profile's devices safe; print a line for each.

    Args:
        end: Whether to end a process that uses them first; None to ask in a terminal, and else to end it.

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
    """Whether to end the process that uses a device, as the user says; true without a terminal to ask in."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return True
    try:
        answer = input(f"{text}. End it first, so that its devices are made safe? [Y/n] ")
    except EOFError:
        return True
    return not answer.strip().lower().startswith("n")


def stand_by_for(profile: str, overrides: Sequence[str]) -> None:
    """Stand by for a profile's devices until Ctrl-C; print what happens."""
    stand_by(profile, overrides, _Lines(), say)


class _Lines:
    """Implements ``RunObserver`` with a line per device."""

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        if name == "safe_state":
            state = "safe" if values["ok"] else f"NOT SAFE: {values['error']}"
            say(f"{values['device']:<20} {state}")
        elif name == "closed" and not values["ok"]:
            say(f"{values['device']:<20} could not be closed: {values['error']}")
        elif name == "warning":
            say(f"warning: {values['text']}")


def list_plugins(profile: str | None, *, as_json: bool = False) -> None:
    """Print a table of the plugins, those in the folders of a profile and those in ``./plugins`` included."""
    answer = stdout_to_stderr() if as_json else None
    if profile is None:
        host = load_plugins()
    else:
        document, spec = load_profile(profile, beside=Path())  # the plugins that it names need not exist
        host = load_plugins(plugin_paths(document, spec.plugin_folders), max_wait_s=spec.timeouts.load)
    host.import_all()
    if answer is None:
        say(*plugins_table(host))
    else:
        answer(as_line({"plugins": [_values(host, info) for info in (*host.infos, *host.unused())]}))


def plugins_table(host: PluginHost) -> list[str]:
    """A row per plugin; below the table the reasons why plugins failed to load, and notes."""
    rows = [("plugin", "state", "version", "origin", "offers")]
    remarks: list[str] = []
    for info in (*host.infos, *host.unused()):
        offers = ", ".join(_offers(host, info)) or "-"
        rows.append((info.name, info.state, info.version or "-", info.origin, offers))
        remarks += [f"{info.name}: {info.reason}"] if info.reason else []
        remarks += [f"{info.name}: warning: {note}" for note in info.notes]
    return [*columns(rows), *([""] if remarks else []), *remarks]


def _offers(host: PluginHost, info: PluginInfo) -> list[str]:
    return [f"{kind}:{name}" for kind, name in host.registry.offers(info.name)]


def _values(host: PluginHost, info: PluginInfo) -> dict[str, Any]:
    names = ("name", "state", "version", "origin", "source", "reason", "notes")
    return {**{name: getattr(info, name) for name in names}, "offers": _offers(host, info)}
