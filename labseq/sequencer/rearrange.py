"""The closed loop: image, plan, check, move, image again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from labseq.errors import PlanError
from labseq.lines import margin_s
from labseq.model import CycleRecord, Plan, PlanReport, TimelineEntry
from labseq.motion import check_plan, fitting_batches, tone_program
from labseq.roles import Shot, StepContext
from labseq.sequencer.playing import play


class _Settings(Protocol):
    @property
    def cycles(self) -> int: ...
    @property
    def exposure(self) -> float: ...
    @property
    def stop_when(self) -> str: ...
    @property
    def window_mode(self) -> str: ...
    def window_of(self, cycle: int) -> float: ...


class RearrangeStep:
    """Rearranges in cycles; cycle k is plan, check, move, image.

    A batch that would end after the cycle's window is not started. With
    ``window_mode: early`` the image follows the last batch; with ``fixed`` the
    rest of the window is waited out.
    """

    needs_image = True
    takes_image = True

    def __init__(self, settings: _Settings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """Two bars per cycle, the moves at their window."""
        exposure_s = self.settings.exposure
        image_s = exposure_s + context.camera.readout_s + margin_s(context.lines, "image")
        all_made = self.settings.stop_when == "never"
        waited_out = all_made and self.settings.window_mode == "fixed"
        bars: list[TimelineEntry] = []
        for cycle in range(1, self.settings.cycles + 1):
            window_s = self.settings.window_of(cycle)
            min_duration_s, min_image_s = window_s if waited_out else 0.0, image_s if all_made else 0.0
            moves = TimelineEntry(f"cycle {cycle}: move", window_s, min_duration_s, kind="rearrange")
            image = TimelineEntry(f"cycle {cycle}: image", image_s, min_image_s, 1, exposure_s, "image")
            bars += [moves, image]
        return bars

    def run(self, shot: Shot) -> None:
        """Run cycles until the target is met (``stop_when: defect_free``) or all are done."""
        for cycle in range(1, self.settings.cycles + 1):
            occupancy = shot.occupancy
            if occupancy is None:
                raise PlanError("rearrange needs an image before it in the shot")
            if self.settings.stop_when == "defect_free" and shot.target.is_met_by(occupancy):
                return
            self._move(shot, cycle)
            shot.take_image(self.settings.exposure, cycle)

    def _move(self, shot: Shot, cycle: int) -> None:
        window_s = self.settings.window_of(cycle)
        start_s = shot.clock.now()
        with shot.stage("move", window_s, cycle):
            plan, report = self._plan(shot, cycle)
            n_played = self._play(shot, plan, report, cycle, start_s, window_s)
            left_s = window_s - (shot.clock.now() - start_s)
            if self.settings.window_mode == "fixed" and left_s > 0:
                shot.clock.sleep(left_s)
        moves_s = float(report.batch_end_s[n_played - 1]) if n_played else 0.0
        shot.record_cycle(
            CycleRecord(shot.step, cycle, plan, report, n_played, window_s, start_s - shot.start_s, moves_s)
        )

    def _plan(self, shot: Shot, cycle: int) -> tuple[Plan, PlanReport]:
        occupancy = shot.occupancy
        assert occupancy is not None
        with shot.stage("plan", cycle=cycle):
            seen = occupancy.copy()  # a planner that writes into its input harms only itself
            try:
                plan = shot.call("planner", shot.plan_timeout_s, shot.planner.plan, seen, shot.target)
            except PlanError as error:
                raise error if error.planner else PlanError(str(error), shot.planner_name) from error
        if not isinstance(plan, Plan):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise PlanError(f"plan() returned {type(plan).__name__}; expected a Plan", shot.planner_name)
        with shot.stage("check", cycle=cycle):
            report = check_plan(
                plan,
                occupancy,
                shot.target,
                shot.degree_of_parallelism,
                grid=shot.grid,
                motion=shot.motion,
                planner=shot.planner_name,
            )
        return plan, report

    def _play(
        self, shot: Shot, plan: Plan, report: PlanReport, cycle: int, start_s: float, window_s: float
    ) -> int:
        """Play what fits into the window.

        The modelled overhead of the cycle (planning, rendering, upload) counts in
        full; only what really took longer is taken off the window beyond it.
        """
        if plan.n_batches == 0:
            return 0
        overhead_s = shot.motion.overhead_per_cycle_s
        late_s = max(0.0, shot.clock.now() - start_s - overhead_s) + shot.margin_s("rearrange")
        n_played = fitting_batches(report, plan, window_s - late_s)
        if n_played < plan.n_batches:
            shot.log("window_too_short", cycle=cycle, n_batches=plan.n_batches, n_batches_played=n_played)
        if n_played == 0:
            return 0
        play(
            shot,
            lambda: tone_program(plan, grid=shot.grid, motion=shot.motion, n_batches=n_played),
            start_s,
            cycle,
        )
        return n_played
