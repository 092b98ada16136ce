"""What a waveform is made from, read from the words of the command line."""

from __future__ import annotations

import io
import re
import sys
from codecs import BOM_UTF8
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

from labseq.config import load_profile, plugin_paths, split_overrides
from labseq.config.plan_file import MAX_BYTES
from labseq.config.reading import read_bytes
from labseq.config.wording import clean, visible
from labseq.errors import ConfigError, Problem
from labseq.model import Plan
from labseq.session.choosing import choose
from labseq.session.occupancies import read_source
from labseq.session.plan_files import read_plan
from labseq.session.plan_inputs import PlanRequest
from labseq.session.planning import PlannedMoves, plan_moves
from labseq.session.setting_up import load_plugins
from labseq.units import format_quantity, parse_quantity

DEFAULT_RATE_HZ: Final = 625e6
"""Where nobody names a sample rate: that of the paper's AWG."""

MAX_RATE_HZ: Final = 10e9
"""Far more than any AWG has."""

PLAN_SUFFIX: Final = ".json"

_OF_SHOT: Final = "the profile in the shot's file"
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_BATCHES: Final = re.compile(r"\s*(\d{1,6})\s*(?:-\s*(\d{1,6})\s*)?")


@dataclass(frozen=True, slots=True)
class SampleRate:
    """A sample rate and who asks for it.

    Attributes:
        hz: Samples per second and channel.
        source: Who, for messages; "" for nobody.
        warning: What the user should know, or "".
    """

    hz: float
    source: str = ""
    warning: str = ""


def read_moves(
    request: PlanRequest, stdin: BinaryIO | None, announce: Callable[[str], None]
) -> tuple[PlannedMoves, dict[str, Any]]:
    """Read a plan, or an occupancy that is then planned for.

    Args:
        request: Its occupancy may be a plan: a file that ends in .json, or JSON on "-".
        stdin: What "-" reads; standard input if None.
        announce: Called with the name of a module before its kernels are compiled.

    Returns:
        The checked plan, and the profile that a shot was taken with; empty where there is none.

    Raises:
        ConfigError: Something in the request is wrong.
        PluginLoadError: A plugin that is named failed to load.
        PlanError: The planner failed, or its plan breaks a rule.
    """
    if request.occupancy == "-":
        data = (stdin or sys.stdin.buffer).read(MAX_BYTES + 1)
        if data.removeprefix(BOM_UTF8).lstrip()[:1] == b"{":
            return read_plan(data, "standard input", request, announce=announce), {}
        source = read_source("-", request.seed, io.BytesIO(data))
    elif request.occupancy.lower().endswith(PLAN_SUFFIX):
        path = Path(request.occupancy)
        data = read_bytes(path, "a plan", (PLAN_SUFFIX,), MAX_BYTES)
        return read_plan(data, visible(str(path)), request, announce=announce), {}
    else:
        source = read_source(request.occupancy, request.seed)
    return plan_moves(request, source, announce=announce), source.machine or {}


def read_sample_rate(text: str | None, request: PlanRequest, machine: dict[str, Any]) -> SampleRate:
    """Find the sample rate: the one given, else the profile's, else the paper's.

    A profile has one if the plugin of its mobile tweezers has a setting ``sample_rate``.

    Args:
        text: The one given, such as "625 MHz"; None if there is none.
        request: Names the profile, if there is one.
        machine: The profile that a shot was taken with; may be empty.

    Raises:
        ConfigError: It is no frequency, not above 0, or more than any AWG has; or the profile is wrong.
    """
    if text is not None:
        return _parse(text)
    if request.profile is not None:
        return _of_profile(request.profile, request.overrides)
    rate_hz = machine.get("mobile_tweezers", {}).get("sample_rate")
    return SampleRate(rate_hz, _OF_SHOT) if isinstance(rate_hz, int | float) else SampleRate(DEFAULT_RATE_HZ)


def _parse(text: str) -> SampleRate:
    option = clean(f"--sample-rate {text}")
    try:
        rate_hz = float(text) if _NUMBER.fullmatch(text) else parse_quantity(text, "frequency")
    except ValueError as error:
        raise ConfigError(Problem(visible(str(error)), option)) from error
    if not 0 < rate_hz <= MAX_RATE_HZ:
        most = format_quantity(MAX_RATE_HZ, "frequency")
        raise ConfigError(
            Problem("this is no sample rate", option, expected=f"more than 0 Hz, at most {most}")
        )
    return SampleRate(rate_hz, option)


def _of_profile(profile: str, overrides: Sequence[str]) -> SampleRate:
    """The setting ``sample_rate`` of whatever drives the mobile tweezers, if it has one."""
    _, for_profile = split_overrides(overrides)
    document, spec = load_profile(profile, beside=Path(), overrides=for_profile)
    host = load_plugins(plugin_paths(document, spec.plugin_folders), max_wait_s=spec.timeouts.load)
    chosen, warning = choose(host, document, "mobile_tweezers", spec.mobile_tweezers, "full")
    rate_hz = getattr(chosen.settings, "sample_rate", None)
    warning = f"mobile_tweezers: {warning}" if warning else ""
    if isinstance(rate_hz, int | float):
        return SampleRate(rate_hz, visible(str(document.path)), warning)
    return SampleRate(DEFAULT_RATE_HZ, warning=warning)


def read_batches(text: str | None, plan: Plan) -> range:
    """Read which batches are meant; a chain of linked ones is never cut.

    Args:
        text: "2" or "1-3", counted from 1; None for all.
        plan: The plan.

    Returns:
        Their indices, from 0.

    Raises:
        ConfigError: It is no such thing, there are no such batches, or it cuts a chain.

    Example:
        >>> read_batches("1-2", Plan.from_batches([([(0, 0)], [(0, 3)])] * 3))
        range(0, 2)
    """
    n = plan.n_batches
    if text is None:
        return range(n)
    option = clean(f"--batches {text}")
    there_are = f"a number from 1 to {n}, or two of them as in 1-{n}" if n > 1 else "1, the only one"
    match = _BATCHES.fullmatch(text)
    if match is None:
        raise ConfigError(Problem("these are no batches", option, expected=there_are))
    first, last = int(match[1]), int(match[2] or match[1])
    if not 1 <= first <= last <= n:
        raise ConfigError(Problem("there are no such batches", option, expected=there_are))
    begins, ends = first, last
    while plan.linked[begins - 1]:
        begins -= 1
    while ends < n and plan.linked[ends]:
        ends += 1
    if (begins, ends) != (first, last):
        what = "linked batches are cut, between which the tweezers stay on"
        raise ConfigError(Problem(what, option, expected=f"--batches {begins}-{ends}"))
    return range(first - 1, last)
