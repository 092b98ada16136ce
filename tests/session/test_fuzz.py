"""Mutated files, all the way to a run that could start: it can, or the user is told why not."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

import labseq
from labseq.errors import LabseqError

ROOT = Path(__file__).parents[2]
SEQUENCE = (ROOT / "sequences" / "compact_225.yaml").read_text(encoding="utf-8")
PROFILE = (ROOT / "hardware_profiles" / "virtual.yaml").read_text(encoding="utf-8")

SCRAPS = [
    *(" ", "\t", "\n", ": ", "- ", "{", "}", "[", "]", ",", "#", "'", '"', "&a", "*a", "!x ", "|", ">"),
    *(
        "",
        "null",
        "true",
        "off",
        "-1",
        "0",
        "1e400",
        ".nan",
        ".inf",
        "0x1F",
        "10:30",
        "45",
        "45 ms",
        "45 MHz",
    ),
    *("75 %", "use: virtual", "pattern: bitmap", "\x00", "\ufeff", "é", "psca", "name: name", "<<: {}"),
    "labseq: 2",
]


@st.composite
def mutated(draw: st.DrawFn, text: str) -> str:
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(text)))
        length = draw(st.sampled_from([0, 0, 1, 2, 5, 20]))
        text = text[:start] + draw(st.sampled_from(SCRAPS)) + text[start + length :]
    return text


@pytest.mark.parametrize("which", ["sequence", "profile"])
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_mutated_file_opens_or_is_the_users_mistake(tmp_path: Path, which: str, data: st.DataObject):
    sequence, profile = SEQUENCE, PROFILE
    if which == "sequence":
        sequence = data.draw(mutated(SEQUENCE))
    else:
        profile = data.draw(mutated(PROFILE))
    (tmp_path / "virtual.yaml").write_text(profile, encoding="utf-8")
    path = tmp_path / "sequence.yaml"
    path.write_text(sequence, encoding="utf-8")
    try:
        session = labseq.Session.open(path)
        session.timeline()
    except LabseqError as error:
        assert error.exit_code == 2, error
        assert str(error).strip()
