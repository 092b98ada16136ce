"""What the documentation shows can be used as it stands: files, command lines, Python."""

from __future__ import annotations

import re
import shlex
import shutil
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
import typer

import labseq
from labseq.cli.app import app
from labseq.cli.arguments import arrange
from labseq.cli.failures import told
from labseq.config import ProfileSpec, SequenceSpec
from labseq.config.composer import compose

ROOT = Path(__file__).parents[2]
SEQUENCE = {
    "labseq": "1",
    "name": "x",
    "shots": "1",
    "target": "{pattern: compact, rows: 5, cols: 5}",
    "shot": "[{image: {}}]",
}
PROFILE = {
    "labseq": "1",
    "name": "x",
    "grid": "{rows: 20, cols: 20, spacing: 4.49 um}",
    "camera": "{use: virtual}",
    "static_tweezers": "{use: virtual}",
    "mobile_tweezers": "{use: virtual}",
    "detector": "{use: threshold}",
    "devices": "{shutter: {use: virtual}}",
    "simulation": "{use: virtual}",
}
"""What an example leaves out."""


@dataclass(frozen=True)
class Block:
    """A block of code on a page.

    Attributes:
        place: Page and number of the block on it.
        language: Of the block, or "inline".
        text: What stands in it.
    """

    place: str
    language: str
    text: str

    def __str__(self) -> str:
        return self.place


def blocks_of(page: Path) -> list[Block]:
    text, name = page.read_text(), page.relative_to(ROOT).as_posix()
    found = [(m[2], m[3]) for m in re.finditer(r"^(```+)(\w+)\n(.*?)^\1$", text, re.DOTALL | re.MULTILINE)]
    prose = re.sub(r"^(```+).*?^\1$", "", text, flags=re.DOTALL | re.MULTILINE)
    found += [("inline", code.replace("\n", " ")) for code in re.findall(r"`(labseq[\s][^`]+)`", prose)]
    return [Block(f"{name}:{i}", language, code) for i, (language, code) in enumerate(found)]


INSTALLED = [point.value for point in entry_points(group="labseq")]
PAGES = sorted(
    [
        ROOT / "README.md",
        *(ROOT / "docs").rglob("*.md"),
        *(page for name in INSTALLED for page in (ROOT / "plugins" / name).glob("*.md")),
    ]
)
BLOCKS = [block for page in PAGES for block in blocks_of(page)]


def of(*languages: str) -> list[Block]:
    return [block for block in BLOCKS if block.language in languages]


def lines_of(block: Block) -> list[str]:
    """The command lines of labseq in a block."""
    whole = block.text.replace("\\\n", " ").splitlines()
    parts = [part.strip().removeprefix("uv run ") for line in whole for part in re.split(r"&&|\|", line)]
    return [part for part in parts if part.startswith("labseq ")]


def help_examples(group: Any, names: str = "labseq") -> list[Block]:
    """The examples below the help of each command."""
    inner = getattr(group, "commands", {}).items()
    found = [block for name, command in inner for block in help_examples(command, f"{names} {name}")]
    return [*found, Block(f"{names} --help", "console", group.epilog)] if group.epilog else found


OF_ALL = ("--help", "--version", "--install-completion", "--show-completion")
SHOWN = [*of("console", "sh", "bash", "inline"), *help_examples(typer.main.get_command(app))]
LINES = [(block, line) for block in SHOWN for line in lines_of(block)]


@pytest.mark.parametrize("block", of("yaml"), ids=str)
def test_every_yaml_example_is_valid(block: Block, tmp_path: Path) -> None:
    for file in (ROOT / "sequences").glob("*.txt"):  # drawings that examples name
        shutil.copy(file, tmp_path)
    write_plugins(block, tmp_path)
    node = compose(block.text, str(block))
    keys = {*node.plain()} if node is not None else set[str]()
    is_sequence = keys <= {*SequenceSpec.model_fields}
    assert is_sequence or keys <= {*ProfileSpec.model_fields}, f"neither sequence nor profile: {keys}"
    sequence, profile = tmp_path / "sequence.yaml", tmp_path / "profile.yaml"
    own = keys | ({"shots"} if "scan" in keys else set())  # they follow from the scan
    write(sequence, SEQUENCE, block.text if is_sequence else "", own if is_sequence else set())
    write(profile, PROFILE, "" if is_sequence else block.text, set() if is_sequence else keys)
    with labseq.Session.open(sequence, profile=str(profile)) as session:
        assert session.timeline()


def write(path: Path, rest: dict[str, str], text: str, keys: set[str]) -> None:
    """A whole file of an example and what it leaves out."""
    path.write_text(text + "".join(f"\n{key}: {value}" for key, value in rest.items() if key not in keys))


def write_plugins(block: Block, folder: Path) -> None:
    """The plugins of the example's page, where the example looks for them."""
    page = block.place.partition(":")[0]
    for name in re.findall(r"^plugin_folders: \[(\w+)\]$", block.text, re.MULTILINE):
        (folder / name).mkdir()
        for i, other in enumerate(b for b in of("python") if b.place.startswith(f"{page}:")):
            if "labseq_register" in other.text:
                (folder / name / f"example_{i}.py").write_text(other.text)


@pytest.mark.parametrize(("block", "line"), LINES, ids=[f"{block}: {line}" for block, line in LINES])
def test_every_command_line_can_be_parsed(block: Block, line: str) -> None:
    words = [word for word in arrange(shlex.split(line, comments=True)[1:]) if word != "--debug"]
    command: Any = typer.main.get_command(app)
    while hasattr(command, "commands"):
        if not words or words[0] in ("COMMAND", *OF_ALL):
            return
        command = command.commands[words.pop(0)]
    if "--help" in words:
        return
    if words or block.language != "inline":  # prose may name a command without its arguments
        command.make_context(line, words)


@pytest.mark.parametrize("block", of("python"), ids=str)
def test_every_python_example_compiles(block: Block) -> None:
    compile(block.text, str(block), "exec")


def test_the_error_in_the_reference_is_what_labseq_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    example = next(block for block in of("yaml") if block.place.startswith("docs/reference/sequence.md"))
    shown = next(block for block in of("text") if block.place.startswith("docs/reference/errors.md"))
    monkeypatch.chdir(tmp_path)
    Path("compact.yaml").write_text(example.text.replace("window", "winow"))
    with pytest.raises(labseq.ConfigError) as caught:
        labseq.Session.open("compact.yaml")
    assert "\n".join(told(caught.value)) == shown.text.rstrip()
