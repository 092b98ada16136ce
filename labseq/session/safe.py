"""``labseq safe``: open each device of a profile, make it safe, close it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from labseq.config import ProblemCollector, load_profile, plugin_paths, profile_overrides
from labseq.errors import ConfigError, LabseqError, RecordingError, StopRequested
from labseq.recording import clear_active, data_root, died, marker_roots
from labseq.roles import Clock, Hardware, RunObserver, Simulation
from labseq.sequencer import Guard, RealClock, StopFlag, VirtualClock
from labseq.sequencer.lab import Timeouts, in_safe_order
from labseq.session.choosing import HARDWARE_KINDS, ResolvedProfile
from labseq.session.constructing import construct_each
from labseq.session.holding import lock_devices
from labseq.session.labs import timeouts_of
from labseq.session.setting_up import choose_plugins, load_plugins
from labseq.session.signals import stop_on_signals

_NEEDED_KINDS: Final = HARDWARE_KINDS | {"simulation"}


@dataclass(frozen=True, slots=True)
class SafeStateReport:
    """What became of the devices of a profile.

    Attributes:
        tried: Name of each device that could be constructed -> why it is not safe, or None.
        refused: Name of each other -> why not, with its place in the profile.
        problems: What else is wrong with the profile, or None.
    """

    attempted: Mapping[str, LabseqError | None]
    refused: Mapping[str, LabseqError]
    problems: ConfigError | None = None

    @property
    def failures(self) -> list[LabseqError]:
        """Why devices are not safe, those that were tried first; empty if all are."""
        return [error for error in [*self.attempted.values(), *self.refused.values()] if error is not None]


def make_each_safe(
    devices: Iterable[tuple[str, Hardware]],
    timeouts: Timeouts,
    simulation: Simulation | None = None,
    observer: RunObserver | None = None,
) -> dict[str, LabseqError | None]:
    """Open, make safe and close each device; one that fails never stops the others.

    Args:
        devices: Name and device, in the order of the safe state.
        timeouts: How long each call may take.
        simulation: The world that virtual devices act on.
        observer: Told each device's outcome.

    Returns:
        Device name -> why it is not safe, or None. One that is safe and only cannot be
        closed is told to the observer alone, as at the end of a run.
    """
    guard = Guard(StopFlag())
    outcome: dict[str, LabseqError | None] = {}
    if simulation is not None:
        guard.call_to_the_end("simulation", timeouts.call_s, simulation.open)
    for name, device in devices:
        opened = attempt(guard, name, timeouts.call_s, device.open)
        # Perhaps it can be made safe even if it did not open.
        safe = attempt(guard, name, timeouts.safe_state_s, device.safe_state)
        closed = attempt(guard, name, timeouts.safe_state_s, device.close)
        outcome[name] = opened or safe
        if observer is not None:
            for event, failure in (("safe_state", outcome[name]), ("closed", closed)):
                observer.event(event, {"device": name, "ok": failure is None, "error": str(failure or "")})
    if simulation is not None:
        guard.call_to_the_end("simulation", timeouts.call_s, simulation.close)
    guard.end()
    return outcome


def attempt(guard: Guard, name: str, timeout_s: float, method: Callable[[], None]) -> LabseqError | None:
    """Call a device to the end, stop request or not; returns why it failed, or None."""
    try:
        guard.call_to_the_end(name, timeout_s, method)
    except LabseqError as failure:
        return failure
    return None


def construct_hardware(bench: ResolvedProfile, clock: Clock) -> tuple[dict[str, Any], dict[str, LabseqError]]:
    """Construct the devices of a profile, and the simulation if there is one; nothing is opened.

    Args:
        bench: The profile.
        clock: What they keep to.

    Returns:
        Role or device name -> object, and -> why it could not be constructed, with its place.
    """
    chosen = {role: c for role, c in bench.chosen.items() if c.entry.kind in _NEEDED_KINDS}
    made, _, failures = construct_each(
        chosen,
        bench.grid,
        bench.profile.motion,
        clock,
        seed=0,
        calibrations=bench.calibrations,
        world_grid=bench.profile.grid_model(),
        lines=bench.profile.line_specs,
    )
    return made, {role: chosen[role].placed(error) for role, error in failures.items()}


def make_profile_devices_safe(bench: ResolvedProfile, stop: StopFlag, observer: RunObserver | None = None) -> SafeStateReport:
    """Construct each device of a profile, open it, make it safe and close it.

    One that cannot be constructed never keeps the others from it; it is told at the end.

    Args:
        bench: The profile.
        stop: The request to stop; not obeyed here.
        observer: Told each device's outcome.
    """
    clock = VirtualClock(stop) if bench.virtual_time else RealClock(stop)
    made, failures = construct_hardware(bench, clock)
    simulation = made.pop("simulation", None)
    with stop.held():
        attempted = make_each_safe(in_safe_order(made), timeouts_of(bench.profile), simulation, observer)
    refused: dict[str, LabseqError] = {role: e for role, e in bench.refused.items() if role != "detector"}
    refused |= failures
    if observer is not None:
        for role, error in refused.items():
            observer.event("safe_state", {"device": role, "ok": False, "error": str(error)})
    return SafeStateReport(attempted, refused)


def make_safe_after_crash(
    bench: ResolvedProfile, roots: Sequence[Path], key: str, stop: StopFlag, observer: RunObserver
) -> None:
    """If the last run on a profile died, its devices may still be on: make them safe.

    Before anything else is constructed or compiled, which may fail.

    Args:
        bench: The profile.
        roots: See :func:`labseq.recording.marker_roots`.
        key: What its hardware is known by.
        stop: The request to stop; obeyed once every device has been tried.
        observer: Told each device's outcome, and warnings.

    Raises:
        LabseqError: The first device that is not safe.
        StopRequested: Ctrl-C or SIGTERM came meanwhile.
    """
    dead = died(roots, key)
    if dead is None:
        return
    text = f"the last run on this profile ({dead}) died; its devices are made safe first"
    observer.event("warning", {"text": text})
    failures = make_profile_devices_safe(bench, stop, observer).failures
    if failures:
        raise failures[0]
    try:
        clear_active(roots, key)
    except RecordingError as failure:
        observer.event("warning", {"text": str(failure)})
    stop.check()


def make_profile_safe(
    profile: str, overrides: Sequence[str] = (), observer: RunObserver | None = None
) -> SafeStateReport:
    """Bring every device of a profile to its safe state.

    It does so whoever else uses them, and says who does: a run in progress fails, or is seen to be at
    work again. Ctrl-C does not leave it half done: it is obeyed once every device has been tried. If
    all are safe, nothing is left to do for the next run, whatever became of the last one.

    Args:
        profile: Name or path of the profile.
        overrides: ``"profile.address=value"`` strings, as given to ``--set``.
        observer: Told each device's outcome, and warnings.

    Raises:
        ConfigError: The profile cannot be read, or does not exist; no device was touched.
        StopRequested: Ctrl-C or SIGTERM came meanwhile.
    """
    found, roots = ProblemCollector(), marker_roots(data_root())  # now: vendors' libraries change the folder
    bench = _read(profile, overrides, found)
    key, stop = bench.hardware_key, StopFlag()

    def warn(text: str) -> None:
        if observer is not None:
            observer.event("warning", {"text": text})

    with ExitStack() as stack:
        if not bench.virtual_time:
            stack.enter_context(lock_devices(bench, roots, "labseq safe", warn, in_spite=True))
        stack.enter_context(stop_on_signals(stop))
        secured = make_profile_devices_safe(bench, stop, observer)
    told = [problem for error in bench.refused.values() for problem in error.problems]
    others = [problem for problem in found.problems if problem not in told]
    # A problem or an override may have left a device out, or put another in its place.
    if not (secured.failures or others or overrides):
        try:
            clear_active(roots, key)
        except RecordingError as failure:
            warn(str(failure))
    if stop.is_set:
        raise StopRequested(stop.signal_number)
    return replace(secured, problems=ConfigError(others) if others else None)


def _read(profile: str, overrides: Sequence[str], found: ProblemCollector) -> ResolvedProfile:
    """Read a profile and choose its devices, past everything that is wrong but can be gone past."""
    for_profile = profile_overrides(overrides)
    document, spec = load_profile(profile, beside=Path(), overrides=for_profile, found=found)
    with found:
        plugin_paths(document, spec.plugin_folders)
    folders: list[Path] = []
    for folder in spec.plugin_folders:
        with suppress(ConfigError):  # told already
            folders += plugin_paths(document, [folder])
    return choose_plugins(document, spec, load_plugins(folders, found, spec.timeouts.load), "off", found)
