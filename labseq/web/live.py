"""Sends the state of runs to browsers. A slow browser misses states without delaying the others."""

from __future__ import annotations

import asyncio
import contextlib
import zlib
from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

from labseq.errors import LabseqError
from labseq.messages import format_error
from labseq.web.endpoint import encode, in_thread
from labseq.web.runs import Catalogue, NoSuchRun, OpenRun, text_of
from labseq.web.state import Limits, RunState, alarm

POLL_S: Final = 0.1
"""Interval in seconds at which the files of a run in progress are read while a browser watches it."""
HEARTBEAT_S: Final = 15.0
"""Maximum time between two messages, in seconds, so that a dead connection is noticed."""
MAX_VIEWERS: Final = 100
MAX_VIEWERS_OF_ADDRESS: Final = 50
_THREADS: Final = ThreadPoolExecutor(2, "labseq web live")
"""Separate, so that pages that watch many runs do not keep other requests waiting for a thread."""


class Channel:
    """The state of one run, or of the newest, for all browsers that watch it.

    Only the latest state is kept, encoded once for all. A slow browser gets the latest state when it is
    ready for the next one.

    Args:
        read: Returns the state of the run. It may take time, and is called in a thread.
    """

    def __init__(self, read: Callable[[], dict[str, Any]]) -> None:
        self._read = read
        self._changed = asyncio.Event()
        self._text = self._shot = ""
        self._task: asyncio.Task[None] | None = None
        self.n_viewers = 0
        self.version = 0

    async def states(self, after: str) -> AsyncGenerator[str, None]:
        """The states as server-sent events, from now until the browser leaves.

        The last shot, which is half of a state, is a separate event, sent before the state if it is new.

        Args:
            after: Id of the last event that the browser has. The current state is skipped if it is the same.
        """
        self.n_viewers += 1
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._follow())
        seen, shot_seen, is_first = 0, "", True
        try:
            while True:
                if self.version == seen:
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(self._changed.wait(), HEARTBEAT_S)
                text, shot, is_new = self._text, self._shot, self.version > seen
                seen = self.version
                if not is_new:
                    yield ": still here\n\n"
                elif not (is_first and after == _id_of(text + shot)):
                    changed = f"event: shot\ndata: {shot}\n\n" if shot != shot_seen else ""
                    yield f"{changed}id: {_id_of(text + shot)}\nevent: state\ndata: {text}\n\n"
                    shot_seen = shot
                is_first = False
        finally:
            self.n_viewers -= 1

    async def _follow(self) -> None:
        """Read the run while at least one browser watches it."""
        while self.n_viewers:
            state = await in_thread(self._read, _THREADS)
            shot, text = encode(state.pop("shot", None)), encode(state)
            if (text, shot) != (self._text, self._shot):
                self._text, self._shot = text, shot
                self.version += 1
                self._changed.set()
                self._changed = asyncio.Event()
            is_running = (state.get("run") or {}).get("status") == "running"
            is_changing = is_running or (state.get("scan") or {}).get("is_busy")
            await asyncio.sleep(POLL_S if is_changing or state.get("error") else 1.0)


class Live:
    """The states of the runs that browsers watch.

    Args:
        limits: When alarms are raised.
    """

    def __init__(self, catalogue: Catalogue, limits: Limits) -> None:
        self._catalogue = catalogue
        self._limits = limits
        self._channels: dict[str, Channel] = {}
        self._states: dict[str, RunState] = {}
        self._n_of_address: Counter[str] = Counter()

    def has_room(self, address: str) -> bool:
        """Whether an address may open one more page that follows a run."""
        return self.n_viewers < MAX_VIEWERS and self._n_of_address[address] < MAX_VIEWERS_OF_ADDRESS

    async def states(self, channel: Channel, after: str, address: str) -> AsyncIterator[str]:
        """The states of a channel, for a page of an address, see :meth:`Channel.states`."""
        self._n_of_address[address] += 1
        try:
            async with contextlib.aclosing(channel.states(after)) as states:
                async for state in states:
                    yield state
        finally:
            self._n_of_address[address] -= 1
            self._n_of_address += Counter()  # removes addresses without connections

    @property
    def n_viewers(self) -> int:
        """Number of open connections."""
        return sum(channel.n_viewers for channel in self._channels.values())

    def channel(self, day: str, name: str, quantity: str) -> Channel:
        """The channel of a run and a quantity of its scan. If day and name are empty, of the newest run."""
        self._channels = {key: channel for key, channel in self._channels.items() if channel.n_viewers}
        key = f"{day}/{name}/{quantity}"
        if key not in self._channels:
            self._channels[key] = Channel(lambda: self.state(day, name, quantity))
        return self._channels[key]

    def state(self, day: str = "", name: str = "", quantity: str = "") -> dict[str, Any]:
        """The state of a run. Default: the newest. If it cannot be read, "error" says why."""
        try:
            run = self._catalogue.open(day, name) if name else self._catalogue.newest()
            if run is None:
                return {"run": None, "running": [], "alarms": [], "error": ""}
            return self.state_of(run).update(quantity) | {"running": self._catalogue.running(), "error": ""}
        except Exception as error:  # noqa: BLE001 - the page must stay, whatever a damaged file causes
            is_known = isinstance(error, LabseqError | OSError | NoSuchRun)
            text = text_of(error if is_known else format_error(error))
            alarms = [alarm("error", "This cannot be shown", text)]
            return {"run": None, "running": [], "alarms": alarms, "error": text}

    def state_of(self, run: OpenRun) -> RunState:
        """The state of a run, kept for the last eight runs."""
        state = self._states.get(run.id)
        if state is None or state.run is not run:
            state = self._states[run.id] = RunState(run, self._limits)
            while len(self._states) > 8:
                del self._states[next(iter(self._states))]
        return state


def _id_of(text: str) -> str:
    return f"{zlib.crc32(text.encode('utf-8', 'replace')):08x}"
