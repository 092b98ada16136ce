"""A plan as a picture of small multiples, for a person to follow."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from labseq.errors import ConfigError, Problem


def check_picture(path: Path) -> None:
    """Find out whether a picture can be drawn and where it is to go, before anything is planned.

    Raises:
        ConfigError: The file has another ending than .png, its folder does not
            exist, or matplotlib is not installed.
    """
    name = str(path)
    if path.suffix.lower() != ".png":
        raise ConfigError(Problem("this is no name of a PNG file", name, expected="a file that ends in .png"))
    if not path.parent.is_dir():
        raise ConfigError(Problem("there is no such folder", str(path.parent), expected="one that exists"))
    if path.is_dir():
        raise ConfigError(Problem("this is a folder", name, expected="a file that ends in .png"))
    if find_spec("matplotlib") is None:
        what = "drawing a picture needs matplotlib, which is not installed"
        raise ConfigError(Problem(what, hint="pip install 'labseq[plot]'"))
