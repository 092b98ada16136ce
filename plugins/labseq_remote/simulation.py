"""The simulation that simulated devices of a server act on, from this process or another server."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, TypeAlias

from labseq.plugin import Context, DeviceError, LabseqError, Simulation, wire
from labseq.plugin.simulation import RfSource, ToneSource
from labseq_remote.connection import Connection, Joins, run_of
from labseq_remote.link import Link, called, known
from labseq_remote.settings import RemoteSimulationSettings

CatchUp: TypeAlias = Callable[[float | None, tuple[int, int] | None], object]


class _Asked:
    """Answers the questions that the simulation has for a simulated device of this process.

    Each question is the reply to a call ``next`` and is answered with the next one. Calls that an answer
    needs go over the same connection, because the simulation is waiting there.

    Args:
        connection: A connection of its own.
        answer: The device's function.
        catch_up: Called with time and shot of the simulation before it.
    """

    def __init__(self, connection: Connection, answer: Callable[..., Any], catch_up: CatchUp) -> None:
        self.connection = connection
        self._answer = answer
        self._catch_up = catch_up
        self.thread = threading.Thread(target=self._serve, name="labseq outputs", daemon=True)
        self.thread.start()

    def _serve(self) -> None:
        answer: dict[str, Any] = {}
        with suppress(LabseqError):  # the connection has ended
            while True:
                try:
                    question = self.connection.call("next", answer, stoppable=False)
                except DeviceError as error:
                    if not isinstance(error.__cause__, wire.MessageError):
                        raise
                    answer = {"error": wire.report_error(error)}  # the answer is too large
                    continue
                now_s, place, *args = question
                self._catch_up(now_s, place)
                try:
                    answer = {"value": self._answer(*args)}
                except Exception as error:  # noqa: BLE001 - of the driver's class; it goes to the simulation
                    answer = {"error": wire.report_error(error)}
        self.connection.close()


class RemoteSimulation(Simulation):
    """The simulation that simulated devices of a server act on; it keeps to the clock of this run.

    Args:
        settings: Where it is.
        context: What the simulation there is constructed with, too.
    """

    def __init__(self, settings: RemoteSimulationSettings, context: Context) -> None:
        self._settings, self._context = settings, context
        self.link = Link(settings, context, "simulation")
        self._first: Callable[[], object] = self.link.connect
        self._catch_up: CatchUp = lambda _now_s, _place: None
        self._asked: dict[tuple[str, str], _Asked] = {}

    def join(self, run: bytes, catch_up: CatchUp) -> None:
        """Use the simulation that a run has there, for the simulated devices of a server."""
        self.link.joins, self._catch_up = Joins(run), catch_up

    def seen_by(self, camera: str) -> RemoteSimulation:
        """What a camera receives that is not the camera of the atoms."""
        view = RemoteSimulation(self._settings, self._context)
        run = run_of(self._context.clock).key if self.link.joins is None else self.link.joins.run
        view._first = self.connect
        view.link = Link(self._settings, self._context, "simulation", self.connect)
        view.link.joins = Joins(run, camera)
        return view

    def connect(self) -> None:
        """Construct it at the server, or join that of the run."""
        self._first()

    def open(self) -> None:
        """Draw the disorder of the machine."""
        self.link.open()

    def close(self) -> None:
        """Discard the state."""
        for asked in self._asked.values():
            asked.connection.close()
        self._asked.clear()
        with suppress(DeviceError):  # the server does it by itself when the connection is lost
            self.link.close()

    def wire(self, role: str, on_pulse: Callable[[float, float], object]) -> None:
        """Have the simulation there trigger a simulated device of this process."""
        self._answer("wire", role, on_pulse)

    def connect_outputs(self, role: str, source: RfSource | ToneSource) -> None:
        """Have the simulation there ask a simulated device of this process what it has played."""
        self._answer("connect_outputs", role, source.played)

    def _answer(self, what: str, role: str, function: Callable[..., Any]) -> None:
        self.connect()
        asked = self._asked.get((what, role))
        if asked is not None:
            asked.connection.close()
        joins = self.link.joins or Joins(run_of(self._context.clock).key)
        connection = self.link.another(joins)
        connection.call(what, role)
        self._asked[what, role] = _Asked(connection, function, self._catch_up)

    def call(self, name: str, *args: Any) -> Any:
        """Call a method, also while an answer is made to a question that came from there."""
        here = threading.current_thread()
        connection = next((one.connection for one in self._asked.values() if one.thread is here), None)
        return (connection or self.link.connect()).call(name, *args)

    def describe(self) -> Mapping[str, Any]:
        """Every constant of the model, and where it runs."""
        return self.link.describe()

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """That of the served simulation."""
        rows, columns = self.link.known("sensor_shape", (0, 0))
        return rows, columns

    warm = called("warm")
    begin_shot = called("begin_shot")
    load = called("load")
    play = called("play")
    prepare_sensor = called("prepare_sensor")
    expose = called("expose")
    truth = called("truth")
    losses = called("losses")
    atom_events = called("atom_events")
    warnings = called("warnings")
    readout_fraction = called("readout_fraction")
    loading_probability = known("loading_probability", None)  # pyright: ignore[reportIncompatibleMethodOverride]
