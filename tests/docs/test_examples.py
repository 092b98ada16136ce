"""What the documentation shows can be used as it stands."""

from __future__ import annotations

import re
import shlex
import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer
from markdown_it import MarkdownIt

import labseq
from labseq.cli.app import app
from labseq.cli.entry import arrange
from labseq.config.document import Document
from labseq.config.profile import ProfileSpec
from labseq.config.sequence import SequenceSpec
from labseq.config.yaml_nodes import compose
from labseq.console.errors import format_config_error
from labseq.session.notices import NoticeSettings
from tests.session.whole_runs import timelines

from .blocks import BLOCKS, COMMENT, PAGES, ROOT, Block, commands_of, inline_of
from .running import split

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
    "devices": "{shutter: {use: virtual}, synthesizer: {use: virtual_synthesizer}, laser: {use: serial, "
    "port: simulated, write_ends_with: ';', read_ends_with: ';', values: {power_w: {ask: P, poll: true}}}}",
    "simulation": "{use: virtual}",
}
"""What an example leaves out."""


def of(*languages: str) -> list[Block]:
    return [block for block in BLOCKS if block.language in languages]


def lines_of(block: Block) -> list[str]:
    """The command lines of labseq in a block."""
    parts = [
        shlex.join(part)
        for line in commands_of(block)
        for part in split(shlex.split(line, comments=True), "|")
    ]
    return [part for part in parts if part.startswith("labseq ")]


def help_examples(group: Any, names: str = "labseq") -> list[Block]:
    """The examples below the help of each command, and thus in the reference."""
    inner = getattr(group, "commands", {}).items()
    found = [block for name, command in inner for block in help_examples(command, f"{names} {name}")]
    return [*found, Block(f"{names} --help", 0, "help", group.epilog, {})] if group.epilog else found


OF_ALL = ("--help", "--version", "--install-completion", "--show-completion")
COMMAND: Any = typer.main.get_command(app)
SHOWN = [*of("console"), *(block for page in PAGES for block in inline_of(page)), *help_examples(COMMAND)]
LINES = [(block, line) for block in SHOWN for line in lines_of(block)]


def test_tests_that_run_a_block_elsewhere_are_there() -> None:
    named = {path for block in BLOCKS for path in re.findall(r"tests/\S+\.py", block.reason)}
    assert named
    assert [path for path in sorted(named) if not (ROOT / path).is_file()] == []


def test_every_block_is_in_a_fence_and_every_comment_belongs_to_one() -> None:
    for page in PAGES:
        text, name = page.read_text("utf-8"), page.relative_to(ROOT).as_posix()
        tokens = MarkdownIt().parse(text)
        assert [token.map for token in tokens if token.type == "code_block"] == [], f"{name}: use a fence"
        assert not re.search(r"^ *~~~", text, re.MULTILINE), f"{name}: fences are made of backticks"
        n_comments = sum(COMMENT.fullmatch(line.strip()) is not None for line in text.splitlines())
        assert n_comments == sum(len(block.comments) for block in BLOCKS if block.page == name), name


def test_the_page_of_the_installation_lists_every_extra() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    page = (ROOT / "docs" / "how-to" / "install.md").read_text("utf-8")
    assert re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE) == sorted(project["optional-dependencies"])


NEEDS_SERVER = "needs a server of devices"
VALIDATED = [block for block in of("yaml") if block.reason != NEEDS_SERVER]


@pytest.mark.parametrize("page", sorted({block.page for block in VALIDATED}))
def test_every_yaml_example_is_valid(page: str, tmp_path: Path) -> None:
    for block in VALIDATED:
        if block.page == page:
            folder = tmp_path / str(block.line)
            folder.mkdir()
            validate(block, folder)


def validate(block: Block, folder: Path) -> None:
    """Open a session with an example and what it leaves out; read the file of notices."""
    for file in (ROOT / "sequences").glob("*.txt"):  # drawings that examples name
        shutil.copy(file, folder)
    write_plugins(block, folder)
    node = compose(block.text, str(block))
    keys = {*node.plain()} if node is not None else set[str]()
    if "webhook" in keys:
        Document.parse(block.text, str(block)).validate(NoticeSettings)
        return
    is_sequence = keys <= {*SequenceSpec.model_fields}
    assert is_sequence or keys <= {*ProfileSpec.model_fields}, f"neither sequence nor profile: {keys}"
    sequence, profile = folder / "sequence.yaml", folder / "profile.yaml"
    own = keys | ({"shots"} if "scan" in keys else set())  # they follow from the scan
    write(sequence, SEQUENCE, block.text if is_sequence else "", own if is_sequence else set())
    write(profile, PROFILE, "" if is_sequence else block.text, set() if is_sequence else keys)
    with labseq.Session.open(sequence, profile=str(profile)) as session:
        assert timelines(session), block


def write(path: Path, rest: dict[str, str], text: str, keys: set[str]) -> None:
    """A whole file of an example and what it leaves out."""
    path.write_text(text + "".join(f"\n{key}: {value}" for key, value in rest.items() if key not in keys))


def write_plugins(block: Block, folder: Path) -> None:
    """The plugins of the example's page, where the example looks for them."""
    for name in re.findall(r"^plugin_folders: \[(\w+)\]$", block.text, re.MULTILINE):
        for other in (b for b in of("python") if b.page == block.page):
            file = other.comments.get("file", "")
            if file.startswith(f"{name}/"):
                (folder / name).mkdir(exist_ok=True)
                (folder / file).write_text(other.text)


def test_every_command_line_can_be_parsed() -> None:
    for block, line in LINES:
        try:
            parse(line, is_prose=block.language == "inline")
        except Exception as error:
            error.add_note(f"{block}: {line}")
            raise


def parse(line: str, *, is_prose: bool) -> None:
    words = [word for word in arrange(shlex.split(line)[1:]) if word != "--debug"]
    command = COMMAND
    while hasattr(command, "commands"):
        if not words or words[0] in ("COMMAND", *OF_ALL):
            return
        command = command.commands[words.pop(0)]
    if "--help" in words:
        return
    if words or not is_prose:  # prose may name a command without its arguments
        command.make_context(line, words).close()  # which takes back what --plugins has set


def test_the_error_in_the_reference_is_what_labseq_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    example = next(block for block in of("yaml") if block.page == "docs/reference/sequence.md")
    shown = next(block for block in of("text") if block.page == "docs/reference/errors.md")
    monkeypatch.chdir(tmp_path)
    Path("compact.yaml").write_text(example.text.replace("window", "winow"))
    with pytest.raises(labseq.ConfigError) as caught:
        labseq.Session.open("compact.yaml")
    assert "\n".join(format_config_error(caught.value)) == shown.text.rstrip()
