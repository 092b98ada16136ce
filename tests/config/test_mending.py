"""Stand-ins for what is wrong in a file."""

from pathlib import Path
from typing import Any

from hypothesis import given, settings, strategies as st

from labseq.config import Document, SequenceSpec, load_sequence
from labseq.config.document import FallbackValues, load_checked
from labseq.config.validation import node_of
from labseq.errors import ProblemCollector

STAND_INS = FallbackValues(
    values={
        "labseq": 1,
        "name": "x",
        "shots": 1,
        "target": {"pattern": "compact"},
        "planner": {"use": "psca"},
        "shot": [{"image": {}}],
    },
    items={"shot": {"image": {}}},
)
GOOD = {**STAND_INS.values, "name": "mine", "shots": 7}
SCALARS = st.none() | st.booleans() | st.integers(-9, 9) | st.sampled_from(["", "mine", "45 ms"])
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text("abc"), inner))
KEYS = st.sampled_from([*GOOD, "seed", "attempts", "record_frames", "unknown"])


@settings(max_examples=40)
@given(st.dictionaries(KEYS, VALUES))
def test_whatever_is_wrong_the_rest_is_kept(changes: dict[str, Any]):
    base = Document.parse("labseq: 1\n", "s.yaml")
    root = node_of({**GOOD, **changes}, base.root.mark)
    found = ProblemCollector()
    document, spec = load_checked(
        Document(Path("s.yaml"), "s.yaml", "", root), SequenceSpec, "a sequence", STAND_INS, found
    )
    assert document.validate(SequenceSpec) == spec
    for key in GOOD.keys() - changes.keys():
        assert document.get((key,)) == GOOD[key]
    assert ("unknown" not in changes) or found.problems


def test_a_wrong_step_leaves_the_others_in_their_places(tmp_path: Path):
    path = tmp_path / "s.yaml"
    path.write_text(
        "labseq: 1\nname: x\nshots: 1\ntarget: {pattern: compact}\nshot: [load, {wait: {}}, 5, {load: {}}]\n"
    )
    found = ProblemCollector()
    _, spec = load_sequence(path, found=found)
    assert [step.loc for step in spec.shot] == [
        ("shot", 0, "image"),
        ("shot", 1, "wait"),
        ("shot", 2, "image"),
        ("shot", 3, "load"),
    ]
    assert [problem.line for problem in found.problems] == [5, 5]
