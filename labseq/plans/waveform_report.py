"""`labseq waveform`: the output of the AWG for a plan, as numbers, picture and samples."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from labseq.console.output import check_different, json_writer, report_compiling, say
from labseq.console.report import aligned
from labseq.console.text import percent, plural, size_text
from labseq.model import RfSpec
from labseq.plans.axis_statistics import AxisStatistics
from labseq.plans.plan import subject, warnings
from labseq.plans.waveform import PlannedWaveform, WaveformRequest, plan_waveform
from labseq.units import format_quantity

Both = tuple[AxisStatistics, AxisStatistics]


@dataclass(frozen=True, slots=True)
class WaveformOutput:
    """The files to write in addition to the report.

    Attributes:
        json: Name of the file for the numbers as JSON; "-" for stdout, which then holds nothing else.
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
    both = waveform.statistics()
    if output.npz is not None:
        from labseq.plans.waveform import save_samples

        save_samples(output.npz, waveform)
    if output.png is not None:
        _draw(waveform, both, output.png)
    say(*report(waveform, both))
    texts = (*warnings(waveform.moves, request.plan), *waveform.warnings)
    say(*(f"warning: {text}" for text in texts), stream=sys.stderr)
    write(waveform.as_dict() | {axis.name: axis.as_dict() for axis in both})


def _check_files(output: WaveformOutput) -> None:
    if output.png is not None:
        from labseq.pictures.plans import check_picture

        check_picture(output.png, (1, 1))
    if output.npz is not None:
        from labseq.plans.waveform import check_samples_file

        check_samples_file(output.npz)


def _draw(waveform: PlannedWaveform, both: Both, path: Path) -> None:
    from labseq.plans.waveform_picture import WaveformDrawing, save_waveform

    drawing = WaveformDrawing(
        title(waveform),
        waveform.moves.source,
        (note(both[0]), note(both[1])),
        waveform.program,
        waveform.renderer,
        waveform.segments,
        waveform.moves.motion.rf,
    )
    save_waveform(path, drawing)


def report(waveform: PlannedWaveform, both: Both) -> list[str]:
    """The numbers of the waveform, as lines of text."""
    duration, on = (format_quantity(s, "time") for s in (waveform.duration_s, waveform.tones_on_s))
    n, rate = len(waveform.samples), _rate(waveform)
    rows = [
        *subject(waveform.moves),
        ("batches", _batches(waveform)),
        ("duration", f"{duration}, {on} of it with tones on"),
        ("samples", f"{n} per channel at {rate}, {size_text(waveform.n_bytes)}"),
    ]
    return [*aligned(rows), "", *aligned(_table(both, waveform.moves.motion.rf))]


def title(waveform: PlannedWaveform) -> str:
    """The waveform on one line."""
    duration, on = (format_quantity(s, "time") for s in (waveform.duration_s, waveform.tones_on_s))
    n = len(waveform.batches)
    which = plural(n, "batch") if n == 1 else f"{n} batches"
    if n < waveform.moves.plan.n_batches:
        which = f"batch {_batches(waveform)}" if n == 1 else f"batches {_batches(waveform)}"
    dop = waveform.moves.degree_of_parallelism
    planner = f"{waveform.moves.planner}, degree of parallelism {dop}"
    return f"{planner}: {which}, {duration}, {on} of it with tones on, at {_rate(waveform)}"


def note(axis: AxisStatistics) -> str:
    """An axis on one line."""
    parts = [
        f"{axis.name} axis: at most {plural(axis.max_tones, 'tone')}",
        _span(*axis.frequency_hz),
        f"peak {format_quantity(axis.peak_v, 'voltage')}",
        f"crest factor {_crest(axis).partition(',')[0]}",
        f"mean power {format_quantity(axis.aod_mean_power_w, 'power')} at the AOD",
    ]
    return ", ".join(parts)


def _table(both: Both, rf: RfSpec) -> list[tuple[str, str, str]]:
    """The numbers of both axes, side by side."""
    row, column = (_axis_rows(axis, rf) for axis in both)
    return [(label, left, right) for (label, left), (_, right) in zip(row, column, strict=True)]


def _axis_rows(axis: AxisStatistics, rf: RfSpec) -> list[tuple[str, str]]:
    volts, watts = format_quantity(rf.max_peak_v, "voltage"), format_quantity(rf.max_mean_power_w, "power")
    paths = [f"{name} {percent(share)}" for name, share in axis.path_share.items() if share]
    return [
        ("", f"{axis.name} axis"),
        ("tones at once", f"at most {axis.max_tones}"),
        ("frequencies", _span(*axis.frequency_hz)),
        ("band of the AOD", _span(*axis.band_hz)),
        ("shifted onto a comb", f"by at most {1e9 * axis.snapped_m:.3g} nm" if axis.snapped_m else "-"),
        ("sum of amplitudes", f"at most {axis.amplitude_sum:.3g} of full scale"),
        (
            f"peak voltage (limit {volts})",
            f"{format_quantity(axis.peak_v, 'voltage')}, in batch {axis.peak_batch}",
        ),
        ("  after the amplifier", format_quantity(axis.aod_peak_v, "voltage")),
        ("crest factor", _crest(axis)),
        ("mean power into 50 Ohm", _power(axis.mean_power_w, axis.highest_power_w)),
        (f"  at the AOD (limit {watts})", _power(axis.aod_mean_power_w, axis.aod_highest_power_w)),
        ("rendered", ", ".join(paths)),
    ]


def _power(mean_w: float, highest_w: float) -> str:
    return f"{format_quantity(mean_w, 'power')}, at most {format_quantity(highest_w, 'power')}"


def _span(low_hz: float, high_hz: float) -> str:
    low, high = f"{low_hz / 1e6:.6g}", f"{high_hz / 1e6:.6g}"
    return f"{low} MHz" if low == high else f"{low} to {high} MHz"


def _crest(axis: AxisStatistics) -> str:
    if axis.crest_factor is None:
        return "-"
    return f"{axis.crest_factor:.2f}, in batch {axis.crest_batch}"


def _batches(waveform: PlannedWaveform) -> str:
    shown, n = waveform.batches, waveform.moves.plan.n_batches
    if len(shown) == n:
        return str(n)
    which = f"{shown[0]}" if len(shown) == 1 else f"{shown[0]} to {shown[-1]}"
    return f"{which} ({len(shown)} of {n})"


def _rate(waveform: PlannedWaveform) -> str:
    return format_quantity(waveform.renderer.sample_rate_hz, "frequency", digits=9)
