"""`labseq first-contact`, whose steps check a driver's assumptions and each end in the safe state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Protocol

import labseq
from labseq.assembly.options import DryRun, check_dry_run
from labseq.assembly.profile import ResolvedProfile, resolve_profile
from labseq.config.addresses import profile_overrides
from labseq.drivers.first_contact import (
    FOLDER,
    SCHEMA,
    check_belongs,
    contact_path,
    read_contact,
    this_computer,
    write_contact,
)
from labseq.errors import ConfigError, LabseqError, Problem, StopRequested, one_of
from labseq.files import explained, make_folder
from labseq.guard import Guard, StopFlag, stop_on_signals
from labseq.kernels.kernel import load_kernels
from labseq.plain import now_utc
from labseq.roles import Hardware, in_opening_order
from labseq.roles.first_contact import ContactStep, FirstContact, OffersFirstContact, Reading
from labseq.safety.devices import CheckedDevice, check_each_device
from labseq.safety.locks import lock_devices
from labseq.safety.safe import construct_hardware
from labseq.sequencer.clock import RealClock, VirtualClock
from labseq.sequencer.lab import attempt
from labseq.watchdog import Watchdog

NO_STEPS = "its driver has no first-contact steps, so only identity, settings and limits were read"


class Dialogue(Protocol):
    """The user, who is asked before each step and reads the instruments while all outputs are off."""

    def may_take(self, device: str, step: ContactStep, stop: StopFlag) -> bool:
        """Whether to take a step. False also if its instrument is missing."""
        ...

    def reads(self, reading: Reading, stop: StopFlag) -> float | None:
        """The number that the user reads from an instrument, in SI. None for nothing."""
        ...

    def ended(self, result: Mapping[str, Any]) -> None:
        """A step has ended. Its result has "failed" or "skipped" if it measured nothing."""
        ...

    def written(self, contact: Contact) -> None:
        """The file of a device was written, also after a stop or a fault."""
        ...


@dataclass(frozen=True, slots=True)
class Contact:
    """The first contact with one device.

    Attributes:
        device: Its name.
        path: The file that was written.
        content: Content of the file.
        units: See :class:`labseq.roles.first_contact.FirstContact`.
        failed: Names of the steps that were taken and failed.
    """

    device: str
    path: Path
    content: Mapping[str, Any]
    units: Mapping[str, Sequence[str]]
    failed: Sequence[str]


@dataclass(frozen=True, slots=True)
class Wanted:
    """The user's choices for a first contact.

    Attributes:
        role: The device. "" for all that are more than virtual.
        steps: Only these steps, or all if empty. Steps that are not taken keep their earlier results.
        data: The data folder.
    """

    role: str
    steps: Sequence[str]
    data: Path


def meet_devices(
    profile: str,
    wanted: Wanted,
    overrides: Sequence[str],
    dry_run: DryRun,
    dialogue: Dialogue,
    warn: Callable[[str], object],
) -> list[Contact]:
    """Take the steps of the first contact with one or all devices of a profile, and write a file for each.

    Raises:
        ConfigError: The profile has an error, there is no such device or step, or an earlier file does not
            belong to the device.
        DeviceError: A device cannot be opened, is another model, is in use, or is not safe after a step.
        RecordingError: The data folder cannot be written. Nothing was opened.
        StopRequested: Ctrl-C. The device is safe, and the completed steps are in its file.
    """
    check_dry_run(dry_run)
    hardware = resolve_profile(profile, overrides=profile_overrides(overrides), dry_run=dry_run)
    names = _names(hardware, wanted.role)
    _check_writable(wanted.data / FOLDER)
    hardware = replace(
        hardware,
        chosen={name: hardware.chosen[name] for name in (*names, "simulation") if name in hardware.chosen},
    )
    stop = StopFlag()
    clock = VirtualClock(stop) if hardware.virtual_time else RealClock(stop)
    with ExitStack() as stack:
        stack.enter_context(lock_devices(hardware, "labseq first-contact", warn))
        stack.enter_context(stop_on_signals(stop))
        constructed, refused = construct_hardware(hardware, clock)
        for error in refused.values():
            raise error
        simulation = constructed.pop("simulation", None)
        contacts: list[Contact] = []
        for name, device in in_opening_order(constructed):
            if isinstance(device, OffersFirstContact):
                # again without the simulation, because a simulator's output here must not act on atoms
                alone = replace(hardware, chosen={name: hardware.chosen[name]})
                offer = construct_hardware(alone, clock)[0][name].first_contact()
                meeting = _Meeting(name, offer, hardware, stop, dialogue, warn)
                contacts.append(meeting.hold(wanted))
            else:
                timeouts = hardware.profile.timeouts
                *_, checked = check_each_device([(name, device)], timeouts, stop, simulation, warn)
                contacts.append(_identity_only(name, device, checked, wanted.data))
                dialogue.written(contacts[-1])
            stop.check()
    return contacts


def _names(hardware: ResolvedProfile, role: str) -> list[str]:
    """The devices to meet, either the named one or all that are not virtual twins."""
    devices = {name: choice for name, choice in hardware.chosen.items() if choice.entry.role.is_hardware}
    if role and role not in devices:
        what = f"the profile has no device '{role}'"
        raise ConfigError(Problem(what, str(hardware.document.path), expected=one_of(sorted(devices))))
    names = [name for name, choice in devices.items() if role in ("", name) and not choice.entry.virtual_time]
    if not names:
        what = f"{role or 'every device of the profile'} is virtual, so there is no device to meet"
        hint = "choose a driver for the device or its simulator with 'use:' in the profile"
        raise ConfigError(Problem(what, str(hardware.document.path), hint=hint))
    return names


def _check_writable(folder: Path) -> None:
    """Check that the folder is writable, so that readings of an oscilloscope need not be taken twice.

    Raises:
        RecordingError: The folder, or a file in it, cannot be made.
    """
    with explained(folder):
        make_folder(folder)
        with TemporaryFile(dir=folder):
            pass


def _identity_only(name: str, device: Hardware, checked: CheckedDevice, data: Path) -> Contact:
    """Identity, settings and limits of a device whose driver offers no steps.

    Raises:
        LabseqError: It cannot be opened, identified, made safe or closed.
    """
    for error in (checked.failure, checked.unsafe, checked.unclosed):
        if error is not None:
            raise error
    described = checked.described
    limits = {key: getattr(device, key) for key in ("facts", "lines_facts") if hasattr(device, key)}
    versions = {what: found for what, (found, _) in checked.versions.items()}
    card = {key: str(described.get(key) or "") for key in ("model", "firmware")}
    card |= {"serial": str(described.get("serial_number") or name), "driver": versions.get("driver", "")}
    measured = {"identity": {**described, "versions": versions, "limits": limits}}
    content = _content(card, measured, {"reason": NO_STEPS}, simulated=False)
    return _written(name, contact_path(data, f"{name}-{card['serial']}"), content, {}, [])


def _content(
    card: Mapping[str, Any], measured: Mapping[str, Any], verdict: Mapping[str, Any], *, simulated: bool
) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "labseq": labseq.__version__,
        "ended_utc": now_utc("seconds"),
        "card": {**card, "simulated": simulated},
        "computer": this_computer(),
        "measured": measured,
        "verdict": verdict,
    }


def _written(
    name: str,
    path: Path,
    content: Mapping[str, Any],
    units: Mapping[str, Sequence[str]],
    failed: Sequence[str],
) -> Contact:
    write_contact(path, content)
    return Contact(name, path, read_contact(path), units, failed)


class _Meeting:
    """The first contact with one device whose driver offers steps."""

    def __init__(
        self,
        name: str,
        contact: FirstContact,
        hardware: ResolvedProfile,
        stop: StopFlag,
        dialogue: Dialogue,
        warn: Callable[[str], object],
    ) -> None:
        self._name, self._contact, self._stop, self._dialogue = name, contact, stop, dialogue
        self._timeouts, self._warn = hardware.profile.timeouts, warn
        self._guard = Guard(stop)
        self._watchdog = Watchdog("labseq first-contact", pulse=stop.pulse)

    def hold(self, wanted: Wanted) -> Contact:
        """Open the device, take the steps, make it safe and close it whatever happens, and write the file.

        Steps that were taken before a stop or a fault are written, too.
        """
        name, contact, guard = self._name, self._contact, self._guard
        steps = _chosen(contact.steps, wanted.steps)
        load_kernels()
        taken = dict[str, dict[str, Any]]()
        error: LabseqError | None = None
        try:
            card = guard.call_despite_stop(name, self._timeouts.call_s, contact.open)
            emergency = guard.call_despite_stop(name, self._timeouts.call_s, contact.emergency)
            if emergency is not None:
                self._watchdog.add(name, 0, emergency.script, dict(emergency.arguments))
            path = contact_path(wanted.data, str(card["serial"]), simulated=contact.is_simulated)
            earlier = _earlier(path, card, must_belong=bool(wanted.steps))
        except BaseException:
            self._end()
            raise
        try:
            for step in steps:
                if self._dialogue.may_take(name, step, self._stop):
                    taken[step.name] = self._take(step)
        except LabseqError as stopped:
            error = stopped
        finally:
            unsafe, unclosed = self._end()
        problem = unsafe or error or unclosed
        if problem is not None and not taken:
            raise problem
        try:
            return self._write(path, card, earlier, taken)
        finally:
            if problem is not None:
                raise problem

    def _write(
        self,
        path: Path,
        card: Mapping[str, Any],
        earlier: Mapping[str, dict[str, Any]],
        taken: Mapping[str, dict[str, Any]],
    ) -> Contact:
        """Judge and write the measurements, including earlier ones."""
        contact, measured = self._contact, {**earlier, **taken}
        measured = {step.name: measured[step.name] for step in contact.steps if step.name in measured}
        content = _content(card, measured, contact.judge(measured), simulated=contact.is_simulated)
        failed = [step for step, result in taken.items() if "failed" in result]
        met = _written(self._name, path, content, contact.units, failed)
        self._dialogue.written(met)
        return met

    def _take(self, step: ContactStep) -> dict[str, Any]:
        """Take a step, make the device safe, and ask for the readings.

        Raises:
            DeviceError: The device is not safe after it.
            StopRequested: Ctrl-C.
        """
        try:
            result = dict(self._guard.call(self._name, step.limit_s, step.run))
        except StopRequested:
            raise
        except LabseqError as error:
            result = {"failed": str(error)}
        with self._stop.held():
            unsafe = attempt(self._guard, self._name, self._timeouts.safe_state_s, self._contact.safe_state)
        if unsafe is not None:
            raise unsafe
        self._stop.check()
        if not {"failed", "skipped"} & result.keys():
            result |= {reading.name: self._dialogue.reads(reading, self._stop) for reading in step.readings}
        self._dialogue.ended(result)
        return result

    def _end(self) -> tuple[LabseqError | None, LabseqError | None]:
        """Make the device safe and close it. If it is not safe, the watchdog switches it off."""
        with self._stop.held():  # a second Ctrl-C must not leave it on
            limit_s = self._timeouts.safe_state_s
            unsafe = attempt(self._guard, self._name, limit_s, self._contact.safe_state)
            unclosed = attempt(self._guard, self._name, limit_s, self._contact.close)
        if unsafe is None:
            self._watchdog.forget([self._name])
        self._watchdog.end()
        for note in self._watchdog.notes():
            self._warn(note)
        self._guard.end()
        return unsafe, unclosed


def _chosen(steps: Sequence[ContactStep], names: Sequence[str]) -> list[ContactStep]:
    known = {step.name: step for step in steps}
    for name in names:
        if name not in known:
            raise ConfigError(f"--step: there is no step '{name}'; expected {one_of(list(known))}")
    return [step for step in steps if not names or step.name in names]


def _earlier(path: Path, card: Mapping[str, Any], *, must_belong: bool) -> dict[str, Any]:
    """The results of an earlier first contact with the same card on this computer. Empty without a file.

    Args:
        path: The file.
        card: The identity of the device.
        must_belong: Whether to refuse a file about another card, instead of beginning a new one.

    Raises:
        ConfigError: The file was edited, or is about another card, driver, firmware or computer.
    """
    if not path.exists():
        return {}
    try:
        content = read_contact(path)
        check_belongs(content, card, path)
    except ConfigError:
        if must_belong:
            raise
        return {}
    return dict(content["measured"])
