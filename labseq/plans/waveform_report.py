"""`labseq waveform` gives the output of the AWG for a plan as numbers, picture and samples."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from labseq.console.output import check_different, json_writer, report_compiling, say
from labseq.console.report import aligned
from labseq.console.text import percent, plural
from labseq.plans.axis_statistics import AxisStatistics
from labseq.plans.plan import subject, warnings
from labseq.plans.waveform import PlannedWaveform, WaveformRequest, plan_waveform
from labseq.units import format_quantity, size_text


@dataclass(frozen=True, slots=True)
class WaveformOutput:
    """The files to write in addition to the report.

    Attributes:
        json: Name of the file for the numbers as JSON, or "-" for stdout, which then holds nothing else.
        png: The file for the picture.
        npz: The file for the samples.
    """

    json: str | None = None
    png: Path | None = None
    npz: Path | None = None


def show_waveform(request: WaveformRequest, output: WaveformOutput) -> None:
    """Render the waveform of a plan, print its numbers, and write the output files."""
    check_different(request.plan.occupancy, output.json, output.png, output.npz)
    write = json_writer(output.json)
    _check_files(output)
    waveform = plan_waveform(request, announce=report_compiling)
    report = WaveformReport.of(waveform)
    if output.npz is not None:
        from labseq.plans.waveform import save_samples

        save_samples(output.npz, waveform)
    if output.png is not None:
        _draw(waveform, report, output.png)
    say(*report.as_text())
    texts = (*warnings(waveform.moves, request.plan), *waveform.warnings)
    say(*(f"warning: {text}" for text in texts), stream=sys.stderr)
    write(report)


def _check_files(output: WaveformOutput) -> None:
    if output.png is not None:
        from labseq.pictures.plans import check_picture

        check_picture(output.png, (1, 1))
    if output.npz is not None:
        from labseq.plans.waveform import check_samples_file

        check_samples_file(output.npz)


def _draw(waveform: PlannedWaveform, report: WaveformReport, path: Path) -> None:
    from labseq.plans.waveform_picture import WaveformDrawing, save_waveform

    drawing = WaveformDrawing(
        title(report),
        waveform.moves.source,
        (note(report.row), note(report.column)),
        waveform.program,
        waveform.renderer,
        waveform.segments,
        waveform.moves.motion.rf,
    )
    save_waveform(path, drawing)


@dataclass(frozen=True, slots=True, kw_only=True)
class WaveformReport:
    """The output for a plan, in SI units.

    Attributes:
        source: Origin of the plan or of its occupancy.
        subject: Occupancy, target and planner, in words.
        planner: Name of the planner.
        degree_of_parallelism: Maximum number of tweezers on at once in the check of the plan.
        seed: Seed of all random numbers, or None.
        first_batch: Index of the first batch that is played, from 0.
        n_batches: Number of batches that are played.
        n_batches_of_plan: Number of all batches.
        duration_s: Playing time, pauses included.
        tones_on_s: Playing time without the pauses between batches.
        sample_rate_hz: Samples per second.
        n_samples: Samples per channel.
        n_bytes: Size of the samples of both channels.
        max_peak_v: Limit of the peak voltage of a channel.
        max_mean_power_w: Limit of the mean power at an AOD.
        row: Output of the row axis.
        column: Output of the column axis.
    """

    source: str
    subject: Mapping[str, str]
    planner: str
    degree_of_parallelism: int
    seed: int | None
    first_batch: int
    n_batches: int
    n_batches_of_plan: int
    duration_s: float
    tones_on_s: float
    sample_rate_hz: float
    n_samples: int
    n_bytes: int
    max_peak_v: float
    max_mean_power_w: float
    row: AxisStatistics
    column: AxisStatistics

    @classmethod
    def of(cls, waveform: PlannedWaveform) -> WaveformReport:
        """The numbers of a waveform, all of which is rendered for them."""
        moves, rf = waveform.moves, waveform.moves.motion.rf
        row, column = waveform.statistics()
        return cls(
            source=moves.source,
            subject=dict(subject(moves)),
            planner=moves.planner,
            degree_of_parallelism=moves.degree_of_parallelism,
            seed=moves.seed,
            first_batch=waveform.batches.start,
            n_batches=len(waveform.batches),
            n_batches_of_plan=moves.plan.n_batches,
            duration_s=waveform.duration_s,
            tones_on_s=waveform.tones_on_s,
            sample_rate_hz=waveform.renderer.sample_rate_hz,
            n_samples=len(waveform.samples),
            n_bytes=waveform.n_bytes,
            max_peak_v=rf.max_peak_v,
            max_mean_power_w=rf.max_mean_power_w,
            row=row,
            column=column,
        )

    @property
    def rate_text(self) -> str:
        """The sample rate with its unit."""
        return format_quantity(self.sample_rate_hz, "frequency", digits=9)

    @property
    def duration_text(self) -> str:
        """The playing time, with and without pauses."""
        duration, on = (format_quantity(s, "time") for s in (self.duration_s, self.tones_on_s))
        return f"{duration}, {on} of it with tones on"

    @property
    def batches_text(self) -> str:
        """Which batches are played."""
        if self.n_batches == self.n_batches_of_plan:
            return str(self.n_batches)
        last = self.first_batch + self.n_batches - 1
        which = str(last) if self.n_batches == 1 else f"{self.first_batch} to {last}"
        return f"{which} ({self.n_batches} of {self.n_batches_of_plan})"

    def as_text(self) -> list[str]:
        """The subject and the totals, above a table with a column for each axis."""
        samples = f"{self.n_samples} per channel at {self.rate_text}, {size_text(self.n_bytes)}"
        facts = [
            *self.subject.items(),
            ("batches", self.batches_text),
            ("duration", self.duration_text),
            ("samples", samples),
        ]
        axes = (self.row, self.column)
        numbers = [[name, *map(text, axes)] for name, text in self._numbers()]
        return [*aligned(facts), "", *aligned([["", *(f"{axis.name} axis" for axis in axes)], *numbers])]

    def _numbers(self) -> Sequence[tuple[str, Callable[[AxisStatistics], str]]]:
        """Name of each number of an axis, and its format."""
        volts, watts = _volts(self.max_peak_v), _watts(self.max_mean_power_w)
        return (
            ("tones at once", lambda axis: f"at most {axis.max_tones}"),
            ("frequencies", lambda axis: _span(*axis.frequency_hz)),
            ("band of the AOD", lambda axis: _span(*axis.band_hz)),
            ("shifted onto a comb", _shift),
            ("sum of amplitudes", lambda axis: f"at most {axis.amplitude_sum:.3g} of full scale"),
            (
                f"peak voltage (limit {volts})",
                lambda axis: f"{_volts(axis.peak_v)}, in batch {axis.peak_batch}",
            ),
            ("  after the amplifier", lambda axis: _volts(axis.aod_peak_v)),
            ("crest factor", _crest),
            ("mean power into 50 Ohm", lambda axis: _power(axis.mean_power_w, axis.highest_power_w)),
            (
                f"  at the AOD (limit {watts})",
                lambda axis: _power(axis.aod_mean_power_w, axis.aod_highest_power_w),
            ),
            ("rendered", _paths),
        )


def title(report: WaveformReport) -> str:
    """The waveform on one line."""
    n = report.n_batches
    which = plural(n, "batch") if n == 1 else f"{n} batches"
    if n < report.n_batches_of_plan:
        which = f"{'batch' if n == 1 else 'batches'} {report.batches_text}"
    planner = f"{report.planner}, degree of parallelism {report.degree_of_parallelism}"
    return f"{planner}: {which}, {report.duration_text}, at {report.rate_text}"


def note(axis: AxisStatistics) -> str:
    """An axis on one line."""
    parts = [
        f"{axis.name} axis: at most {plural(axis.max_tones, 'tone')}",
        _span(*axis.frequency_hz),
        f"peak {_volts(axis.peak_v)}",
        f"crest factor {_crest(axis).partition(',')[0]}",
        f"mean power {_watts(axis.aod_mean_power_w)} at the AOD",
    ]
    return ", ".join(parts)


def _volts(value: float) -> str:
    return format_quantity(value, "voltage")


def _watts(value: float) -> str:
    return format_quantity(value, "power")


def _power(mean_w: float, highest_w: float) -> str:
    return f"{_watts(mean_w)}, at most {_watts(highest_w)}"


def _span(low_hz: float, high_hz: float) -> str:
    low, high = f"{low_hz / 1e6:.6g}", f"{high_hz / 1e6:.6g}"
    return f"{low} MHz" if low == high else f"{low} to {high} MHz"


def _shift(axis: AxisStatistics) -> str:
    return f"by at most {1e9 * axis.snapped_m:.3g} nm" if axis.snapped_m else "-"


def _crest(axis: AxisStatistics) -> str:
    return "-" if axis.crest_factor is None else f"{axis.crest_factor:.2f}, in batch {axis.crest_batch}"


def _paths(axis: AxisStatistics) -> str:
    return ", ".join(f"{name} {percent(share)}" for name, share in axis.path_share.items() if share)
