"""Cycles and stage timings as tables of numbers, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from labseq.model import CycleRecord, Plan, PlanReport, StageTiming
from labseq.recording import layout
from labseq.recording.plain import plain_text


def moves_table(cycles: Sequence[CycleRecord]) -> NDArray[Any]:
    """One row per atom move, over all cycles (:data:`layout.MOVES`)."""
    tables = [_moves_of(cycle) for cycle in cycles]
    return np.concatenate(tables) if tables else np.empty(0, layout.MOVES)


def batches_table(cycles: Sequence[CycleRecord]) -> NDArray[Any]:
    """One row per batch, over all cycles (:data:`layout.BATCHES`)."""
    tables = [_batches_of(cycle) for cycle in cycles]
    return np.concatenate(tables) if tables else np.empty(0, layout.BATCHES)


def cycles_table(cycles: Sequence[CycleRecord]) -> NDArray[Any]:
    """One row per cycle (:data:`layout.CYCLES`)."""
    rows = [
        (
            c.step,
            c.cycle,
            c.plan.n_batches,
            c.n_batches_played,
            c.plan.n_atom_moves,
            c.report.n_defects,
            c.report.n_surplus,
            c.t_start_s,
            c.window_s,
            c.report.duration_s,
            c.moves_s,
        )
        for c in cycles
    ]
    return np.array(rows, layout.CYCLES)


def _moves_of(cycle: CycleRecord) -> NDArray[Any]:
    plan = cycle.plan
    table = np.empty(plan.n_atom_moves, layout.MOVES)
    batch = np.repeat(np.arange(plan.n_batches, dtype=np.int32), np.diff(plan.batch_offsets))
    table["step"], table["cycle"], table["batch"] = cycle.step, cycle.cycle, batch
    for column, name in enumerate(layout.MOVE_SITES):
        table[name] = plan.moves[:, column]
    table["linked"] = plan.linked[batch]
    table["played"] = batch < cycle.n_batches_played
    return table


def _batches_of(cycle: CycleRecord) -> NDArray[Any]:
    plan = cycle.plan
    table = np.empty(plan.n_batches, layout.BATCHES)
    table["step"], table["cycle"], table["batch"] = cycle.step, cycle.cycle, np.arange(plan.n_batches)
    table["n_atom_moves"] = np.diff(plan.batch_offsets)
    table["n_tweezers"] = cycle.report.n_tweezers
    table["end_s"] = cycle.report.batch_end_s
    table["linked"] = plan.linked
    table["played"] = table["batch"] < cycle.n_batches_played
    return table


def cycles_of(
    cycles: NDArray[Any], batches: NDArray[Any], moves: NDArray[Any], predicted: NDArray[Any]
) -> list[CycleRecord]:
    """Take the tables apart again; ``predicted`` is (n_cycles, n_rows, n_cols)."""
    batch_ends = np.cumsum(cycles["n_batches"])
    move_ends = np.cumsum(cycles["n_atom_moves"])
    return [
        _cycle_of(
            row,
            batches[batch_end - row["n_batches"] : batch_end],
            moves[move_end - row["n_atom_moves"] : move_end],
            occupancy,
        )
        for row, batch_end, move_end, occupancy in zip(cycles, batch_ends, move_ends, predicted, strict=True)
    ]


def _cycle_of(row: Any, batches: NDArray[Any], moves: NDArray[Any], predicted: NDArray[Any]) -> CycleRecord:
    sites = np.stack([moves[name] for name in layout.MOVE_SITES], axis=1)
    offsets = np.concatenate([[0], np.cumsum(batches["n_atom_moves"])])
    report = PlanReport(
        predicted=predicted.astype(np.bool_),
        batch_end_s=batches["end_s"].copy(),
        n_tweezers=batches["n_tweezers"].copy(),
        n_defects=int(row["n_defects_predicted"]),
        n_surplus=int(row["n_surplus_predicted"]),
    )
    return CycleRecord(
        step=int(row["step"]),
        cycle=int(row["cycle"]),
        plan=Plan(sites, offsets, batches["linked"]),
        report=report,
        n_batches_played=int(row["n_batches_played"]),
        window_s=float(row["window_s"]),
        t_start_s=float(row["t_start_s"]),
        moves_s=float(row["moves_s"]),
    )


def timing_table(timing: Sequence[StageTiming]) -> NDArray[Any]:
    """One row per stage (:func:`layout.timing_dtype`)."""
    stages = [plain_text(t.stage).encode() for t in timing]
    width = max(map(len, stages), default=0) or 1
    rows = [
        (stage, t.step, t.cycle, t.t_start_s, t.duration_s, t.host_s, t.budget_s, t.over_budget)
        for stage, t in zip(stages, timing, strict=True)
    ]
    return np.array(rows, layout.timing_dtype(h5py.string_dtype("utf-8", width)))


def timing_of(table: NDArray[Any]) -> list[StageTiming]:
    """Take the table of stages apart again."""
    return [
        StageTiming(
            stage=row["stage"].decode(),
            step=int(row["step"]),
            cycle=int(row["cycle"]),
            t_start_s=float(row["t_start_s"]),
            duration_s=float(row["duration_s"]),
            host_s=float(row["host_s"]),
            budget_s=float(row["budget_s"]),
        )
        for row in table
    ]
