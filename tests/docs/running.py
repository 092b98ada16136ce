"""A reader who does what a page says: runs its commands and its Python, block by block, in one folder."""

from __future__ import annotations

import os
import re
import shlex
import sys
import tempfile
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

# else `labseq plan` would choose plain Python for all that follows in this process
import numba  # noqa: F401  # pyright: ignore[reportUnusedImport]

from labseq.cli import main

from .blocks import Block, commands_of

FILTERS: Final = ("jq", "tee", "head")
"""Programs behind a pipe that are the reader's own: what labseq gives them is not asked for."""
FEW: Final = {
    "run": "--shots 1 --seed 1",
    "queue add": "--shots 1",
    "bench planners": "--loadings 2 --workers 1",
    "bench latency": "--loadings 1",
    "bench waveform": "--repeats 1",
    "calibrate amplitudes": "",
    "calibrate tweezers": "",
    "calibrate sites": "--shots 8 --seed 1",
    "calibrate timing": "--shots 5 --seed 1",
    "calibrate thresholds": "--shots 30 --seed 1",
    "calibrate": "--shots 29 --seed 1 --set record_frames=none",
}
"""Commands that take long -> what makes them short where the page says nothing else."""
RUN: Final = re.compile(r"data/(\d{4}-\d\d-\d\d/\d{4})_([a-z0-9-]+)")
"""The folder of a run, as pages name it."""
KINDS: Final = ("console", "python", "yaml", "text", "json")


class PageError(AssertionError):
    """A block does not do what its page says."""

    def __init__(self, block: Block, text: str) -> None:
        super().__init__(f"{block}: {text}")


class Reader:
    """Goes through the blocks of one page; stands in the folder in which the page is to be run.

    Attributes:
        said: What the last block printed.
        names: Python names that the page has made so far.
        replaced: What stands on the page -> what it is here, for example ids of calibrations.
    """

    def __init__(self, replaced: dict[str, str], names: dict[str, Any]) -> None:
        self.said = ""
        self.names = {"__name__": "page", **names}
        self.replaced = replaced

    def read(self, block: Block) -> None:
        """Do what a block says."""
        if block.language not in KINDS:
            raise PageError(block, f"'{block.language}' is not run; expected one of {', '.join(KINDS)}")
        if not block.is_run:
            return
        if "file" in block.comments:
            self._save(block)
        elif "output" in block.comments:
            self._compare(block)
        elif block.language == "python":
            self.said = printed(lambda: exec(compile(self._here(block.text), str(block), "exec"), self.names))
        elif block.language == "console":
            self._run(block)
        elif block.language in ("text", "json"):
            raise PageError(block, "say above it whether it is a file, an output, or not run")

    def _here(self, text: str) -> str:
        for there, here in self.replaced.items():
            text = text.replace(there, here)
        return RUN.sub(self._own_run, text)

    def _own_run(self, shown: re.Match[str]) -> str:
        """The folder of a run on the page, or of the page's own run of this name."""
        own = sorted(Path("data").glob(f"*/*_{shown[2]}"), key=lambda path: path.stat().st_mtime_ns)
        return shown[0] if Path(shown[0]).exists() or not own else own[-1].as_posix()

    def _save(self, block: Block) -> None:
        path = Path(block.comments["file"])
        assert not path.is_absolute()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self._here(block.text), "utf-8")

    def _compare(self, block: Block) -> None:
        inexact = block.comments["output"] == "numbers differ"
        shown, said = (without_numbers(t) if inexact else stripped(t) for t in (block.text, self.said))
        pattern = ".*?".join(map(re.escape, shown.split("...")))
        if not re.search(rf"^{pattern}$", said, re.DOTALL | re.MULTILINE):
            raise PageError(block, f"shows\n{block.text}\nbut labseq says\n{self.said}")

    def _run(self, block: Block) -> None:
        self.said = ""
        commands = [c for c in commands_of(block) if not c.startswith(block.left_out)]
        last = int(block.comments.get("exit code", 0))
        for i, command in enumerate(commands):
            code = self._pipe(block, self._here(command))
            expected = last if i == len(commands) - 1 else 0
            if code != expected:
                raise PageError(block, f"'{command}' exits with {code}, not {expected}\n{self.said}")

    def _pipe(self, block: Block, command: str) -> int:
        """Run the parts of a pipe; the exit code of the last one."""
        code, piped = 0, ""
        for part in split(shlex.split(command, comments=True), "|"):
            program, *arguments = part
            if program in FILTERS:
                break
            if program != "labseq":
                raise PageError(
                    block, f"'{program}' is not labseq's; mark the block as not run, with a reason"
                )
            code, piped, errors = labseq(arguments + extra(block, arguments), piped)
            self.said += piped + errors
        return code


def extra(block: Block, arguments: list[str]) -> list[str]:
    """Options that make a command short."""
    for name, few in FEW.items():
        if arguments[: len(name.split())] == name.split():
            return shlex.split(block.comments.get("run with", few))
    return []


def split(words: list[str], at: str) -> list[list[str]]:
    """The parts between the words that are ``at``."""
    parts: list[list[str]] = [[]]
    for word in words:
        if word == at:
            parts.append([])
        else:
            parts[-1].append(word)
    return parts


def stripped(text: str) -> str:
    return "\n".join(line.rstrip() for line in text.strip().splitlines())


def without_numbers(text: str) -> str:
    """Text with ``#`` for each number and each id, and one space for many.

    A time loses its prefix, too: a slow computer answers in ``1.2 ms`` where the page shows ``35 us``.
    """
    text = re.sub(r"\b[0-9a-f]{12}\b", "#", stripped(text))
    text = re.sub(r"-?\d[\d.]*(e-?\d+)?(\(\d+\))?", "#", text)
    return re.sub(r"[ ]+", " ", re.sub(r"# [mun]s\b", "# s", text))


def labseq(arguments: list[str], piped: str = "") -> tuple[int, str, str]:
    """Run a command line of labseq in this process.

    Returns:
        Exit code, and what it printed on stdout and stderr.
    """
    with streams(piped) as (out, err):
        try:
            main(arguments)
        except SystemExit as left:
            code = int(left.code or 0)
    return code, out(), err()


def printed(work: Callable[[], None]) -> str:
    """What a piece of Python prints."""
    with streams("") as (out, _):
        work()
    return out()


@contextmanager
def streams(piped: str) -> Generator[tuple[Callable[[], str], Callable[[], str]]]:
    """Files of our own as stdin, stdout and stderr, also for child processes; they tell what was written."""
    names, texts = ("stdin", "stdout", "stderr"), ["", "", ""]
    kept = [(getattr(sys, name), os.dup(number)) for number, name in enumerate(names)]
    with ExitStack() as stack:
        files = [stack.enter_context(tempfile.TemporaryFile()) for _ in names]
        files[0].write(piped.encode())
        files[0].seek(0)
        try:
            for number, (name, file) in enumerate(zip(names, files, strict=True)):
                os.dup2(file.fileno(), number)
                mode = "r" if number == 0 else "w"
                setattr(sys, name, stack.enter_context(open(number, mode, encoding="utf-8", closefd=False)))
            yield lambda: texts[1], lambda: texts[2]
        finally:
            for number, (old, copy) in enumerate(kept):
                if number:
                    getattr(sys, names[number]).flush()
                setattr(sys, names[number], old)
                os.dup2(copy, number)
                os.close(copy)
            for number, file in enumerate(files):
                file.seek(0)
                texts[number] = file.read().decode("utf-8", "replace")
