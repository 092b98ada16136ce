"""Whether the lines of a profile go with the rest of it: the steps, the timing box, the camera."""

from __future__ import annotations

from typing import Final

from labseq.config import ProblemCollector, Document, ProfileSpec
from labseq.config.wording import clean, did_you_mean
from labseq.errors import ConfigError, Problem, one_of
from labseq.lines import blinding_lines, trigger_line
from labseq.model.lines import IDLE
from labseq.plugins import PluginHost
from labseq.roles import ReportsLinesFacts
from labseq.sequencer.lab import Lab

_LINELESS: Final = frozenset({"device", "check_sites", "check_overlay", "equalise"})
"""Steps that take no time of their own."""


def check_kinds(document: Document, spec: ProfileSpec, host: PluginHost, found: ProblemCollector) -> None:
    """Find lines that belong to steps that nobody offers.

    Args:
        document: The profile's file.
        spec: What it says.
        host: The plugins.
        found: Where the problems go.
    """
    if spec.lines is None:
        return
    known = [IDLE, *(step for step in host.registry.names("step") if step not in _LINELESS)]
    for name, channel in spec.lines.channels.items():
        for place, kind in enumerate(channel.on):
            if kind not in known:
                loc = ("lines", "channels", name, "on", place)
                hint = did_you_mean(kind, known)
                found.add(
                    document.error(loc, f"there is no kind of step '{clean(kind)}'", one_of(known), hint)
                )


def wiring_problems(document: Document, lab: Lab) -> list[Problem]:
    """What the timing box cannot do, and what would harm or leave out the camera; with its place.

    Args:
        document: The profile's file.
        lab: Its devices; nothing is open.
    """
    problems: list[Problem] = []
    camera = lab.step_context.camera
    if isinstance(lab.lines, ReportsLinesFacts):
        channels = lab.lines.lines_facts.channels
        for spec in lab.line_specs:
            if spec.channel not in channels:
                loc = ("lines", "channels", spec.name, "channel")
                expected = f"one of {', '.join(map(str, channels))}"
                problems.append(document.problem(loc, f"the box has no channel {spec.channel}", expected))
    if camera.em_gain > 1.0:
        for name in blinding_lines(lab.line_specs, "image"):
            what = f"'{name}' is blinding and on during `image`, with an EM gain of {camera.em_gain:g}"
            loc = ("lines", "channels", name, "on")
            problems.append(document.problem(loc, what, "a line that is off in an exposure"))
    wired = trigger_line(lab.line_specs, "camera")
    if wired is not None and "external" not in camera.triggers:
        what = "the camera takes no external trigger"
        loc = ("lines", "channels", wired.name, "triggers")
        expected = f"a camera that does; this one takes {one_of(camera.triggers)}"
        problems.append(document.problem(loc, what, expected))
    return problems


def refuse_wrong_wiring(document: Document, lab: Lab) -> None:
    """The same, raised.

    Raises:
        ConfigError: Something is wrong; says what and where.
    """
    problems = wiring_problems(document, lab)
    if problems:
        raise ConfigError(problems)
