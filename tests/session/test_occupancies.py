from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import labseq
from labseq.assembly.occupancies import MAX_BYTES, parse_text, read_source
from labseq.assembly.planning import PlanRequest, plan_moves
from labseq.errors import ConfigError
from labseq.model import Occupancy
from labseq.testing.strategies import occupancies

ROOT = Path(__file__).parents[2]
ARRAY = np.array([[1, 0, 1], [0, 0, 1]], np.bool_)


def message(text: Any, **options: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        read_source(str(text), **options)
    return str(caught.value)


def test_random_is_drawn_as_documented() -> None:
    source = read_source("random:20x30@0.75", 5)
    assert np.array_equal(source.occupancy, np.random.default_rng(5).random((20, 30)) < 0.75)
    assert (source.seed, source.label) == (5, "random:20x30@0.75, seed 5")

    for text in ("random: 3 x 4@100 %", "random:3X4@1.0"):
        assert np.array_equal(read_source(text).occupancy, np.ones((3, 4)))


def test_a_fresh_seed_is_named_and_repeats_the_draw() -> None:
    first, second = read_source("random:20x20@0.5"), read_source("random:20x20@0.5")
    assert first.seed != second.seed
    assert f"seed {first.seed}" in first.label
    assert np.array_equal(read_source("random:20x20@0.5", first.seed).occupancy, first.occupancy)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("random:", "expected random:ROWSxCOLS@P"),
        ("random:20x20@1.5", "the filling fraction is '1.5'; expected a number from 0 to 1"),
        ("random:20x20@nan", "the filling fraction is 'nan'"),
        ("random:20x1001@0.75", "20 x 1001 sites; expected 1 to 1000"),
        ("", "the occupancy is empty; expected a text file"),
        ("nowhere.npy", "nowhere.npy: there is no such file; expected a text file of 0 and 1, a .npy file"),
        ("x" * 5000, "there is no such file"),
    ],
)
def test_what_is_no_occupancy_is_refused(text: str, words: str) -> None:
    assert words in message(text)
    assert len(message(text)) < 400


@pytest.mark.parametrize(("dtype", "order"), [(np.bool_, "C"), (np.float32, "F"), (">i4", "C")])
def test_npy_of_any_number_type(tmp_path: Path, dtype: Any, order: Any) -> None:
    np.save(tmp_path / "a.npy", np.asarray(ARRAY.astype(dtype), order=order))
    source = read_source(str(tmp_path / "a.npy"), 3)
    assert np.array_equal(source.occupancy, ARRAY)
    assert source.occupancy.dtype == np.bool_
    assert source.occupancy.flags.c_contiguous
    assert (source.seed, source.target, source.label) == (None, None, str(tmp_path / "a.npy"))


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((2, 3, 4)), "a.npy: there are 2 occupancies; expected"),
        (np.array([["1", "0"]]), "type <U1"),
        (np.array([[1, 2]]), "only contain 0 and 1"),
        (np.array([[np.nan, 1.0]]), "only contain 0 and 1"),
        (np.zeros((0, 5), np.bool_), "0 x 5 sites; expected 1 to 1000"),
        (np.array([[None, {}]], dtype=object), "it cannot be read"),
    ],
)
def test_npy_of_other_content_is_refused(tmp_path: Path, array: Any, words: str) -> None:
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    text = message(tmp_path / "a.npy")
    assert words in text
    assert "expected" in text


def test_one_of_several_occupancies_in_the_files_of_other_programs(tmp_path: Path) -> None:
    stack = np.array([~ARRAY, ARRAY])
    np.save(tmp_path / "a.npy", stack.astype(np.int64))
    np.savez(tmp_path / "one.npz", ARRAY.astype(float))
    np.savez_compressed(tmp_path / "two.npz", loaded=stack, after=stack)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["scan 1/loaded"], file["time"] = stack, np.arange(3.0)
        file["names"] = "a text"
    for address in (
        "a.npy#1",
        "one.npz",
        "two.npz:loaded#1",
        "a.h5:scan 1/loaded#1",
        "a.h5:/scan 1/loaded#1",
    ):
        assert np.array_equal(read_source(str(tmp_path / address)).occupancy, ARRAY), address

    for address, words in (
        ("two.npz", "two.npz: it holds 2 arrays; expected one of loaded, after; name one: two.npz:loaded"),
        ("two.npz:load#1", "it holds no array 'load'; expected one of loaded, after; did you mean 'loaded'?"),
        ("two.npz:loaded", "there are 2 occupancies; expected"),
        ("two.npz:loaded#2", "there is no occupancy '2'; expected 0 to 1"),
        (
            "one.npz#0",
            "the array has shape (2, 3); expected (rows, columns), or (occupancies, rows, columns)",
        ),
        (
            "a.h5",
            "expected a shot's file; for another program's file, name the array as in",
        ),
        ("a.h5", "is not a shot's file of labseq"),
        ("a.h5:time", "holds no array 'time'; expected scan 1/loaded (2, 2, 3)"),
        ("b.npz", "there is no such file"),
    ):
        assert words in message(tmp_path / address)


@pytest.mark.parametrize("name", ["a.npz", "a.h5:x", "a.hdf5"])
def test_a_damaged_file_of_arrays_is_refused_wherever_it_is_cut_off(tmp_path: Path, name: str) -> None:
    file = tmp_path / name.partition(":")[0]
    if file.suffix == ".npz":
        np.savez(file, ARRAY)
    else:
        with h5py.File(file, "w") as content:
            content["x"] = ARRAY
    whole = file.read_bytes()
    for length in range(0, len(whole), 97):
        file.write_bytes(whole[:length])
        assert "expected" in message(tmp_path / name)


@pytest.mark.parametrize(
    "content", [b"", b"1 0 1", b"\x93NUMPY", b"\x93NUMPY\x01\x00\xff\xff{", b"PK\x03\x04"]
)
def test_a_file_that_is_no_npy_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.npy").write_bytes(content)
    assert "expected an array of numbers, as numpy.save writes it" in message(tmp_path / "a.npy")


@pytest.mark.parametrize(
    "text",
    [
        b"1 0 1\n0 0 1",
        b"1,0,1\r\n0,0,1\r\n",
        b"#.#\r..#",
        b"\n  \n1\t0\t1\n0;0;1\n\n",
        b"\xef\xbb\xbf101\n001",
        b"# by numpy.savetxt\n1.000000000000000000e+00 0.0 1.\n#\n0 0 1.0 # the last\n# 3 atoms\n",
        b"1.0;0.0;1.0\r\n0.0;0.0;1.0\r\n",
        b"True,False,True\nFALSE,FALSE,TRUE\n",
        b"[[1, 0, 1], [0, 0, 1]]",
        b"[[ True False\n   True]\n [False False  True]]\n",
        b"#\r1 0 1\r0 0 1\r",
    ],
)
def test_texts_in_any_usual_form(text: bytes) -> None:
    assert np.array_equal(parse_text(text, "mine"), ARRAY)


@settings(max_examples=30)
@given(occupancies(), st.sampled_from(["01", ".#"]), st.sampled_from(["", " ", ", ", "\t"]))
def test_texts_are_read_as_they_were_written(occupancy: Occupancy, signs: str, between: str) -> None:
    text = "\n".join(between.join(signs[int(site)] for site in row) for row in occupancy)
    assert np.array_equal(parse_text(text.encode(), "mine"), occupancy)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "mine: it is empty"),
        (b"101\n01\n", "mine:2:3: this row has 2 sites; expected 3, as in line 1"),
        (b"\n101\n\n101", "mine:3:1: this row has 0 sites; expected 3, as in line 2"),
        (b"102\n", "mine:1:3: '2' is not a site; expected 0 or '.'"),
        (b"10\n1\x00\n", r"mine:2:2: '\x00' is not a site"),
        (b"10\n1\xff\n", "mine:2:2: byte 0xFF at offset 4 is not UTF-8"),
        (b"1.1 0.0\n", "mine:1:1: '1.1' is not a site"),
        (b"1.0 0.5\n", "mine:1:5: '0.5' is not a site"),
        (b"1.0 nan\n", "mine:1:5: 'nan' is not a site"),
        (b"1,0 0,0\n", "mine:1:4: the separator after '0' differs"),
        (b"1,0;0,0\n", "mine:1:4: the separator after '0' differs"),
        (b"1,,0\n", "mine:1:2: the separator after '1' differs"),
        (b"1 0 1\n#.#\n", "mine:2:1: a row of '#' and '.' among rows of numbers"),
        (b"1 0\n\n# next\n0 1\n", "mine:2:1: this row has 0 sites; expected 2, as in line 1"),
        (
            b"a b\n1 0\n",
            "mine:1:1: 'a' is not a site; expected 0 or '.' for an empty site, 1 or '#' for an atom; begin",
        ),
        (b"[[1, 0], 1]\n", "mine:1:10: '1' is not within a row"),
        (b"[[1, 0],\n [1]]\n", "mine:2:4: this row has 1 sites"),
        (b"1" * (MAX_BYTES + 1), "this is larger than 32 MiB"),
    ],
)
def test_other_texts_are_refused_with_their_place(text: bytes, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_text(text, "mine")
    assert words in str(caught.value)


@settings(max_examples=50)
@given(st.binary(max_size=60))
def test_any_text_is_read_or_refused(text: bytes) -> None:
    try:
        assert parse_text(text, "mine").size > 0
    except ConfigError as error:
        assert str(error).startswith("mine")


def test_a_text_file_and_standard_input(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("101\n001\n", "utf-8")
    assert np.array_equal(read_source(str(tmp_path / "a.txt")).occupancy, ARRAY)
    from_pipe = read_source("-", stdin=io.BytesIO(b"101\n001\n"))
    assert np.array_equal(from_pipe.occupancy, ARRAY)
    assert from_pipe.label == "standard input"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> labseq.Run:
    folder = tmp_path_factory.mktemp("data")
    sequence = ROOT / "sequences" / "compact_225.yaml"
    overrides = ["shot.2.rearrange.cycles=3"]
    with labseq.Session.open(sequence, shots=1, seed=1, output=folder, overrides=overrides) as session:
        return session.run()


def shot_file(run: labseq.Run) -> Path:
    return next((run.path / "shots").glob("*.h5"))


def test_a_shot_gives_the_image_that_each_cycle_was_planned_on(run: labseq.Run) -> None:
    shot, path = run.shots[0], shot_file(run)
    for cycle in range(len(shot.plans)):
        source = read_source(f"{path}#{cycle}")
        assert np.array_equal(source.occupancy, shot.occupancies[cycle])
        assert source.label == f"{path}, before cycle {cycle}"
    first = read_source(str(path))
    assert np.array_equal(first.occupancy, shot.occupancies[0])
    assert first.target is not None
    assert first.target.n_atoms == 225
    assert first.machine is not None
    assert first.machine["grid"]["rows"] == 20
    for cycle in ("-1", "3", "x", ""):
        assert f"there is no cycle '{cycle}'; expected a cycle from 0 to 2" in message(f"{path}#{cycle}")


def test_a_shot_is_planned_again_as_it_was(run: labseq.Run) -> None:
    for cycle, plan in enumerate(run.shots[0].plans):
        planned = plan_moves(PlanRequest(f"{shot_file(run)}#{cycle}")).plan
        assert planned.moves.tolist() == plan.moves.tolist()


def test_a_file_that_is_no_shot_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(b"no HDF5")
    assert str(path) in message(path)
    assert "expected a shot's file" in message(path)
    h5py.File(path, "w").close()
    assert "expected a shot's file" in message(f"{path}#1")
    assert "this is a folder" in message(tmp_path)
    np.save(tmp_path / "loading.npy", ARRAY)
    assert "did you mean 'loading.npy'?" in message(tmp_path / "laoding.npy")
