"""The blocks of code on the pages, with what a page says of each in comments above it.

A comment stands on a line of its own, right above its block:

- ``<!-- file: my_plugins/mine.py -->``: the reader puts the block into this file
- ``<!-- output -->``: what the block before it prints; ``...`` stands for anything
- ``<!-- output, numbers differ -->``: the same but for the numbers
- ``<!-- run with: --shots 20 -->``: further options of its commands that take long
- ``<!-- exit code: 2 -->``: of its last command
- ``<!-- not run: REASON -->``: it cannot be run here
- ``<!-- not run (pip install; make): REASON -->``: the commands that begin so cannot
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = sorted(
    [
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md")),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "plugins").rglob("*.md"),
    ]
)
COMMENT: Final = re.compile(r"<!-- (file|output|run with|exit code|not run)\b(.*) -->")
FENCE: Final = re.compile(r"^( *)(`{3,})([^`\n]*)\n(.*?)^ *\2`*[ ]*$", re.DOTALL | re.MULTILINE)
"""A block of code: its indentation, its fence, its language, its text."""
_NOT_RUN: Final = re.compile(r"(?: \((.+?)\))?: (.+)")


@dataclass(frozen=True)
class Block:
    """A block of code.

    Attributes:
        page: Its page, relative to the repository.
        line: Where it begins.
        language: Of the block; "inline" for code in the text; "" for none.
        text: What stands in it.
        comments: What the page says of it, by kind: "file", "output", "run with", "exit code", "not run".
    """

    page: str
    line: int
    language: str
    text: str
    comments: dict[str, str]

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def reason(self) -> str:
        """Why it, or a part of it, is not run; "" if all of it is."""
        found = _NOT_RUN.fullmatch(self.comments.get("not run", ""))
        return found[2] if found else ""

    @property
    def is_run(self) -> bool:
        """Whether any of it is."""
        return not self.reason or bool(self.left_out)

    @property
    def left_out(self) -> tuple[str, ...]:
        """How the commands begin that are not run."""
        found = _NOT_RUN.fullmatch(self.comments.get("not run", ""))
        return tuple(found[1].split("; ")) if found and found[1] else ()


@cache
def blocks_of(page: Path) -> list[Block]:
    """The fenced blocks of a page in order, except directives."""
    text, name = page.read_text("utf-8"), page.relative_to(ROOT).as_posix()
    lines = text.splitlines()
    found: list[Block] = []
    for fence in FENCE.finditer(text):
        indent, _, language, code = fence.groups()
        if language.startswith("{"):
            continue
        start = text.count("\n", 0, fence.start())
        comments: dict[str, str] = {}
        for line in reversed(lines[:start]):
            comment = COMMENT.fullmatch(line.strip())
            if comment is None:
                break
            comments[comment[1]] = comment[2] if comment[1] == "not run" else comment[2].lstrip(":, ")
        code = re.sub(rf"^ {{0,{len(indent)}}}", "", code, flags=re.MULTILINE)
        found.append(Block(name, start + 1, language.strip(), code, comments))
    return found


def inline_of(page: Path) -> list[Block]:
    """The commands of labseq that stand in the text of a page."""
    text, name = page.read_text("utf-8"), page.relative_to(ROOT).as_posix()
    prose = re.sub(r"^(```+).*?^\1$", "", text, flags=re.DOTALL | re.MULTILINE)
    codes = [code.replace("\n", " ") for code in re.findall(r"`(labseq[\s][^`]+)`", prose)]
    return [Block(name, i, "inline", code, {}) for i, code in enumerate(codes)]


def commands_of(block: Block) -> list[str]:
    """The command lines of a block, one for each part of ``&&``, without ``uv run``."""
    whole = block.text.replace("\\\n", " ").splitlines()
    parts = [part.strip() for line in whole for part in line.split("&&")]
    return [part.removeprefix("uv run ") for part in parts if part and not part.startswith("#")]


BLOCKS: Final = [block for page in PAGES if page.exists() for block in blocks_of(page)]
