"""A device that is served: its thread and socket, and the sessions of clients with it.

Each client has an object of the driver of its own, constructed from the context that it sends. One of them at
a time, the owner, may open it; the others may ask for what is known without opening, and for what the owner's
describes. All calls are made in the device's one thread, in the order of their numbers.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

from labseq.assembly.lab import construct
from labseq.assembly.plugin_choice import ChosenPlugin
from labseq.errors import ConfigError, DeviceError, LabseqError, StopRequested
from labseq.files import devices_root
from labseq.guard import StopFlag
from labseq.kernel import load_kernels
from labseq.messages import format_error
from labseq.model import RandomStream
from labseq.recording import clear_active, mark_active
from labseq.roles import ROLES, Clock, Context, NeedsWarmUp, overrides
from labseq.roles.simulation import JoinsRun
from labseq.sequencer.clock import RealClock, VirtualClock
from labseq.watchdog import Watchdog
from labseq.wire import MAX_CONNECTIONS, Connections, MessageError, pack, report_error, unpack

LOOK_S: Final = 0.03
"""How often threads that wait look for what else there is to do."""
GRACE_S: Final = 0.3
"""How long a call may take to end after it was aborted, before the device is made safe beside it."""
RESCUE_S: Final = 5.0
"""How long that may take; then the watchdog switches the device off."""

MAX_REASONS: Final = 64
"""Number of sessions whose end is remembered, for clients that ask later."""

CLOSED: Final = "closed"
"""Why a session is over that the client has ended."""

_COMMON: Final = frozenset(
    {"safe_state", "describe", "versions", "warm", "settle", "self_test", "poll", "check_interlocks"}
)
METHODS: Final[Mapping[str, frozenset[str]]] = {
    "camera": _COMMON | {"arm", "disarm", "trigger", "read"},
    "static_tweezers": _COMMON | {"load", "start", "ramp", "release", "leave_on"},
    "mobile_tweezers": _COMMON | {"check_program", "prepare", "play", "wait", "prepare_beginning", "append"},
    "device": _COMMON | {"command", "read", "check_command"},
    "lines": _COMMON | {"check_program", "idle", "compile", "arm", "fire", "wait"},
}
"""Kind of device -> what clients may call, beside ``open`` and ``close``."""
_OF_HARDWARE: Final = ("settling_timeout_s", "idle_output")
_LIVE: Final = ("start_delay_s", "beginning_s")
PROPERTIES: Final[Mapping[str, tuple[str, ...]]] = {
    "camera": (*_OF_HARDWARE, "facts"),
    "static_tweezers": (*_OF_HARDWARE, "facts"),
    "mobile_tweezers": (*_OF_HARDWARE, "waits_for_trigger", *_LIVE),
    "device": _OF_HARDWARE,
    "lines": (*_OF_HARDWARE, "lines_facts"),
}
_CHANGES_LIVE: Final = frozenset({"prepare", "prepare_beginning", "append", "play"})
_LOOKS: Final = frozenset({"describe", "versions"})
"""What a client that is not the owner gets from the owner's device."""
_WITHOUT_OPENING: Final = _LOOKS | {"safe_state", "warm", "check_program", "check_command"}
"""What it may call."""


class Abort(StopFlag):
    """The request to end the call in progress; the next call begins without it."""

    def clear(self) -> None:
        """Take the request back."""
        self._event.clear()


class SharedTime(VirtualClock):
    """The virtual time of a client's run, for all its devices here.

    Attributes:
        waits_s: The waits of the call in progress, which the client repeats on its own clock.
    """

    def __init__(self) -> None:
        super().__init__(StopFlag())
        self.waits_s: list[float] = []

    def sleep(self, duration_s: float) -> None:
        """Advance virtual time, and remember it."""
        super().sleep(duration_s)
        self.waits_s.append(duration_s)

    def begin_call(self, now_s: float) -> list[float]:
        """Take over the client's time; returns what receives the waits."""
        self._now_s, self.waits_s = now_s, []
        return self.waits_s

    def catch_up(self, now_s: float) -> None:
        """Take over a later time of another server of the run."""
        self._now_s = max(self._now_s, now_s)


class DeviceTime(VirtualClock):
    """The virtual time of a run for one device: an abort of its call ends a wait in it, and no other's."""

    def __init__(self, shared: SharedTime, abort: Abort) -> None:
        super().__init__(abort)
        self._shared = shared

    def now(self) -> float:
        """The time of the run."""
        return self._shared.now()

    def sleep(self, duration_s: float) -> None:
        """Advance it."""
        self.check()
        self._shared.sleep(duration_s)


@dataclass(eq=False)
class Run:
    """What the sessions of one run of a client share: virtual time, random numbers and the simulation.

    Attributes:
        key: Names the run at all servers.
        simulation: The simulation, if this server has it.
        begun_by: The session that constructed it.
    """

    key: bytes
    clock: SharedTime = field(default_factory=SharedTime)
    streams: list[RandomStream] = field(default_factory=list[RandomStream])
    place: tuple[int, int] | None = None
    simulation: Any = None
    begun_by: Session | None = None

    def begin_shot(self, place: tuple[int, int]) -> None:
        """Start the random numbers of a shot, unless it is under way."""
        if place != self.place:
            self.place = place
            for stream in self.streams:
                stream.begin_shot(*place)

    def catch_up(self, now_s: float | None, place: tuple[int, int] | None) -> None:
        """Take over time and shot from the server of the simulation, when that asks a device here."""
        if now_s is not None:
            self.clock.catch_up(now_s)
        if place is not None:
            self.begin_shot(place)


@dataclass(eq=False)
class Session:
    """A client's connection to a device.

    Attributes:
        peer: The client's public key; "" without keys.
        who: What the client calls itself, for other users.
        run: See :class:`Run`.
        connection: The connection that its signs of life come from; see :class:`Connections`.
        token: Names the session in each message.
        beat_s: When it last gave a sign of life.
        ended: Why it is over; "" while it is not.
        number: Number of the last call.
        reply: The parts of its reply; empty while it is carried out.
        sender: The sender's name at the device's socket.
        running_s: When it began; nan while none is carried out.
        aborted_s: When it was aborted, to be made safe beside it; inf if it was not.
        rescue: The outcome of that: "", "under way", "safe", or why it failed.
        is_rescued: Set unless that is under way.
        is_safe: Whether nothing was called since a safe state that succeeded.
        changing: Held where a call ends, and where it is decided to make the device safe beside it.
        joins: Whether it uses a simulation that another session has begun.
        simulation: The simulation of another server that its device acts on, or None.
    """

    peer: str
    who: str
    run: Run
    connection: tuple[int, int]
    token: bytes = field(default_factory=lambda: secrets.token_bytes(16))
    beat_s: float = field(default_factory=time.monotonic)
    ended: str = ""
    number: int = 0
    reply: list[Any] = field(default_factory=list[Any])
    sender: bytes = b""
    call: str = ""
    running_s: float = float("nan")
    aborted_s: float = float("inf")
    rescue: str = ""
    is_rescued: threading.Event = field(default_factory=threading.Event)
    changing: threading.Lock = field(default_factory=threading.Lock)
    abort: Abort = field(default_factory=Abort)
    clock: Clock | None = None
    device: Any = None
    joins: bool = False
    simulation: Any = None
    is_open: bool = False
    is_safe: bool = False
    watchdog: Watchdog | None = None

    def __post_init__(self) -> None:
        self.is_rescued.set()

    @property
    def is_running(self) -> bool:
        """Whether a call is carried out."""
        return self.running_s == self.running_s  # not nan


class ServedDevice:
    """A device, the thread that makes all calls into it, and the socket that they come from.

    Attributes:
        owner: The session that opened the device, or None.
        sessions: Token -> session.
        ended: Token -> why that session ended, of the last ones.
        is_busy: Whether its thread does something else than wait for messages.
        failure: What ended its thread, or None.

    Args:
        name: Its role, or its name in the profile.
        chosen: Its plugin.
        socket: A ROUTER; used in the device's thread only.
        is_known: Whether a client's key is still known.
        report: Receives what happens, for the operator.
        simulation: The plugin of a simulation at another server, or None.
        identities: What identifies the device, for its marker; none of a simulated one.
    """

    def __init__(
        self,
        name: str,
        chosen: ChosenPlugin,
        socket: Any,
        is_known: Callable[[str], bool],
        report: Callable[[str], object],
        simulation: ChosenPlugin | None = None,
        identities: Collection[str] = (),
    ) -> None:
        self.name = name
        self.kind = chosen.entry.kind
        self.owner: Session | None = None
        self.sessions: dict[bytes, Session] = {}
        self.ended: dict[bytes, str] = {}
        self.is_busy = False
        self.failure: BaseException | None = None
        self._chosen = chosen
        self._socket = socket
        self._is_known = is_known
        self._report = report
        self._simulation = simulation
        self._identities = identities
        self._key = f"labseq serve-devices {name}"
        self._methods = METHODS.get(self.kind, frozenset())
        self._properties = PROPERTIES.get(self.kind, ())
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=f"labseq {name}", daemon=True)

    def start(self) -> None:
        """Start its thread."""
        self._thread.start()

    def begin_end(self) -> None:
        """Begin to end all sessions, the device safe and closed, and then its thread."""
        for session in list(self.sessions.values()):
            self.end_session(session, "the server ends")
        self._ended.set()

    @property
    def is_alive(self) -> bool:
        """Whether its thread runs."""
        return self._thread.is_alive()

    def end_session(self, session: Session, why: str) -> None:
        """Have a session ended by the device's thread, at once or after the call in progress."""
        if not session.ended:
            session.ended = why
            self.abort(session)

    def why_ended(self, token: Any) -> str:
        """Why a session is not there."""
        return self.ended.get(token, "the connection has ended, or the server was started again")

    def abort(self, session: Session) -> None:
        """Ask the call in progress to end."""
        if session.is_running:
            session.aborted_s = min(session.aborted_s, time.monotonic())
            session.abort.request()

    def rescue_stuck(self) -> None:
        """Make the device safe in another thread if a call does not end after it was aborted."""
        for session in list(self.sessions.values()):
            self._rescue_if_stuck(session)

    def _rescue_if_stuck(self, session: Session) -> None:
        with session.changing:
            if session.rescue or not session.is_running or time.monotonic() < session.aborted_s + GRACE_S:
                return
            session.rescue = "under way"
            session.is_rescued.clear()
        threading.Thread(target=self._rescue, args=[session], daemon=True).start()

    def _rescue(self, session: Session) -> None:
        outcome = ["it hangs"]

        def make_safe() -> None:
            try:
                with session.abort.held():
                    session.device.safe_state()
                outcome[0] = ""
            except Exception as error:  # noqa: BLE001 - of the driver's class
                outcome[0] = format_error(error)

        thread = threading.Thread(target=make_safe, daemon=True)
        thread.start()
        thread.join(RESCUE_S)
        session.rescue = outcome[0] or "safe"
        self._report(f"{self.name}: {session.call}() does not return; made safe beside it: {session.rescue}")
        if outcome[0] and session.watchdog is not None:
            session.watchdog.end()  # it switches off what it was not asked to forget
        session.is_rescued.set()

    def _serve(self) -> None:
        import zmq

        self._socket.set(zmq.RCVTIMEO, int(1e3 * LOOK_S))
        connections, looked_s = Connections(self._socket), time.monotonic()
        try:
            while not (self._ended.is_set() and not self.sessions):
                if time.monotonic() - looked_s > LOOK_S:
                    connections.ended()  # nothing asks which
                    connections.limit(0 if self._ended.is_set() else MAX_CONNECTIONS)
                    looked_s = time.monotonic()
                self._step()
        except BaseException as error:  # noqa: BLE001 - the main thread ends the server
            self.failure = error
        finally:
            for session in list(self.sessions.values()):
                self.end_session(session, "the server failed")
                self._close(session)
            connections.close()
            self._socket.close()

    def _step(self) -> None:
        """Answer the next message, if one comes within LOOK_S, and close sessions that have ended."""
        import zmq

        self.is_busy = False
        try:
            frames = self._socket.recv_multipart(copy=False)
        except zmq.Again:
            frames = []
        self.is_busy = True
        if frames:
            self._handle(frames)
        for session in [one for one in self.sessions.values() if one.ended and not one.is_running]:
            self._close(session)

    def _handle(self, frames: list[Any]) -> None:
        try:
            self._send(frames[0], self._answer(frames))
        except Exception as error:  # noqa: BLE001 - no message may end this thread
            self._report(f"{self.name}: a message could not be answered: {format_error(error)}")

    def _send(self, receiver: Any, parts: list[Any]) -> None:
        import zmq

        if parts:
            with suppress(zmq.ZMQError):  # the client is gone
                self._socket.send_multipart([receiver, *parts], copy=False)

    def _answer(self, frames: list[Any]) -> list[Any]:
        """The reply to a message; empty for one that is not answered."""
        try:
            message = unpack([frame.buffer for frame in frames[1:]])
            session = self.sessions.get(message["session"])
            number, call, args = message["n"], message["call"], message["args"]
            now_s, place, named = message["now"], message["shot"], message["named"]
            if type(number) is not int or type(call) is not str or not isinstance(args, list):
                raise MessageError("it is not a call")
            if not isinstance(named, dict) or type(now_s) not in (float, type(None)):
                raise MessageError("it is not a call")
        except MessageError as error:
            return self._refusal(0, f"the server cannot read a message: {error}")
        except (KeyError, TypeError) as error:
            return self._refusal(0, f"the server cannot read a message: {format_error(error)}")
        if session is None:
            return self._refusal(number, self.why_ended(message["session"]))
        peer = frames[-1].get("User-Id") if session.peer else ""
        if peer != session.peer or session.ended:
            return self._refusal(number, session.ended or "the connection belongs to another key")
        if not self._is_known(session.peer):
            self.end_session(session, "its key was withdrawn")
            return self._refusal(number, session.ended)
        if number <= session.number:
            return session.reply if number == session.number else []  # sent twice, or an old one again
        if number != session.number + 1:
            self.end_session(session, f"its calls came out of order: {number} after {session.number}")
            return self._refusal(number, session.ended)
        session.number, session.call, session.reply = number, call, []
        session.sender = bytes(frames[0])
        session.abort.clear()
        session.aborted_s, session.rescue, session.running_s = float("inf"), "", time.monotonic()
        session.reply = self._reply(session, args, named, now_s, place)
        if session.reply:  # else it comes later
            with session.changing:
                session.running_s = float("nan")
            session.is_rescued.wait()  # a driver need not bear further calls beside safe_state()
        return session.reply

    def _refusal(self, number: int, text: str) -> list[Any]:
        return pack({"n": number, "error": report_error(DeviceError(self.name, text)), "now": 0.0})

    def _reply(
        self, session: Session, args: list[Any], named: dict[str, Any], now_s: Any, place: Any
    ) -> list[Any]:
        waits_s = [] if now_s is None else session.run.clock.begin_call(now_s)
        answer: dict[str, Any] = {"n": session.number}
        try:
            if isinstance(place, tuple) and len(place) == 2:
                session.run.begin_shot((int(place[0]), int(place[1])))
            answer["value"] = self._carry_out(session, args, named)
            answer["state"] = self._state(session)
        except BaseException as error:  # noqa: BLE001 - of the driver's class; it goes to the client
            if session.ended and isinstance(error, StopRequested):
                error = DeviceError(self.name, f"the server has ended the connection: {session.ended}")
            answer["error"] = report_error(error)
        answer["now"] = time.monotonic()
        answer["waits"] = waits_s
        try:
            return pack(answer)
        except MessageError as error:
            failure = DeviceError(self.name, f"what {session.call}() gave cannot be sent: {error}")
            return pack({"n": session.number, "error": report_error(failure), "now": answer["now"]})

    def _carry_out(self, session: Session, args: list[Any], named: dict[str, Any]) -> Any:
        call = session.call
        if call == "attach":
            return self._attach(session, *args)
        if session.device is None:
            raise DeviceError(self.name, "the connection has no device yet")
        if call == "open":
            return self._open(session)
        if call == "close":
            return self._close_device(session)
        if call not in self._methods:
            raise DeviceError(self.name, f"a client cannot call {call[:40]!r}")
        if call == "warm":
            if isinstance(session.device, NeedsWarmUp):  # a simulation need not
                session.device.warm()
            return load_kernels()
        value = self._call(session, args, named)
        return dict(value) if isinstance(value, Mapping) else value

    def _call(self, session: Session, args: list[Any], named: dict[str, Any]) -> Any:
        """Call a method of the driver."""
        call, device = session.call, session.device
        if not session.is_open and call not in _WITHOUT_OPENING:
            raise DeviceError(self.name, "this connection has not opened it")
        if call == "safe_state":
            return self._make_safe(session) if session.is_open else None
        if call in _LOOKS and self.owner is not None:
            device = self.owner.device
        session.is_safe = session.is_safe and call in _WITHOUT_OPENING
        value = getattr(device, call)(*args, **named)
        if call == "leave_on" and value:
            session.is_safe = True  # it must not be switched off
            self._give_up(session)
        return value

    def _make_safe(self, session: Session) -> None:
        session.is_safe = False
        with session.abort.held():
            session.device.safe_state()
        session.is_safe = True

    def _attach(self, session: Session, about: dict[str, Any]) -> dict[str, Any]:
        """Construct the client's object of the driver."""
        if about["virtual"] and not self._chosen.virtual_time:
            text = f"'{self.name}' is a real device, and the profile says `simulated: true`"
            raise ConfigError(text)
        abort = session.abort
        session.clock = DeviceTime(session.run.clock, abort) if about["virtual"] else RealClock(abort)
        context = Context(
            about["name"],
            about["grid"],
            about["motion"],
            session.clock,
            calibrations=about["calibrations"],
            lines=tuple(about["lines"]),
        )
        session.device = self._construct(session, context, about)
        return {
            "abilities": self._abilities(session.device),
            "plugin": self._chosen.entry.name,
            "settings": self._chosen.dump(),
        }

    def _abilities(self, device: Any) -> list[str]:
        """What its class does itself; for the rest, the client need not ask."""
        base = ROLES[self.kind].base
        return [name for name in self._methods if overrides(device, getattr(base, name))]

    def _construct(self, session: Session, context: Context, about: Mapping[str, Any]) -> Any:
        run, seed = session.run, about["seed"]
        simulation = run.simulation
        if simulation is None and self._simulation is not None:
            made, _ = construct({"simulation": self._simulation}, context, seed)
            session.simulation = simulation = made["simulation"]
            joined: JoinsRun = simulation
            joined.join(run.key, run.catch_up)
        made, streams = construct({context.name: self._chosen}, replace(context, simulation=simulation), seed)
        run.streams += streams
        if run.place is not None:
            for stream in streams:
                stream.begin_shot(*run.place)
        return made[context.name]

    def _state(self, session: Session) -> dict[str, Any]:
        """Values of properties that the last call may have changed."""
        if session.call in ("attach", "open"):
            names = self._properties
        elif session.call in _CHANGES_LIVE and self.kind == "mobile_tweezers":
            names = _LIVE
        else:
            return {}
        state = {name: getattr(session.device, name) for name in names}
        if self.kind == "mobile_tweezers":
            state["timings"] = dict(session.device.timings())
        return state

    def _open(self, session: Session) -> None:
        if self.owner not in (None, session):
            assert self.owner is not None
            raise DeviceError(self.name, f"in use by {self.owner.who}; one at a time can use it")
        if self.owner is None:
            self._report(f"{self.name}: in use by {session.who}")
        self.owner, session.is_open, session.is_safe = session, True, False
        self._mark()
        with session.abort.held():
            session.device.open()
        emergency = session.device.emergency()
        if emergency is not None and session.watchdog is None:
            session.watchdog = Watchdog(
                "labseq serve-devices", lost=partial(self.end_session, session), may_end=True
            )
            session.watchdog.add(self.name, 0, emergency.script, dict(emergency.arguments))
            for note in session.watchdog.notes():
                self._report(f"{self.name}: {note}")

    def _close_device(self, session: Session) -> None:
        """Close it; the owner gives it up, and learns if it is not safe."""
        if not session.is_open:
            with session.abort.held():
                session.device.close()
        elif failures := self._end_use(session):
            raise DeviceError(self.name, "; ".join(failures))

    def _end_use(self, session: Session) -> list[str]:
        """Make the device of a session safe, unless it is, close it and give it up; returns what failed."""
        failures: list[str] = []

        def attempt(method: Callable[[], object], what: str) -> None:
            try:
                method()
            except BaseException as error:  # noqa: BLE001 - of the driver's class
                failures.append(f"{what} failed: {format_error(error)}")

        with session.abort.held():
            if not session.is_safe:
                attempt(partial(self._make_safe, session), "safe_state()")
            attempt(session.device.close, "close()")
        if not session.is_safe:
            acts = "its watchdog switches it off" if session.watchdog else "nothing else can switch it off"
            failures.append(f"it is NOT SAFE: {acts}")
        self._give_up(session)
        return failures

    def _give_up(self, session: Session) -> None:
        """Let others use the device. A watchdog that is not to forget it switches it off."""
        session.is_open = False
        if self.owner is session:
            self.owner = None
        if session.watchdog is not None:
            if session.is_safe:
                session.watchdog.forget([self.name])
            session.watchdog.end()
            session.watchdog = None
        if session.is_safe and self._identities:
            with suppress(LabseqError):
                clear_active(self._key, self._identities)

    def _mark(self) -> None:
        """Leave a marker until the device is safe, as a run does: `labseq safe` and `devices` see it."""
        if self._identities:
            try:
                mark_active(self._key, self._identities, devices_root() / f"labseq serve-devices {self.name}")
            except LabseqError as error:
                self._report(f"{self.name}: {error}")

    def _close(self, session: Session) -> None:
        """End a session: its device is made safe and closed if the client has not done so."""
        self.ended = {**dict([*self.ended.items()][-MAX_REASONS:]), session.token: session.ended}
        del self.sessions[session.token]
        if session.is_open:
            begun_s = time.monotonic()
            failures = self._end_use(session)
            outcome = "; ".join(failures) or f"made safe in {1e3 * (time.monotonic() - begun_s):.0f} ms"
            self._report(f"{self.name}: the connection of {session.who} ended ({session.ended}); {outcome}")
        if session.simulation is not None:  # whose server may not answer: other sessions must not wait
            threading.Thread(target=session.simulation.close, daemon=True).start()
