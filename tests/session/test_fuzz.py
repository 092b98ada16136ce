"""Mutated files, all the way to a run that could start: it can, or the user reads why not."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

import labseq
from labseq.errors import LabseqError
from tests.config.mutations import mutated

from .whole_runs import timelines

ROOT = Path(__file__).parents[2]
SEQUENCE = (ROOT / "sequences" / "compact_225.yaml").read_bytes()
PROFILE = (ROOT / "hardware_profiles" / "virtual.yaml").read_bytes()


@pytest.mark.parametrize("which", ["sequence", "profile"])
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_mutated_file_opens_or_is_the_users_mistake(tmp_path: Path, which: str, data: st.DataObject):
    sequence, profile = SEQUENCE, PROFILE
    if which == "sequence":
        sequence = data.draw(mutated(SEQUENCE))
    else:
        profile = data.draw(mutated(PROFILE))
    (tmp_path / "virtual.yaml").write_bytes(profile)
    path = tmp_path / "sequence.yaml"
    path.write_bytes(sequence)
    try:
        session = labseq.Session.open(path)
        timelines(session)
    except LabseqError as error:
        assert error.exit_code == 2, error
        assert str(error).strip()
