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
from labseq.settings import Settings

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
PIECES = [
    *(
        b"",
        b"\t",
        b"\n",
        b"  ",
        b": ",
        b"- ",
        b"&a ",
        b"? ",
        b"!!int ",
        b"---\n",
        b"...\n",
        b"\r",
        b"\0",
        b"\xff",
    ),
    *b": [ ] { } ' \" # *a << ! | > % \\ null true -1 0 1e999 .nan 0x [] {} name use ~ ...".split(),
    *(b"9" * 200, b"10 um", b"[1, 2", b'"\\ud800"', b'"\\0"', b"\xef\xbb\xbf"),
    *("\u2028".encode(), "\x85".encode(), "\U0001f600".encode()),
]


@st.composite
def mutated(draw: st.DrawFn, good: bytes) -> bytes:
    """A good file after a few accidents to its lines, its words or its bytes."""
    text = good
    for _ in range(draw(st.integers(1, 4))):
        lines = text.splitlines(keepends=True) or [b""]
        i, j = draw(st.integers(0, len(lines) - 1)), draw(st.integers(0, len(lines) - 1))
        at, length = draw(st.integers(0, len(text))), draw(st.integers(0, 6))
        piece = draw(st.sampled_from(PIECES) | st.binary(max_size=3))
        match draw(st.integers(0, 5)):
            case 0:
                text = text[:at] + piece + text[at + length :]
            case 1:
                text = b"".join(lines[:i] + lines[i + 1 :])
            case 2:
                text = b"".join([*lines[:i], lines[j], *lines[i:]])
            case 3:
                head, colon, _ = lines[i].partition(b": ")
                text = b"".join([*lines[:i], head + colon + piece + b"\n", *lines[i + 1 :]])
            case 4:
                lines[i], lines[j] = lines[j], lines[i]
                text = b"".join(lines)
            case _:
                text = b"".join([*lines[:i], b" " * length + lines[i].lstrip(b" "), *lines[i + 1 :]])
    return text


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
            assert (problem.line == 0) == (problem.column == 0)
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
                document.validate(MODELS.get(step.kind), step.loc)
        found.raise_any()

    load_or_report(load, data.count(b"\n") + data.count(b"\r"))


@settings(max_examples=100)
@given(data=mutated(PROFILE))
def test_profiles(path: Path, data: bytes) -> None:
    path.write_bytes(data)

    def load() -> None:
        document, spec = load_profile(path.name, beside=path.parent)
        spec.grid_model()
        for choice in spec.choices.values():
            document.validate(None, choice.loc, drop=document.get(choice.loc))

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
