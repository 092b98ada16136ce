"""The gallery shows every pattern, its snippets are right, and its pictures show what they say."""

from __future__ import annotations

import re
import shutil
import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import labseq
from labseq import builtin as builtins
from labseq.pictures.targets import target_text
from labseq.registry import Registry

from .scripts import load_script

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "patterns.md").read_text(encoding="utf-8")
MAX_BYTES = 30_000

SEQUENCE = """
labseq: 1
name: gallery
profile: virtual
shots: 1
{snippet}
shot:
  - load: {{duration: 500 ms}}
  - image: {{exposure: 45 ms}}
"""


GALLERY = load_script("make_gallery")
EXAMPLES = list(GALLERY.examples())
EACH = pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)


def patterns() -> list[str]:
    """What labseq and the plugins that it ships register."""
    registry = Registry()
    builtins.labseq_register(registry)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for module in project["entry-points"]["labseq"].values():
        import_module(module).labseq_register(registry)
    return registry.names("pattern")


@pytest.mark.parametrize("name", patterns())
def test_every_pattern_has_a_picture_and_a_section(name: str) -> None:
    assert name in {example.pattern for example in EXAMPLES}
    assert f"\n## {name}\n" in PAGE
    assert f"| [{name}](#{name}) |" in PAGE
    assert re.search(rf"^<!-- reference: .*\bpattern {name}\b.* -->$", PAGE, re.MULTILINE)


def test_every_picture_on_the_page_belongs_to_a_snippet_and_no_other_is_kept() -> None:
    names = [example.name for example in EXAMPLES]
    assert re.findall(r"_static/patterns/(\w+)\.png", PAGE) == names
    assert sorted(path.stem for path in GALLERY.PICTURES.iterdir()) == sorted(names)


@EACH
def test_a_picture_is_small_and_shows_its_snippet(example: Any) -> None:
    target = example.target()
    assert example.picture.stat().st_size < MAX_BYTES
    with Image.open(example.picture) as picture:
        assert picture.info["Title"] == target.name, "run docs/make_gallery.py"
        assert picture.info["Description"] == target_text(target), "run docs/make_gallery.py"


@EACH
def test_a_snippet_is_part_of_a_sequence(example: Any, tmp_path: Path) -> None:
    shutil.copy(ROOT / "sequences" / "lion_head.txt", tmp_path)
    sequence = tmp_path / "sequence.yaml"
    sequence.write_text(SEQUENCE.format(snippet=example.snippet))
    lattice = f"profile.grid.lattice={example.grid.lattice}"
    target = labseq.Session.open(sequence, overrides=[lattice]).assembly.target
    assert target_text(target) == target_text(example.target())


def test_the_plugin_on_the_page_works(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.+?)```", PAGE, re.DOTALL)
    (tmp_path / "mine.py").write_text(code)
    target = labseq.make_target("stripes", grid=(5, 4), plugin_folders=(tmp_path,), rows=3, cols=4)
    assert target_text(target) == "....\n####\noooo\n####\n...."
