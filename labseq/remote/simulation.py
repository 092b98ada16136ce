"""The simulation that is served: devices of its own server act on it, and of other servers.

Devices of other servers join the run that a client has begun here. The simulation calls them back: it asks
simulated cards and radios what they have played, and triggers cameras and cards. Each of these has a session
of its own, whose client waits for questions with the call ``next``; the answer is in the one that follows.
While an answer is awaited, other calls are carried out, because a camera that is triggered exposes a frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, Final

from labseq.assembly.lab import construct
from labseq.errors import DeviceError
from labseq.remote.served import CLOSED, Run, ServedDevice, Session
from labseq.roles import Context
from labseq.wire import MessageError, error_of, pack

METHODS: Final = frozenset(
    {"begin_shot", "load", "play", "expose", "describe", "truth", "losses", "atom_events", "warnings"}
    | {"readout_fraction", "prepare_sensor", "warm", "wire", "connect_outputs"}
)


class ServedSimulation(ServedDevice):
    """The simulation of each run of a client, in one thread."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._methods = METHODS
        self._properties = ("sensor_shape", "loading_probability")
        self._waiting: set[Session] = set()
        self._answers: dict[Session, Mapping[str, Any]] = {}
        self._asking: Run | None = None
        self._later: deque[list[Any]] = deque()

    def rescue_stuck(self) -> None:
        """A simulation has no outputs."""

    def _construct(self, session: Session, context: Context, about: Mapping[str, Any]) -> Any:
        run = session.run
        session.joins = about["joins"] is not None
        if not session.joins:
            made, streams = construct({"simulation": self._chosen}, context, about["seed"])
            run.streams += streams
            run.simulation, run.begun_by = made["simulation"], session
            return run.simulation
        if run.simulation is None:
            text = (
                "the run that uses the device has no simulation here; add it to the profile of the experiment"
            )
            raise DeviceError(self.name, f"{text}: `simulation: {{use: remote, address: ...}}`")
        return run.simulation.seen_by(about["joins"]) if about["joins"] else run.simulation

    def _reply(
        self, session: Session, args: list[Any], named: dict[str, Any], now_s: Any, place: Any
    ) -> list[Any]:
        if session.call != "next":
            return super()._reply(session, args, named, now_s, place)
        self._waiting.add(session)
        self._answers[session] = args[0] if args and isinstance(args[0], Mapping) else {}
        return []  # the reply is the next question

    def _call(self, session: Session, args: list[Any], named: dict[str, Any]) -> Any:
        if session.call == "wire":
            return session.device.wire(args[0], _Pulses(self, session))
        if session.call == "connect_outputs":
            return session.device.connect_outputs(args[0], _Outputs(self, session, args[0]))
        return getattr(session.device, session.call)(*args, **named)

    def _open(self, session: Session) -> None:
        session.device.open()

    def _close_device(self, session: Session) -> None:
        if session.run.begun_by is session:
            session.run.begun_by = None
            self._close_if_unused(session.run)

    def _close(self, session: Session) -> None:
        super()._close(session)
        self._answers.pop(session, None)
        if session.run.begun_by is session:
            session.run.begun_by = None
        self._close_if_unused(session.run)

    def _close_if_unused(self, run: Run) -> None:
        """Close the simulation of a run that has ended, once no device that it used acts on it any more.

        Servers make simulated devices safe when their client is gone, which may be later than here.
        """
        others = [one for one in self.sessions.values() if one.run is run and one.joins]
        if run.begun_by is None and not others and run.simulation is not None:
            run.simulation.close()
            run.simulation = None

    def _step(self) -> None:
        while self._later and self._asking is None:
            self._handle(self._later.popleft())
        super()._step()
        for session in [one for one in self._waiting if one.ended]:
            self._waiting.remove(session)
            session.running_s = float("nan")
            self._send(session.sender, self._refusal(session.number, session.ended))

    def _handle(self, frames: list[Any]) -> None:
        """Carry out a call; one of another run has to wait while an answer is awaited."""
        if self._asking is not None:
            sender = bytes(frames[0])
            if any(one.sender == sender and one.run is not self._asking for one in self.sessions.values()):
                self._later.append(frames)
                return
        super()._handle(frames)

    def ask(self, session: Session, *question: Any) -> Any:
        """Ask a simulated device at another server, and carry out other calls until it has answered.

        Raises:
            LabseqError: What the device raised; or ``DeviceError``: its server is gone.
        """
        self._await(session)
        clock, run = session.clock, session.run
        now_s = clock.now() if clock is not None and clock.virtual else None
        try:
            parts = pack({"n": session.number, "value": [now_s, run.place, *question], "waits": []})
        except MessageError as error:
            raise DeviceError(self.name, f"a question to {session.who}: {error}") from error
        self._waiting.remove(session)
        session.reply, session.running_s = parts, float("nan")
        self._send(session.sender, parts)
        self._await(session)
        answer = self._answers[session]
        if "error" in answer:
            raise error_of(answer["error"], self.name, session.who)
        return answer.get("value")

    def _await(self, session: Session) -> None:
        """Carry out calls until a session waits for a question."""
        asking, self._asking = self._asking, session.run
        try:
            while session not in self._waiting:
                if session.ended or session.token not in self.sessions:
                    why = session.ended or "its connection is closed"
                    raise DeviceError(self.name, f"{session.who} cannot be asked: {why}")
                self._step()
        finally:
            self._asking = asking


class _Pulses:
    """Triggers a simulated device at another server: called by the simulation at each pulse of its line."""

    def __init__(self, served: ServedSimulation, session: Session) -> None:
        self._served, self._session = served, session

    def __call__(self, t_s: float, width_s: float) -> None:
        if self._session.ended != CLOSED:
            self._served.ask(self._session, t_s, width_s)


class _Outputs:
    """The outputs of a simulated device at another server: an ``RfSource`` or a ``ToneSource``."""

    def __init__(self, served: ServedSimulation, session: Session, role: str) -> None:
        self._served, self._session, self._role = served, session, role

    def played(self, until_s: float) -> Any:
        """What they have played since the last call; a device that was closed plays nothing."""
        if self._session.ended == CLOSED:
            return ([], []) if self._role == "mobile_tweezers" else ()
        return self._served.ask(self._session, until_s)
