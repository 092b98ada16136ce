"""Takes the shots of a run, each at its point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from labseq.assembly.lab import rebuild_lab
from labseq.assembly.points import Point
from labseq.recording import RunWriter
from labseq.sequencer.lab import Lab
from labseq.sequencer.run import Sequencer
from labseq.session.checks import Checks
from labseq.session.prepared import PreparedRun
from labseq.session.stopping import check_stop_file
from labseq.watchdog import Watchdog


class Shots:
    """Takes the shots of a run, each at its point; how the points come about is no concern of it.

    Args:
        run: The run.
        lab: The devices, not open, at the first point.
        first: That point.
        writer: Records the shots.
        watchdog: Switches the outputs off if this process dies or hangs.

    Attributes:
        sequencer: Takes each shot; the caller opens it and shuts it down.
    """

    def __init__(
        self, run: PreparedRun, lab: Lab, first: Point, writer: RunWriter, watchdog: Watchdog
    ) -> None:
        self._run = run
        self._point = first
        self._writer = writer
        self.sequencer = Sequencer(
            lab,
            first.steps,
            run.stop_flag,
            writer,
            run.observers,
            seed=run.seed,
            policy=run.assembly.policy,
            parameters=self._parameters(first),
            watchdog=watchdog,
        )

    def take_all(self, checks: Checks) -> None:
        """Take the shots until none is left, or the points end.

        Args:
            checks: Checks each shot; may end the run, or skip the other shots of a point.

        Raises:
            StopRequested: The run was asked to end.
            CheckFailedError: A value is outside the limits of a check that stops the run.
            LabseqError: Another error that ended the run before its last shot.
        """
        points, history = self._run.points, self._run.history
        last, why = checks.left_open
        if why:  # an earlier process may have died before it could record what it skips
            self._skip(history.later_at_its_point(last), why)
        while (point := points.next(history)) is not None:
            check_stop_file(self._writer.run_dir)
            shot = history.to_take[0]
            self._move_to(point)
            failure = self.sequencer.take(shot)
            self._run.analyses.look()
            history.add(self._writer.run_dir, self._writer.last_row)
            if why := failure or checks.after(self._writer.last_row):
                self._skip([*([shot] if failure else []), *history.later_at_its_point(shot)], why)

    def _move_to(self, point: Point) -> None:
        """Change what differs between the present point and the next."""
        if point is self._point:
            return
        lab, reopened = rebuild_lab(self.sequencer.lab, self._point, point, self._run.seed)
        self.sequencer.change(lab, point.steps, self._parameters(point), reopened)
        self._point = point

    def _parameters(self, point: Point) -> dict[str, Any]:
        """The settings at a point that differ from the files: address -> value."""
        changes = {address: change["value"] for address, change in self._writer.run.overrides.items()}
        return {**changes, **point.parameters}

    def _skip(self, shots: Sequence[int], why: str) -> None:
        if not shots:
            return
        self._writer.skip(shots, why)
        self._run.history.skip(shots)
        which = f"shot {shots[0]} is" if len(shots) == 1 else f"{len(shots)} shots are"
        self._run.warn(f"{which} skipped: {why}")
        self._run.observers.event("shots_skipped", {"shots": [*shots], "why": why})
