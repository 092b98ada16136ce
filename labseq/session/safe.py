"""``labseq safe``: open each device of a profile, make it safe, close it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from labseq.config import split_overrides
from labseq.errors import LabseqError, StopRequested
from labseq.roles import Hardware, RunObserver, Simulation
from labseq.sequencer import Guard, RealClock, StopFlag, VirtualClock
from labseq.sequencer.lab import Timeouts, in_safe_order
from labseq.session.assembly import set_up_bench, timeouts_of
from labseq.session.choosing import HARDWARE_KINDS, construct
from labseq.session.signals import stop_on_signals


def secure(
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
        opened = _try(guard, name, timeouts.call_s, device.open)
        safe = _try(guard, name, timeouts.safe_state_s, device.safe_state)  # perhaps even if it did not open
        closed = _try(guard, name, timeouts.safe_state_s, device.close)
        outcome[name] = opened or safe
        if observer is not None:
            for event, failure in (("safe_state", outcome[name]), ("closed", closed)):
                observer.event(event, {"device": name, "ok": failure is None, "error": str(failure or "")})
    if simulation is not None:
        guard.call_to_the_end("simulation", timeouts.call_s, simulation.close)
    guard.end()
    return outcome


def _try(guard: Guard, name: str, timeout_s: float, method: Callable[[], None]) -> LabseqError | None:
    try:
        guard.call_to_the_end(name, timeout_s, method)
    except LabseqError as failure:
        return failure
    return None


def make_profile_safe(
    profile: str, overrides: Sequence[str] = (), observer: RunObserver | None = None
) -> dict[str, LabseqError | None]:
    """Bring every device of a profile to its safe state.

    Args:
        profile: Name or path of the profile.
        overrides: ``"profile.address=value"`` strings, as given to ``--set``.
        observer: Told each device's outcome.

    Ctrl-C does not leave it half done: it is obeyed once every device has been tried.

    Returns:
        Device name -> what went wrong, or None.

    Raises:
        ConfigError: The profile is wrong or does not exist.
        PluginLoadError: A plugin that it names failed to load.
        StopRequested: Ctrl-C or SIGTERM came meanwhile.
    """
    _, for_profile = split_overrides(overrides)
    bench = set_up_bench(profile, overrides=for_profile)
    stop = StopFlag()
    clock = VirtualClock(stop) if bench.virtual_time else RealClock(stop)
    needed = HARDWARE_KINDS | {"simulation"}
    chosen = {role: c for role, c in bench.chosen.items() if c.entry.kind in needed}
    made, _ = construct(chosen, bench.grid, bench.profile.motion, clock, seed=0)
    simulation = made.pop("simulation", None)
    with stop_on_signals(stop), stop.held():
        outcome = secure(in_safe_order(made), timeouts_of(bench.profile), simulation, observer)
    if stop.is_set:
        raise StopRequested(stop.signal_number)
    return outcome
