"""Any file gives a spec, or a ConfigError that can be printed. Nothing else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from labseq.builtin.rearrange import RearrangeSettings
from labseq.builtin.steps import DeviceSettings, ImageSettings, LoadSettings, WaitSettings
from labseq.config.addresses import Override, split_overrides
from labseq.config.profile import load_profile
from labseq.config.sequence import load_sequence
from labseq.errors import ConfigError, ProblemCollector
from labseq.settings import NoSettings, Settings
from tests.config.mutations import PIECES, mutated

DATA = Path(__file__).parent / "data"
SEQUENCE = (DATA / "sequence.yaml").read_text(encoding="utf-8").encode()
PROFILE = (DATA / "profile.yaml").read_text(encoding="utf-8").encode()
MODELS: dict[str, type[Settings]] = {
    "load": LoadSettings,
    "image": ImageSettings,
    "rearrange": RearrangeSettings,
    "wait": WaitSettings,
    "device": DeviceSettings,
}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz") / "f.yaml"


def load_or_report(load: Callable[[], None], n_lines: int) -> None:
    """Load; messages must be readable, and their places in the file."""
    try:
        load()
    except ConfigError as error:
        assert error.problems
        for problem in error.problems:
            assert problem.what
            assert str(problem).isprintable()
            assert problem.column > 0 or problem.line == 0
            assert 0 <= problem.line <= n_lines + 1


@settings(max_examples=100)
@given(data=mutated(SEQUENCE))
def test_sequences(path: Path, data: bytes) -> None:
    path.write_bytes(data)

    def load() -> None:
        document, spec, _ = load_sequence(path)
        found = ProblemCollector()
        for step in spec.shot:
            with found:
                document.validate(MODELS.get(step.kind, NoSettings), step.loc)
        found.raise_any()

    load_or_report(load, data.count(b"\n") + data.count(b"\r"))


@settings(max_examples=100)
@given(data=mutated(PROFILE))
def test_profiles(path: Path, data: bytes) -> None:
    path.write_bytes(data)

    def load() -> None:
        document, spec = load_profile(path)
        spec.grid_model()
        for choice in spec.choices.values():
            document.validate(NoSettings, choice.loc, core_keys=document.get(choice.loc))

    load_or_report(load, data.count(b"\n") + data.count(b"\r"))


addresses = st.lists(
    st.sampled_from(
        ["shots", "shot", "sort", "0", "9", "rearrange", "window", "planner", "use", "target", "seed"]
    )
    | st.text(max_size=5),
    min_size=1,
    max_size=4,
).map(".".join)
values = st.sampled_from([piece.decode(errors="surrogateescape") for piece in PIECES]) | st.text(max_size=8)


@settings(max_examples=60)
@given(address=addresses, value=values)
def test_options(path: Path, address: str, value: str) -> None:
    path.write_bytes(SEQUENCE)

    def load() -> None:
        for_sequence, for_profile = split_overrides([f"{address}={value}"])
        assert all(isinstance(one, Override) for one in for_profile)
        load_sequence(path, for_sequence)

    load_or_report(load, 30)
