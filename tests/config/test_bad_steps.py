"""Wrong steps of a shot, and what is said of them: the first message, exactly."""

# ruff: noqa: E501 - messages stand here as they are printed

from __future__ import annotations

from pathlib import Path

import pytest

from labseq.builtin.probes import CheckOverlaySettings, CheckSitesSettings, ProbeSettings
from labseq.builtin.rearrange import RearrangeSettings
from labseq.builtin.steps import DeviceSettings, ImageSettings, LoadSettings, RampSettings, WaitSettings
from labseq.config.sequence import load_sequence
from labseq.errors import ConfigError, ProblemCollector
from labseq.settings import Settings

GOOD = (Path(__file__).parent / "data" / "sequence.yaml").read_text(encoding="utf-8")
MODELS: dict[str, type[Settings]] = {
    "load": LoadSettings,
    "image": ImageSettings,
    "rearrange": RearrangeSettings,
    "probe": ProbeSettings,
    "ramp": RampSettings,
    "check_sites": CheckSitesSettings,
    "check_overlay": CheckOverlaySettings,
    "wait": WaitSettings,
    "device": DeviceSettings,
}

CASES = [
    ("shot empty", "shot:\n", "shot: []\nrest:\n", "s.yaml:14:7: shot has 0 entries; expected at least 1"),
    (
        "shot as a mapping",
        "shot:\n",
        "shot: {}\nrest:\n",
        "s.yaml:14:7: shot is a mapping; expected a list ([a, b], or lines that begin with '- ')",
    ),
    (
        "step by name alone",
        "- image: {exposure: 45 ms}",
        "- image",
        "s.yaml:16:5: a step is just 'image'; expected a mapping; write '- image: {}'",
    ),
    (
        "step as a number",
        "- image: {exposure: 45 ms}",
        "- 5",
        "s.yaml:16:5: a step is 5; expected a mapping such as 'image: {exposure: 45 ms}'",
    ),
    (
        "step empty",
        "- image: {exposure: 45 ms}",
        "-",
        "s.yaml:16:4: a step is empty; expected a mapping such as 'image: {exposure: 45 ms}'",
    ),
    (
        "step of a name only",
        "- image: {exposure: 45 ms}",
        "- name: look",
        "s.yaml:16:5: a step says nothing to do; expected a mapping such as 'image: {exposure: 45 ms}'",
    ),
    (
        "two steps in one",
        "  - image: {exposure: 45 ms}",
        "    image: {exposure: 45 ms}",
        "s.yaml:16:5: 'image' stands in the same step as 'load'; expected one step in each item of the list; begin a new step with '- ', or indent settings of 'load' further",
    ),
    (
        "settings not indented",
        "- image: {exposure: 45 ms}",
        "- image:\n    exposure: 45 ms",
        "s.yaml:17:5: 'exposure' stands in the same step as 'image'; expected one step in each item of the list; begin a new step with '- ', or indent settings of 'image' further",
    ),
    (
        "settings as text",
        "- image: {exposure: 45 ms}",
        "- image: 45 ms",
        "s.yaml:16:12: image is '45 ms'; expected a mapping of settings such as {key: value}",
    ),
    (
        "no space after a step",
        "image: {exp",
        "image:{exp",
        "s.yaml:16:22: image:{exposure is '45 ms}'; expected a mapping of settings such as {key: value}; put a space after the ':'",
    ),
    (
        "step name as a number",
        "name: sort",
        "name: 2",
        "s.yaml:17:11: the name of the step is 2; expected a word of letters, digits, '_' and '-' that begins with a letter",
    ),
    (
        "step name twice",
        "- wait: {duration: 1 ms}",
        "- name: sort\n    wait: {duration: 1 ms}",
        "s.yaml:26:11: the name 'sort' is taken by step 2 (counted from 0); expected another name",
    ),
    (
        "setting misspelt",
        "cycles: 3",
        "cylces: 3",
        "s.yaml:19:7: 'cylces' is not a setting of 'rearrange'; expected one of cycles, window, exposure, stop_when, window_mode; did you mean 'cycles'?",
    ),
    ("too many cycles", "cycles: 3", "cycles: 101", "s.yaml:19:15: cycles is 101; expected at most 100"),
    (
        "cycles as a time",
        "cycles: 3",
        "cycles: 3 ms",
        "s.yaml:19:15: cycles is '3 ms'; expected a whole number",
    ),
    (
        "wrong dimension",
        "exposure: 45 ms",
        "exposure: 45 K",
        "s.yaml:16:23: exposure: '45 K' is a temperature, not a time; expected a time such as '45 ms' (s, ms, us, ns, min, h) or a plain number in s",
    ),
    (
        "unknown unit",
        "exposure: 45 ms",
        "exposure: 45 msec",
        "s.yaml:16:23: exposure: 'msec' in '45 msec' is not a unit of time; expected a time such as '45 ms' (s, ms, us, ns, min, h) or a plain number in s",
    ),
    (
        "no unit",
        "exposure: 45 ms",
        "exposure: '45'",
        "s.yaml:16:23: exposure: '45' has no unit; expected a time such as '45 ms' (s, ms, us, ns, min, h) or a plain number in s",
    ),
    (
        "decimal comma",
        "exposure: 45 ms",
        "exposure: 0,5 ms",
        "s.yaml:16:23: exposure is 0; expected more than 0",
    ),
    (
        "negative time",
        "exposure: 45 ms",
        "exposure: -45 ms",
        "s.yaml:16:23: exposure is '-45 ms'; expected at least 0",
    ),
    (
        "zero exposure",
        "exposure: 45 ms",
        "exposure: 0 ms",
        "s.yaml:16:23: exposure is '0 ms'; expected more than 0",
    ),
    (
        "infinite time",
        "exposure: 45 ms",
        "exposure: .inf",
        "s.yaml:16:23: exposure is .inf; expected a finite number",
    ),
    (
        "time that is no number",
        "exposure: 45 ms",
        "exposure: .NaN",
        "s.yaml:16:23: exposure is .NaN; expected a finite number",
    ),
    (
        "time beyond numbers",
        "exposure: 45 ms",
        "exposure: 1e999",
        "s.yaml:16:23: exposure is 1e999; expected a finite number",
    ),
    (
        "list for a time",
        "exposure: 45 ms",
        "exposure: [45 ms]",
        "s.yaml:16:23: exposure is a list; expected a time such as '45 ms' (s, ms, us, ns, min, h) or a plain number in s",
    ),
    (
        "switch for a time",
        "exposure: 45 ms",
        "exposure: true",
        "s.yaml:16:23: exposure is true; expected a time such as '45 ms' (s, ms, us, ns, min, h) or a plain number in s",
    ),
    (
        "wrong window in a list",
        "- 50 ms",
        "- 50 MHz",
        "s.yaml:22:11: window.1: '50 MHz' is a frequency, not a time; expected a time such as '45 ms' (s, ms, us, ns, min, h) or a plain number in s",
    ),
    ("negative window in a list", "- 50 ms", "- -1", "s.yaml:22:11: window.1 is -1; expected at least 0"),
    (
        "too many windows",
        "        - 50 ms\n",
        "        - 50 ms\n        - 40 ms\n",
        "s.yaml:21:9: the list has 4 entries, but cycles is 3; expected 3, one per cycle",
    ),
    (
        "too few windows",
        "        - 50 ms\n",
        "",
        "s.yaml:21:9: the list has 2 entries, but cycles is 3; expected 3, one per cycle",
    ),
    (
        "mapping for windows",
        "window:\n        - 60 ms\n        - 50 ms\n        - 0.04\n",
        "window: {a: 1}\n",
        "s.yaml:20:15: window is a mapping; expected a time such as '45 ms' (s, ms, us, ns, min, h) or a plain number in s",
    ),
    (
        "choice misspelt",
        "stop_when: 'never'",
        "stop_when: nevr",
        "s.yaml:24:18: stop_when is 'nevr'; expected 'defect_free' or 'never'; did you mean 'never'?",
    ),
    (
        "offset of a probe along one axis only",
        "- image: {exposure: 45 ms}",
        "- probe: {offset: 0.3 um}",
        "s.yaml:16:21: offset is '0.3 um'; expected a list ([a, b], or lines that begin with '- ')",
    ),
    (
        "offset of a probe in another unit",
        "- image: {exposure: 45 ms}",
        "- probe: {offset: [0.3 um, 2 MHz]}",
        "s.yaml:16:30: offset.1: '2 MHz' is a frequency, not a length; expected a length such as '4.49 um' (m, mm, um, nm) or a plain number in m",
    ),
    (
        "depth of a ramp below 0",
        "- image: {exposure: 45 ms}",
        "- ramp: {depth: -0.1}",
        "s.yaml:16:19: depth is -0.1; expected at least 0",
    ),
    (
        "depth of a ramp above 1",
        "- image: {exposure: 45 ms}",
        "- ramp: {depth: 150 %}",
        "s.yaml:16:19: depth is '150 %'; expected at most 1 (in SI units)",
    ),
    (
        "ramp without a depth",
        "- image: {exposure: 45 ms}",
        "- ramp: {duration: 5 ms}",
        "s.yaml:16:11: 'depth' is missing from 'ramp' (depth at the end, as a fraction of the nominal one)",
    ),
    (
        "ramp of another device",
        "- image: {exposure: 45 ms}",
        "- ramp: {device: mobile_tweezers, depth: 0.5}",
        "s.yaml:16:20: device is 'mobile_tweezers'; expected 'static_tweezers'",
    ),
    (
        "ramp that takes no time",
        "- image: {exposure: 45 ms}",
        "- ramp: {depth: 0.5, duration: 0 ms}",
        "s.yaml:16:34: duration is '0 ms'; expected more than 0",
    ),
    (
        "pattern of a probe misspelt",
        "- image: {exposure: 45 ms}",
        "- probe: {pattern: crss}",
        "s.yaml:16:22: pattern is 'crss'; expected 'same' or 'cross'; did you mean 'cross'?",
    ),
    (
        "limit of nothing",
        "- image: {exposure: 45 ms}",
        "- check_overlay: {limit: 0 nm}",
        "s.yaml:16:28: limit is '0 nm'; expected more than 0",
    ),
    (
        "check in no shot",
        "- image: {exposure: 45 ms}",
        "- check_overlay: {every: 0}",
        "s.yaml:16:28: every is 0; expected at least 1",
    ),
    (
        "limit with a unit that there is not",
        "- image: {exposure: 45 ms}",
        "- check_sites: {limit_px: 0.5 px}",
        "s.yaml:16:29: limit_px is '0.5 px'; expected a number",
    ),
    (
        "argument as a list",
        "delay: 2",
        "delay: [2]",
        "s.yaml:25:58: delay is a list; expected text, a whole number, a number or true or false",
    ),
    ("argument infinite", "delay: 2", "delay: .inf", "s.yaml:25:58: delay is .inf; expected a finite number"),
    (
        "required setting missing",
        "do: open, ",
        "",
        "s.yaml:25:13: 'do' is missing from 'device' (command of the device)",
    ),
    (
        "required setting missing in an empty step",
        "wait: {duration: 1 ms}",
        "wait:",
        "s.yaml:26:10: a wait needs a time or a signal; expected 'duration', or 'for' and 'timeout'",
    ),
    (
        "wait for a time and for a signal",
        "wait: {duration: 1 ms}",
        "wait: {duration: 1 ms, for: go, timeout: 1 s}",
        "s.yaml:26:12: 'duration' excludes 'for'; expected one of them",
    ),
    (
        "wait for a signal without end",
        "wait: {duration: 1 ms}",
        "wait: {for: go}",
        "s.yaml:26:12: a wait for 'go' has no 'timeout'; expected the longest wait",
    ),
    (
        "timeout of a wait for a time",
        "wait: {duration: 1 ms}",
        "wait: {duration: 1 ms, timeout: 1 s}",
        "s.yaml:26:28: 'timeout' needs 'for'; expected 'for: go' next to it",
    ),
    (
        "wait for an unknown signal",
        "wait: {duration: 1 ms}",
        "wait: {for: start, timeout: 1 s}",
        "s.yaml:26:17: for is 'start'; expected 'go'",
    ),
    (
        "wait of a wrong type",
        "wait: {duration: 1 ms}",
        "wait: {duration: [1 ms]}",
        "s.yaml:26:22: duration is a list; expected a time such as '45 ms' (s, ms, us, ns, min, h) or a plain number in s",
    ),
]


def check(path: Path) -> None:
    document, spec, _ = load_sequence(path)
    found = ProblemCollector()
    for step in spec.shot:
        with found:
            document.validate(MODELS[step.kind], step.loc)
    found.raise_any()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path("s.yaml")


def test_the_good_one_is_good(here: Path) -> None:
    here.write_text(GOOD, encoding="utf-8")
    check(here)


@pytest.mark.parametrize(("old", "new", "message"), [pytest.param(*case[1:], id=case[0]) for case in CASES])
def test_first_message(here: Path, old: str, new: str, message: str) -> None:
    assert old in GOOD
    here.write_bytes(GOOD.replace(old, new, 1).encode())

    with pytest.raises(ConfigError) as caught:
        check(here)

    assert str(caught.value.problems[0]) == message
