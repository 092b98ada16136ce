"""Wrong sequences, and what is said of them: the first message, exactly."""

# ruff: noqa: E501 - messages stand here as they are printed

from __future__ import annotations

from pathlib import Path

import pytest

from labseq.config import load_sequence
from labseq.errors import ConfigError

GOOD = (Path(__file__).parent / "data" / "sequence.yaml").read_text(encoding="utf-8")
CASES = [
    (
        "misspelt key",
        "shots: 20",
        "shoots: 20",
        "s.yaml:5:1: 'shoots' is not a setting of a sequence; expected one of labseq, name, profile, shots, seed, target, planner, record_frames, attempts, policy, plugin_folders, scan, repeats, order, variables, analysis, shot; did you mean 'shots'?",
    ),
    ("zero shots", "shots: 20", "shots: 0", "s.yaml:5:8: shots is 0; expected at least 1"),
    (
        "too many shots",
        "shots: 20",
        "shots: 1000001",
        "s.yaml:5:8: shots is 1000001; expected at most 1000000",
    ),
    (
        "shots in words",
        "shots: 20",
        "shots: twenty",
        "s.yaml:5:8: shots is 'twenty'; expected a whole number",
    ),
    (
        "shots in quotes",
        "shots: 20",
        'shots: "20"',
        "s.yaml:5:8: shots is '20'; expected a whole number; write 20 without quotes",
    ),
    (
        "shots with underscore",
        "shots: 20",
        "shots: 1_000",
        "s.yaml:5:8: shots is '1_000'; expected a whole number; did you mean 1000?",
    ),
    ("shots as a float", "shots: 20", "shots: 2e1", "s.yaml:5:8: shots is 2e1; expected a whole number"),
    ("shots as a switch", "shots: 20", "shots: true", "s.yaml:5:8: shots is true; expected a whole number"),
    ("shots empty", "shots: 20", "shots:", "s.yaml:5:7: shots is empty; expected a whole number"),
    ("shots missing", "shots: 20\n", "", "s.yaml:2:1: 'shots' is missing (how many shots a run takes)"),
    ("negative seed", "seed: 7", "seed: -1", "s.yaml:6:7: seed is -1; expected at least 0"),
    (
        "huge seed",
        "seed: 7",
        "seed: 9223372036854775808",
        "s.yaml:6:7: seed is 9223372036854775808; expected less than 9223372036854775808",
    ),
    (
        "number too long",
        "seed: 7",
        "seed: 11111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111",
        "s.yaml:6:7: a number of 101 characters is too long; expected a number of a few digits",
    ),
    (
        "newer format",
        "labseq: 1",
        "labseq: 2",
        "s.yaml:2:9: this file is written for a newer labseq: its format is 2, this labseq reads 1; update labseq",
    ),
    (
        "format as text",
        "labseq: 1",
        "labseq: '1'",
        "s.yaml:2:9: labseq is '1'; expected 1, the version of the file format",
    ),
    ("format missing", "labseq: 1\n", "", "s.yaml:2:1: 'labseq' is missing (version of the file format: 1)"),
    (
        "name as a number",
        "name: compact-225",
        "name: 225",
        "s.yaml:3:7: name is 225; expected text; put it in quotes",
    ),
    (
        "name with a separator",
        "name: compact-225",
        "name: a/b",
        "s.yaml:3:7: name is 'a/b', with '/' in it; expected letters, digits, spaces, '-', '_' and '.'",
    ),
    (
        "name with a control character",
        "name: compact-225",
        'name: "a\\tb"',
        "s.yaml:3:7: name is 'a\\tb', with '\\t' in it; expected letters, digits, spaces, '-', '_' and '.'",
    ),
    (
        "name of dots",
        "name: compact-225",
        "name: ..",
        "s.yaml:3:7: name is '..'; expected at least one letter or digit",
    ),
    (
        "name too long",
        "name: compact-225",
        "name: xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx",
        "s.yaml:3:7: name has 81 characters; expected at most 80",
    ),
    ("name empty", "name: compact-225", "name: ''", "s.yaml:3:7: name has 0 characters; expected at least 1"),
    (
        "record_frames",
        "record_frames: last",
        "record_frames: lst",
        "s.yaml:11:16: record_frames is 'lst'; expected 'all', 'last' or 'none'; did you mean 'last'?",
    ),
    ("attempts", "attempts: 2", "attempts: 0", "s.yaml:12:11: attempts is 0; expected at least 1"),
    (
        "plugin folders as text",
        '[plugins, "more plugins"]',
        "plugins",
        "s.yaml:13:17: plugin_folders is 'plugins'; expected a list ([a, b], or lines that begin with '- ')",
    ),
    (
        "plugin folder as a number",
        '[plugins, "more plugins"]',
        "[plugins, 5]",
        "s.yaml:13:27: plugin_folders.1 is 5; expected text; put it in quotes",
    ),
    (
        "target by name alone",
        "target: {pattern: compact, rows: 15, cols: 15}",
        "target: compact",
        "s.yaml:7:9: just 'compact' stands here; expected a mapping; write '{pattern: compact}'",
    ),
    (
        "target without a pattern",
        "{pattern: compact",
        "{patern: compact",
        "s.yaml:7:9: 'pattern' is missing from 'target' (the name of a target pattern); did you write 'patern' for it?",
    ),
    (
        "pattern as a number",
        "{pattern: compact",
        "{pattern: 5",
        "s.yaml:7:19: pattern is 5; expected text; put it in quotes",
    ),
    (
        "planner without use",
        "use: psca\n",
        "uses: psca\n",
        "s.yaml:9:3: 'use' is missing from 'planner' (the name of a plugin); did you write 'uses' for it?",
    ),
]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path("s.yaml")


def test_the_good_one_is_good(here: Path) -> None:
    here.write_text(GOOD, encoding="utf-8")
    load_sequence(here)


@pytest.mark.parametrize(("old", "new", "message"), [pytest.param(*case[1:], id=case[0]) for case in CASES])
def test_first_message(here: Path, old: str, new: str, message: str) -> None:
    assert old in GOOD
    here.write_bytes(GOOD.replace(old, new, 1).encode())

    with pytest.raises(ConfigError) as caught:
        load_sequence(here)

    assert str(caught.value.problems[0]) == message
