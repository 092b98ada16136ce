"""Alarms for shots in which the machine does not see or move atoms. They need no check in the sequence.

A camera that sees nothing, a laser that is off or a stage that does not move give shots that look complete.
Each alarm warns when it begins. After some shots in a row it ends the run, so that a night is not lost.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.config.profile import AlarmSettings
from labseq.errors import AlarmError
from labseq.messages import clean
from labseq.model import ShotRecord, follow_atoms
from labseq.sequencer.clock import CLOCK_SET, SLEPT
from labseq.units import format_quantity

LEAST_COMPARED: Final = 10
"""Minimum number of loadings to compare with, because the mean of fewer is too uncertain."""
LEAST_ATOMS: Final = 100
"""Minimum number of sites, or of moved atoms, to judge a fraction by, as fewer may alarm by chance."""
LEAST_CONFIDENCES: Final = 1000
"""The same for the confidence, which depends on a few doubtful sites."""


class Latest:
    """A fraction of sites or atoms, over as few recent shots as together have enough of them.

    Args:
        least: The number that is enough.
    """

    def __init__(self, least: int) -> None:
        self._least = least
        self._counts = deque[tuple[float, int]](maxlen=least)
        self.n: float = 0
        self.n_of = 0

    def add(self, n: float, n_of: int) -> float:
        """Add a shot. Returns the share, or nan as long as there are not enough."""
        self._counts.append((n, n_of))
        # as few shots as are enough, because old shots say little about the machine now
        while sum(count[1] for count in self._counts) - self._counts[0][1] >= self._least:
            self._counts.popleft()
        self.n, self.n_of = sum(n for n, _ in self._counts), sum(n_of for _, n_of in self._counts)
        return self.n / self.n_of if self.n_of >= self._least else math.nan

    @property
    def shots(self) -> str:
        """The number of shots as text, or "" for only the last shot."""
        return f", in the last {len(self._counts)} shots" if len(self._counts) > 1 else ""


class Alarms:
    """Looks at each shot of a run.

    Args:
        settings: The limits.
        warn: Receives its name and a message when an alarm begins.
    """

    def __init__(self, settings: AlarmSettings, warn: Callable[[str, str], None]) -> None:
        self._settings = settings
        self._warn = warn
        self._in_a_row: dict[str, int] = {}
        self._texts: dict[str, str] = {}
        self._frame: NDArray[np.uint16] | None = None
        # maximum number of earlier shots whose loading a shot is compared with
        self._loadings = defaultdict[str, deque[int]](lambda: deque(maxlen=20))
        self._atoms, self._full = Latest(LEAST_ATOMS), Latest(self._settings.full)
        self._confidences = defaultdict[int, Latest](lambda: Latest(LEAST_CONFIDENCES))
        self._arrived = Latest(LEAST_ATOMS)

    def look(self, shot: ShotRecord) -> None:
        """Look at a shot that was taken. Incomplete attempts are left out."""
        if shot.status != "complete":
            return
        found = dict(self._signs(shot))
        self._in_a_row = {name: self._in_a_row.get(name, 0) + 1 for name in found}
        self._texts = found
        for name, text in found.items():
            if self._in_a_row[name] == 1:
                self._warn(name, f"shot {shot.shot_index}: alarm '{name}': {text}")

    def raise_if_lasting(self) -> None:
        """End the run if an alarm has lasted too long.

        Raises:
            AlarmError: An alarm has lasted too long.
        """
        limit = self._settings.stop_after
        for name, n in self._in_a_row.items():
            if limit and n >= limit:
                raise AlarmError(name, self._texts[name], n)

    def _signs(self, shot: ShotRecord) -> Iterator[tuple[str, str]]:
        """Name and text of each alarm that a shot gives."""
        yield from self._frames(shot)
        yield from self._first_image(shot)
        yield from self._detection(shot)
        yield from self._moves(shot)
        yield from self._clock(shot)

    def _frames(self, shot: ShotRecord) -> Iterator[tuple[str, str]]:
        # the first and the last image are enough, and the others of a long shot would take time
        for image in (*shot.images[:1], *shot.images[1:][-1:]):
            if image.frame is None:
                continue
            frame, before, which = image.frame.image, self._frame, f"image '{clean(image.name)}'"
            self._frame = frame
            highest = int(frame.max())
            share = np.count_nonzero(frame == highest) / frame.size
            if share > self._settings.saturated:
                what = (
                    f"{100 * share:.3g} % of the pixels of {which} have its highest value, {highest} counts"
                )
                yield "saturated", f"{what}; check the light, the gain, and whether the camera sees anything"
            if self._settings.frozen and before is not None and np.array_equal(frame, before):
                what = f"{which} is identical to the image before, pixel by pixel"
                yield "frozen", f"{what}; the camera or its driver delivers an old frame"

    def _first_image(self, shot: ShotRecord) -> Iterator[tuple[str, str]]:
        """No loading, loading everywhere, or far less than in earlier shots with the same settings."""
        if not shot.images:
            return
        occupancy, settings = shot.images[0].occupancy, self._settings
        n_atoms, n_sites = int(np.count_nonzero(occupancy)), occupancy.size
        if (atoms := self._atoms).add(n_atoms, n_sites) < settings.atoms:
            what = f"{_atoms(atoms.n)} on the first image, at {atoms.n_of} sites{atoms.shots}"
            yield "atoms", f"{what}; check the source of atoms, the tweezers and the camera"
        if settings.full and self._full.add(n_atoms, n_sites) == 1.0:
            what = f"all {self._full.n} sites are full on the first image{self._full.shots}"
            yield "full", f"{what}; check the thresholds and the light"
        others = self._loadings[repr(shot.parameters)]
        if len(others) >= LEAST_COMPARED:
            mean = float(np.mean(others))
            # 5 standard deviations below the mean, because few sites often load only half of
            # the mean
            least = mean - 5.0 * math.sqrt(mean * (1.0 - mean / n_sites))
            if n_atoms < min(settings.loading * mean, least):
                yield "loading", f"{_atoms(n_atoms)} loaded, {mean:.3g} on average in earlier shots"
                return  # later shots are compared with shots before the failure
        others.append(n_atoms)

    def _detection(self, shot: ShotRecord) -> Iterator[tuple[str, str]]:
        images = [image for image in shot.images if image.cycle < 0]
        sums = [(image.step, np.nan_to_num(image.confidence, nan=1.0)) for image in images]
        shares = [self._confidences[step].add(one.sum(), one.size) for step, one in sums]
        if low := [share for share in shares if share < self._settings.confidence]:
            what = f"the detector's confidence is only {100 * min(low):.3g} % on average over the sites"
            yield "confidence", f"{what}; check its thresholds and width against gain and exposure"

    def _moves(self, shot: ShotRecord) -> Iterator[tuple[str, str]]:
        """Whether atoms are seen at the sites to which the first cycle moved them."""
        for before, after in pairwise(shot.images) if shot.cycles else ():
            cycle = shot.cycles[0]
            if (after.step, after.cycle) != (cycle.step, cycle.cycle):
                continue
            moved, _ = follow_atoms(before.occupancy, [cycle])
            came = moved & ~before.occupancy  # on other sites an atom may be seen although none moved
            n_moved, n_seen = int(came.sum()), int((came & after.occupancy).sum())
            if (arrived := self._arrived).add(n_seen, n_moved) < self._settings.arrived:
                what = f"{arrived.n} of {arrived.n_of} atoms arrived on sites that were empty{arrived.shots}"
                yield "arrived", f"{what}; check light, trigger and overlay of the mobile tweezers"

    def _clock(self, shot: ShotRecord) -> Iterator[tuple[str, str]]:
        slept_s, set_s = (shot.readings.get(name, 0.0) for name in (SLEPT, CLOCK_SET))
        if slept_s > self._settings.clock:
            slept = format_quantity(slept_s, "time")
            yield "clock", f"the computer slept for {slept}; turn off its automatic suspend"
        elif abs(set_s) > self._settings.clock:
            what = f"the computer's clock has jumped by {format_quantity(set_s, 'time')}"
            yield "clock", f"{what}, because it was set or the computer slept"


def _atoms(n: float) -> str:
    return f"{n} atom{'s' * (n != 1)}"
