"""Every picture is shown, and made by a script; those of commands by the commands that their page shows."""

from __future__ import annotations

import re
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageChops, ImageStat

from .blocks import PAGES, ROOT, blocks_of, commands_of
from .running import labseq
from .scripts import load_script

STATIC = ROOT / "docs" / "_static"
BY_OTHERS = (
    *("patterns/", "planners/", "paper/", "virtual/", "web/"),
    *("run.svg", "off_after_kill.png", "stream_levels.png"),
)
"""Made by scripts with tests of their own."""


SCRIPT = load_script("make_pictures")


def test_every_picture_is_shown_and_made() -> None:
    there = {
        path.relative_to(STATIC).as_posix() for path in STATIC.rglob("*") if path.suffix in (".png", ".svg")
    }
    pages = "".join(page.read_text("utf-8") for page in PAGES)
    shown = set(re.findall(r"_static/([\w/.-]+\.(?:png|svg))", pages))
    assert there == shown
    assert {name for name in there if not name.startswith(BY_OTHERS)} == {*SCRIPT.PICTURES}


@pytest.mark.parametrize("name", SCRIPT.PICTURES)
def test_a_picture_is_made_by_the_commands_of_its_page(name: str) -> None:
    picture = SCRIPT.PICTURES[name]
    page = ROOT / "docs" / picture.page
    commands = [one for block in blocks_of(page) if block.language == "console" for one in commands_of(block)]
    assert {*picture.commands} <= {*commands}
    assert f"_static/{name}" in page.read_text("utf-8")


def test_a_picture_can_be_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(program: list[str], *, cwd: Path, **_: object) -> None:
        with chdir(cwd):
            assert labseq(program[3:])[0] == 0

    monkeypatch.setattr("subprocess.run", run)
    SCRIPT.make("plan_kagome.png", tmp_path)
    with Image.open(tmp_path / "plan_kagome.png") as made, Image.open(STATIC / "plan_kagome.png") as kept:
        assert made.size == kept.size
        change = ImageChops.difference(made.convert("RGB"), kept.convert("RGB"))
    assert max(ImageStat.Stat(change).mean) < 3.0


def test_the_picture_of_the_readme_can_be_made_again(tmp_path: Path) -> None:
    load_script("make_run_picture").take(tmp_path / "run.svg", shots=2, after=1)
    text = (tmp_path / "run.svg").read_text("utf-8")
    assert "compact-225" in text
    assert "1/2" in text
    assert "compact-225" in (STATIC / "run.svg").read_text("utf-8")


def test_the_picture_of_outputs_after_a_kill_can_be_drawn_again(tmp_path: Path) -> None:
    script = load_script("make_off_picture")
    on = np.where(script.TIMES_S < 0.02, 0.5, 0.0)
    watched, alone = script.Outputs(70 * on, on, on > 0), script.Outputs(0 * on + 35, on, on >= 0)
    script.draw(watched, alone, tmp_path / "off.png")
    with Image.open(tmp_path / "off.png") as made, Image.open(STATIC / "off_after_kill.png") as kept:
        assert made.size == kept.size


def test_the_picture_of_a_stream_can_be_made_again(tmp_path: Path) -> None:
    load_script("make_stream_picture").draw(tmp_path / "levels.png")
    with Image.open(tmp_path / "levels.png") as made, Image.open(STATIC / "stream_levels.png") as kept:
        assert made.size == kept.size
