"""Checks that lines are wired so that devices work, and that exposures suit the camera's trigger."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final

from labseq.config.document import Document
from labseq.errors import Loc, Problem, one_of
from labseq.model import CameraFacts, LinesFacts, LineSpec, TimelineEntry
from labseq.sequencer.lab import Lab
from labseq.sequencer.lines import blinding_lines, trigger_line
from labseq.units import format_quantity

ROUNDING: Final = 1e-9


def wrong_wiring(document: Document, lab: Lab) -> Iterator[Problem]:
    """Problems of lines that the box lacks, that would damage the camera, or that cannot trigger a device.

    Args:
        document: The profile's file.
        lab: The devices, not open.
    """
    camera, specs = lab.camera.facts, lab.line_specs
    channels = () if lab.lines is None else lab.lines.lines_facts.channels
    for spec in (spec for spec in specs if channels and spec.channel not in channels):
        loc = ("lines", "channels", spec.name, "channel")
        expected = f"one of {', '.join(map(str, channels))}"
        yield document.problem(loc, f"the box has no channel {spec.channel}", expected)
    if camera.em_gain > 1.0:
        for name in blinding_lines(specs, "image"):
            what = f"'{name}' is blinding and on during `image`, with an EM gain of {camera.em_gain:g}"
            loc = ("lines", "channels", name, "on")
            yield document.problem(loc, what, "a line that is off in an exposure")
    yield from _trigger_of_camera(document, camera, trigger_line(specs, "camera"))
    wired = trigger_line(specs, "mobile_tweezers")
    if wired is not None and not lab.mobile_tweezers.waits_for_trigger:
        loc = ("lines", "channels", wired.name, "triggers")
        what = "the mobile tweezers take no external trigger"
        yield document.problem(loc, what, "mobile tweezers with a trigger input, such as `spcm`")


def _trigger_of_camera(document: Document, camera: CameraFacts, line: LineSpec | None) -> Iterator[Problem]:
    """Why a line cannot trigger the camera according to ``line_trigger``. ``line`` may be None."""
    kind = camera.line_trigger
    if line is None:
        if kind != "external":
            what = f"line_trigger is '{kind}', but no line triggers the camera"
            yield document.problem(("camera", "line_trigger"), what, "a line with `triggers: camera`")
        return
    loc = ("lines", "channels", line.name)
    if kind not in camera.triggers:
        what = f"the camera takes no {kind} trigger"
        expected = f"a camera with this trigger (this camera takes {one_of(camera.triggers)})"
        yield document.problem((*loc, "triggers"), what, expected)
    changes = {"lead": line.lead_s, "lag": line.lag_s, "pulse": line.pulse_s}
    for key in (key for key, time_s in changes.items() if time_s and kind == "bulb"):
        what = f"the camera exposes as long as '{line.name}' is on (`line_trigger: bulb`)"
        expected = f"no `{key}`, so that the line is on only during the exposure"
        yield document.problem((*loc, key), what, expected)


def unsuitable_exposures(
    camera: CameraFacts, lines: LinesFacts, bars: Sequence[tuple[Loc, TimelineEntry]]
) -> Iterator[tuple[Loc, Problem]]:
    """Exposures of a shot that a line cannot make, or that a camera cannot time by itself.

    Args:
        bars: The timeline of the shot, each with the place of its step in the sequence.

    Returns:
        The problems, each with its place in the sequence, or in the profile for ("camera", ...).
    """
    if camera.line_trigger == "bulb":
        yield from _between_edges(lines.resolution_s, bars)
    elif camera.line_trigger == "external_start":
        yield from _out_of_step(camera.cycle_s, bars)


def _between_edges(
    resolution_s: float, bars: Sequence[tuple[Loc, TimelineEntry]]
) -> Iterator[tuple[Loc, Problem]]:
    for loc, bar in bars if resolution_s else ():
        made_s = round(bar.exposure_s / resolution_s) * resolution_s
        # largest relative error of an exposure that the edges of a line make
        if abs(made_s - bar.exposure_s) > 1e-3 * bar.exposure_s:
            came, step = (format_quantity(s, "time") for s in (bar.exposure_s, resolution_s))
            what = f"the exposure is {came}, which the line cannot make (`line_trigger: bulb`)"
            yield (*loc, "exposure"), Problem(what, expected=f"a multiple of {step}")


def _out_of_step(cycle_s: float, bars: Sequence[tuple[Loc, TimelineEntry]]) -> Iterator[tuple[Loc, Problem]]:
    """Problems of images without a fixed interval, or faster than the camera."""
    cycle, longest_s = format_quantity(cycle_s, "time"), 0.0
    for i, j in pairwise(n for n, (_, bar) in enumerate(bars) if bar.n_images):
        loc, image = bars[j]
        if image.exposure_s != bars[i][1].exposure_s:
            continue  # the camera is armed again and waits for an edge
        longest_s = max(longest_s, sum(bar.duration_s for _, bar in bars[i:j]))
        varies = next((bar for _, bar in bars[i + 1 : j + 1] if bar.min_duration_s != bar.duration_s), None)
        if varies is not None:
            low, high = (format_quantity(s, "time") for s in (varies.min_duration_s, varies.duration_s))
            what = f"'{varies.label}' takes {low} to {high}, but the camera exposes every {cycle} by itself"
            hint = "give the profile's camera `line_trigger: external`"
            yield loc, Problem(what, expected="images at a fixed interval", hint=hint)
            return
    if longest_s > cycle_s * (1.0 + ROUNDING):
        interval = format_quantity(longest_s, "time")
        what = f"images follow after {interval}, but the camera exposes every {cycle} by itself"
        expected = f"more than {interval}, with time to detect the atoms"
        yield ("camera", "cycle_time"), Problem(what, expected=expected)
