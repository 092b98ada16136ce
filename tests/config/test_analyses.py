"""The key ``analysis`` of a sequence."""

from __future__ import annotations

import pytest

import labseq
from labseq.config import load_sequence

HEAD = """labseq: 1
name: x
shots: 1
target: {pattern: compact, rows: 5, cols: 5}
shot: [{image: {}}]
"""


def read(tmp_path, text):
    path = tmp_path / "x.yaml"
    path.write_text(HEAD + text)
    return load_sequence(path)[1]


def test_analyses_may_be_left_out_or_empty(tmp_path):
    assert read(tmp_path, "").analysis == ()
    assert read(tmp_path, "analysis:\n").analysis == ()


def test_each_has_its_place_and_its_time(tmp_path):
    one, two = read(tmp_path, "analysis: [{use: a, gain: 3}, {use: b, finish_within: 1 min}]").analysis
    assert (one.use, one.finish_within, one.loc) == ("a", 10.0, ("analysis", 0))
    assert (two.use, two.finish_within, two.loc) == ("b", 60.0, ("analysis", 1))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("analysis: survival", r":6:11: analysis is 'survival'; expected a list"),
        ("analysis: [survival]", r":6:12: just 'survival' stands here; expected a mapping"),
        ("analysis: [{atoms: all}]", r":6:12: 'use' is missing"),
        (
            "analysis: [{use: a}, {use: a}]",
            r":6:28: the analysis 'a' stands here a second time; expected each analysis once",
        ),
        ("analysis: [{use: a, finish_within: soon}]", r":6:36: .*expected"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(tmp_path, text, expected):
    with pytest.raises(labseq.ConfigError, match=expected):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("analysis: [{use: sruvival}]", r":6:18: unknown analysis 'sruvival'.*did you mean 'survival'"),
        ("analysis: [{use: survival, atom: all}]", r":6:28: .*'atom'.*did you mean 'atoms'"),
        ("analysis: [{use: survival, atoms: some}]", r":6:35: atoms is 'some'"),
    ],
)
def test_settings_of_analyses_are_checked_before_the_run(tmp_path, text, expected):
    path = tmp_path / "x.yaml"
    path.write_text(HEAD + text)
    with pytest.raises(labseq.ConfigError, match=expected):
        labseq.Session.open(path)
