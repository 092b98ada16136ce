"""Opening devices and closing them, at the ends of a run and between two points of a scan."""

from __future__ import annotations

from collections.abc import Collection

from labseq.roles import NeedsSettling
from labseq.sequencer.clock import StopFlag
from labseq.sequencer.guard import LATE_S, Guard
from labseq.sequencer.lab import Lab
from labseq.sequencer.leading import Emit


def open_devices(lab: Lab, guard: Guard, stop: StopFlag, emit: Emit, names: Collection[str]) -> None:
    """Open the simulation and the devices of these names; then wait for those that need time.

    Static tweezers among them are turned on.

    Raises:
        LabseqError: One of them fails, or the run is asked to stop.
    """
    timeout_s = lab.timeouts.call_s
    simulation = () if lab.simulation is None else (("simulation", lab.simulation),)
    for name, part in (*simulation, *lab.hardware()):
        if name in names:
            stop.check()
            # Nothing is made safe beside an open() that is only slow: what that does last would undo it.
            guard.call_to_the_end(name, timeout_s, part.open)
    if "static_tweezers" in names:
        guard.call("static_tweezers", timeout_s, lab.static_tweezers.load, None)
        guard.call("static_tweezers", timeout_s, lab.static_tweezers.start)
    for name, device in lab.hardware():
        if name in names and isinstance(device, NeedsSettling) and (longest_s := device.settling_timeout_s) > 0:
            emit("settling", {"device": name, "timeout_s": longest_s})
            guard.call(name, longest_s + LATE_S, device.settle)


def close_devices(lab: Lab, guard: Guard, names: Collection[str]) -> None:
    """Make the devices of these names safe, all of them first, then close them.

    Raises:
        LabseqError: One of them fails.
    """
    timeout_s = lab.timeouts.safe_state_s
    devices = [(name, device) for name, device in lab.safe_order() if name in names]
    for name, device in devices:
        guard.call_to_the_end(name, timeout_s, device.safe_state)
    for name, device in devices:
        guard.call_to_the_end(name, timeout_s, device.close)
    if lab.simulation is not None and "simulation" in names:
        guard.call_to_the_end("simulation", timeout_s, lab.simulation.close)
