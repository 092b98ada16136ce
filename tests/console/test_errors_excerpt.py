from pathlib import Path

import pytest
from hypothesis import given, strategies as st
from rich.cells import cell_len

from labseq.config.addresses import Override
from labseq.config.document import Document
from labseq.console.errors import excerpt
from labseq.errors import Problem


def shown(tmp_path: Path, text: str | bytes, line: int, column: int) -> list[str]:
    path = tmp_path / "a.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return excerpt(Problem("wrong", str(path), line, column))


def test_the_word_is_underlined(tmp_path: Path):
    assert shown(tmp_path, "a: 1\nb: {windw: 60 ms, c: 2}\n", 2, 5) == [
        "    2 | b: {windw: 60 ms, c: 2}",
        "      |     ^^^^^",
    ]


def test_a_value_of_several_words_is_underlined_whole(tmp_path: Path):
    assert shown(tmp_path, "b: {window: 60 ms, c: 2}\n", 1, 13)[1] == "      |             ^^^^^"


def test_tabs_keep_the_caret_in_place(tmp_path: Path):
    assert shown(tmp_path, "\tb: 1\n", 1, 2)[1] == "      | \t^"


def test_wide_and_combining_characters_keep_the_caret_in_place(tmp_path: Path):
    assert shown(tmp_path, "{東京: e\u0301, wrng: 東}\n", 1, 10)[1] == "      | " + " " * 10 + "^^^^"
    assert shown(tmp_path, "a: 東京 x\n", 1, 4)[1] == "      |    ^^^^^^"


def test_a_colon_inside_of_a_word_belongs_to_it(tmp_path: Path):
    assert shown(tmp_path, "{time: 10:30, b: 1}\n", 1, 8)[1] == "      |        ^^^^^"


@pytest.mark.parametrize("before", ["x", "東"])
def test_a_narrow_terminal_gets_a_narrow_excerpt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str
):
    monkeypatch.setenv("COLUMNS", "40")
    line, carets = shown(tmp_path, before * 60 + " wrong: 1 " + "東" * 60, 1, 62)
    assert cell_len(line) <= 40
    assert cell_len(line[: line.index("wrong")]) == carets.index("^")


@pytest.mark.parametrize(
    ("value", "carets"),
    [
        ("{b: 1, c: x}", f"      | {' ' * 18}^"),
        ("x", None),  # all of the value is wrong
        (f"{{b: 1, c: {'x' * 80}}}", None),  # its name is abbreviated
    ],
)
def test_an_option_is_shown_with_its_wrong_part(value: str, carets: str | None):
    option = Override("a", value)
    document = Document.of_options([option], "the command line")
    lines = excerpt(document.problem(("a", "c"), "wrong"))
    assert lines == ([] if carets is None else [f"      | --set a={value}", carets])


def test_a_file_in_utf_16_is_not_shown(tmp_path: Path):
    assert shown(tmp_path, "a: 1\n".encode("utf-16"), 1, 1) == []


def test_what_cannot_be_shown_is_left_out(tmp_path: Path):
    assert excerpt(Problem("wrong", str(tmp_path / "gone.yaml"), 1, 1)) == []
    assert shown(tmp_path, "a: 1\n", 9, 1) == []
    assert shown(tmp_path, "", 1, 1) == []
    assert shown(tmp_path, b"a: \xff\xfe\x1b[31m\n", 1, 4)[0].isprintable()


@given(st.binary(max_size=300), st.integers(1, 8), st.integers(1, 320))
def test_any_file_and_place_can_be_shown(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, line: int, column: int
):
    lines = shown(tmp_path_factory.mktemp("any"), content, line, column)
    assert len(lines) in (0, 2)
    assert all("\n" not in text and len(text) < 120 for text in lines)
