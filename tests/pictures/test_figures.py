"""Files for pictures."""

from __future__ import annotations

from pathlib import Path

import pytest

from labseq.errors import ConfigError
from labseq.pictures.figures import check_place


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("figure.gif", r"no name of a PNG or SVG or PDF file.*ends in \.png or \.svg or \.pdf"),
        ("nowhere/figure.png", "no such folder"),
        ("a_folder.png", "this is a folder"),
        ("f" * 300 + ".png", "no name of a file"),
    ],
)
def test_a_place_without_room_for_a_picture_is_refused(name: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a_folder.png").mkdir()
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        check_place(tmp_path / name)
