"""The simulated camera as the driver uses it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from labseq_pylablib.interfaces import Dcam
from labseq_pylablib.library import module_for
from labseq_pylablib.settings import PylablibSettings

from labseq.plugin import Context
from labseq.plugin.camera import ExposureResult
from labseq.plugin.lines import trigger_line
from labseq_dcam_sim.camera import SimulatedCamera
from labseq_dcam_sim.library import SimulatedLibrary
from labseq_dcam_sim.properties import ROW_PAIR_S, STEP_PX


class SimulatedConnection(Dcam):
    """pylablib on a simulated library with one camera, whose sensor is the simulation's.

    It takes the place of any interface in a dry run. The steps of the region are a DCAM camera's only where
    the settings name ``dcam``.

    Attributes:
        simulated: The camera.
        others: Further cameras at the same computer.
    """

    def __init__(self, settings: PylablibSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._world, self._shape = settings.simulated_world(context)
        step_px = STEP_PX if settings.interface == "dcam" else 1
        arm_s = settings.arming_time
        self.simulated = SimulatedCamera(
            self._world, context.clock, self._shape, arm_s=arm_s, step_px=step_px
        )
        self.simulated.model = settings.model.upper() or self.simulated.model
        self.others: list[SimulatedCamera] = []
        if trigger_line(context.lines, "camera") is not None:
            self._world.wire("camera", self.simulated.trigger)

    @property
    def sensor_shape(self) -> tuple[int, int] | None:
        """The shape of the simulation's sensor."""
        return self._shape

    @property
    def expected_readout_s(self) -> float:
        """The camera's read-out time with these settings, in seconds."""
        _, _, height, _ = self.settings.mode.region or (0, 0, *self._shape)
        return -(-height // 2) * ROW_PAIR_S[0 if self.settings.readout_mode == "slow" else 1]

    def warm(self) -> None:
        """Import pylablib, and compute the common part of all simulated frames."""
        super().warm()
        self._world.prepare_sensor(self.settings.mode)

    def load(self) -> Any:
        """Pylablib with the simulated library."""
        return module_for(self.vendor, SimulatedLibrary([self.simulated, *self.others]))

    def take(self, look: Callable[[float], ExposureResult | None], timeout_s: float) -> ExposureResult | None:
        """Wait on the session's clock until a frame is due, then in real time until the driver sees it."""
        return self.simulated.exposures.take(look, timeout_s)
