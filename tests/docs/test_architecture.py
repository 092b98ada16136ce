"""The architecture page says where things are: what it names is there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_file_and_every_name_is_where_the_page_says() -> None:
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text("utf-8")
    modules = [path for folder in ("labseq", "plugins", "tests") for path in (ROOT / folder).rglob("*.py")]

    def called(file: str) -> list[Path]:
        return [path for path in modules if path.as_posix().endswith(f"/{file}")]

    def is_defined(name: str, file: str) -> bool:
        last = name.rpartition(".")[2]
        texts = [path.read_text("utf-8") for path in called(file)]
        return any(re.search(rf"^\s*(def|class) {last}\b|^{last}\b", text, re.MULTILINE) for text in texts)

    files = re.findall(r"`([\w/]+\.py)`", page)
    places = re.findall(r"`([\w.]+)` (?:in |\()`([\w/]+\.py)`", page)
    assert len(files) > 40
    assert len(places) > 20
    assert not [file for file in files if not called(file)]
    assert not [place for place in places if not is_defined(*place)]
