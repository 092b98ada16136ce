"""The reader of pages notices what a page does wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from .blocks import Block
from .running import PageError, Reader


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def block(language: str, text: str, **comments: str) -> Block:
    return Block(
        "page.md", 3, language, text, {name.replace("_", " "): said for name, said in comments.items()}
    )


def read(*blocks: Block) -> Reader:
    reader = Reader({}, {})
    for one in blocks:
        reader.read(one)
    return reader


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (block("console", "labseq run none.yaml\n"), "exits with 2, not 0"),
        (block("console", "make everything\n"), "'make' is not labseq's"),
        (block("console", "labseq run a.yaml | mail\n", run_with=""), "'mail' is not labseq's|exits with"),
        (block("text", "shown\n"), "say above it"),
        (block("bash", "labseq --version\n"), "'bash' is not run"),
    ],
    ids=lambda value: value.text.strip() if isinstance(value, Block) else "",
)
def test_a_wrong_block_is_named_with_its_place(wrong: Block, said: str) -> None:
    with pytest.raises(PageError, match=rf"(?s)^page\.md:3: .*({said})"):
        read(wrong)


def test_python_that_fails_is_named_with_its_place() -> None:
    with pytest.raises(ZeroDivisionError) as failed:
        read(block("python", "a = 0\n1 / a\n"))
    assert str(failed.traceback[-1].path) == "page.md:3"


@pytest.mark.parametrize(
    ("shown", "how", "is_right"),
    [
        ("a 1.5(2) b", "", True),
        ("a 2 b", "", False),
        ("a 2 b", "numbers differ", True),
        ("a  -3e-4   b", "numbers differ", True),
        ("a 1.5(2) b\nid 1", "", False),
        ("id 0123456789ab", "numbers differ", True),
        ("took 35 us", "numbers differ", True),
    ],
)
def test_what_is_shown_is_compared(shown: str, how: str, is_right: bool) -> None:
    code = block(
        "python", "print('first'); print('a 1.5(2) b'); print('id fedcba987654'); print('took 1.2 ms')\n"
    )
    if is_right:
        read(code, block("text", f"{shown}\n", output=how))
    else:
        with pytest.raises(PageError, match="but labseq says"):
            read(code, block("text", f"{shown}\n", output=how))


def test_a_block_that_is_not_run_is_passed_over() -> None:
    read(block("console", "rm -r everything\n", not_run=": for a reason"))
    read(block("console", "make it && labseq --version\n", not_run=" (make): for a reason"))
    with pytest.raises(PageError, match="'rm' is not labseq's"):
        read(block("console", "make it && rm it\n", not_run=" (make): for a reason"))
