"""An open box, real or simulated."""

from __future__ import annotations

from typing import Final

from labseq.plugin import Clock, DeviceError
from labseq_ttl.box import Box
from labseq_ttl.counterpart import Counterpart, start_simulator
from labseq_ttl.heartbeat import Heartbeat
from labseq_ttl.port import open_box
from labseq_ttl.settings import TtlSettings

MAX_WAIT_S: Final = 1.0
"""How long an answer of a real box may take, in seconds."""

SIMULATED_MAX_WAIT_S: Final = 15.0
"""The same of a simulated one, on a computer that is busy."""


class Connection:
    """Opens the port, sees that the right box is there, and sets what stays the same.

    Args:
        settings: Which box.
        polarity: Outputs that are low when they are on: bit n is channel n.
        device: Name of the box, for messages.
        clock: The session's clock.

    Attributes:
        box: The box.
        counterpart: What simulates it; None if it is real.
        identity: What it said of itself.
        n_runs: Programs that it has played since its last start.

    Raises:
        DeviceError: It does not answer, or is another than the profile says.
    """

    def __init__(self, settings: TtlSettings, polarity: int, device: str, clock: Clock) -> None:
        self.counterpart: Counterpart | None = None
        self._heartbeat: Heartbeat | None = None
        if settings.is_simulated:
            self.counterpart = start_simulator(settings.simulated_by, device, clock)
            max_wait_s = SIMULATED_MAX_WAIT_S
        else:
            max_wait_s = MAX_WAIT_S
        try:
            port = open_box(settings.port, device) if self.counterpart is None else self.counterpart.port
            self.box = Box(port, device, clock, max_wait_s)
        except BaseException:
            if self.counterpart is not None:
                self.counterpart.close()
            raise
        try:
            self.identity = self.box.identify()
            self._set_up(settings, polarity, device)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release everything; legal in any state."""
        if self._heartbeat is not None:
            self._heartbeat.stop()
        self.box.line.close()
        if self.counterpart is not None:
            self.counterpart.close()

    def _set_up(self, settings: TtlSettings, polarity: int, device: str) -> None:
        wanted, came = settings.serial_number, self.identity.serial_number
        if not settings.is_simulated and wanted is not None and wanted != came:
            text = f"the box at {settings.port} has the serial number {came}; expected {wanted}"
            raise DeviceError(device, f"{text}; is this the right port?")
        self.box.line.drop_messages()
        self.box.line.ask("off")
        state = self.box.state()
        self.n_runs = state.runs
        if state.polarity != polarity:
            self.box.set_polarity(polarity)
        timeout_s = 0.0 if settings.is_simulated else settings.watchdog_timeout
        self.box.set_watchdog_timeout(timeout_s)
        if timeout_s:
            line = self.box.line
            self._heartbeat = Heartbeat(lambda: line.send(b"\n"), timeout_s)  # an empty line is not answered
            self._heartbeat.start()
