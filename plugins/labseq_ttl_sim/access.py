"""The simulated box of ``port: simulated``, whose outputs the simulation receives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from labseq_ttl.access import MAX_WAIT_S
from labseq_ttl.box import late_error
from labseq_ttl.programs import mask_of
from labseq_ttl.protocol import TICK_S, Edge
from labseq_ttl.settings import TtlSettings

from labseq.plugin import Context, DeviceError, LineProgram, LineSpec
from labseq.plugin.leader import load_until_go
from labseq.plugin.serial import Port
from labseq_ttl_sim.model import ModelBox

ROUNDING_S: Final = 1e-9


class SimulatedAccess:
    """A simulated box. It plays a program at once, while the session's clock decides how long that takes.

    Attributes:
        box: The box, while connected.
    """

    max_wait_s = MAX_WAIT_S
    real_time = False

    def __init__(self, settings: TtlSettings, context: Context) -> None:
        self._name = context.name or "lines"
        self._settings = settings
        self._context = context
        self._clock = context.clock
        self._simulation = context.simulation
        self._specs = context.lines
        self.box: ModelBox | None = None

    def connect(self) -> Port:
        """Turn a new box on, and return its open serial port."""
        self.box = self._new_box()
        return self.box.port

    def disconnect(self) -> None:
        """Turn the box off. No effect if there is none."""
        box, self.box = self.box, None
        if box is not None:
            box.close()

    def lines_set(self, program: LineProgram) -> None:
        """The driver has set the lines to the state of this program, at once."""
        if self._simulation is not None:
            self._simulation.play("lines", program, self._clock.now())

    def fired(self, program: LineProgram | None) -> None:
        """Pass the outputs of a fired program to the simulation."""
        edges = self._connected().played()
        if program is not None:
            self.lines_set(as_played(edges, program, self._specs))

    def is_over(self, end_s: float) -> bool:
        """Whether a program that the box has played is over on the session's clock."""
        return self._clock.now() >= end_s - ROUNDING_S

    def wait_until(self, end_s: float, timeout_s: float) -> float:
        """Let the session's time pass until the end of a program.

        Returns:
            How long to wait for the box, in seconds.
        """
        left_s = end_s - self._clock.now()
        self._clock.sleep(max(0.0, min(left_s, timeout_s)))
        if left_s > timeout_s + ROUNDING_S:
            raise late_error(self._name, timeout_s)
        return self.max_wait_s

    def raise_go(self, timeout_s: float) -> float:
        """Play the leader, who loads atoms if there are none, then raises `go`.

        Returns:
            How long to wait for the box, in seconds.
        """
        assert self._settings.go is not None
        load_until_go(self._context, self._settings.go.simulated_go_delay, timeout_s)
        self._connected().start()
        return self.max_wait_s

    def _new_box(self) -> ModelBox:
        return ModelBox()

    def _connected(self) -> ModelBox:
        if self.box is None:
            raise DeviceError(self._name, "the simulated box is not connected")
        return self.box


def as_played(edges: Sequence[Edge], program: LineProgram, specs: Sequence[LineSpec]) -> LineProgram:
    """The played edges as a program, in ticks since the first, without edges that changed nothing."""
    bits = [mask_of([True], [spec]) for spec in specs]  # other outputs may belong to a leader
    edges = [(tick, mask & sum(bits)) for tick, mask in edges]
    changes = [edge for i, edge in enumerate(edges) if i == 0 or edge[1] != edges[i - 1][1]]
    on = [[bool(mask & bit) for bit in bits] for _, mask in changes]
    t_s = np.array([tick for tick, _ in changes], np.float64) * TICK_S
    states = np.array(on, np.bool_).reshape(len(changes), len(specs))
    return LineProgram(program.kind, program.lines, t_s, states, program.begin_s, program.duration_s)
