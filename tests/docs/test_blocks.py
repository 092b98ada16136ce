"""Every block of code of the documentation is run, in the order of its page."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest
from matplotlib.figure import Figure

from .blocks import PAGES, ROOT, blocks_of
from .given import NEEDED, Store, prepare
from .running import Reader


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """One for all processes of the tests."""
    base = tmp_path_factory.getbasetemp()
    return Store((base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "runs")


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """What each command does once for its process is not done a hundred times in this one."""
    monkeypatch.setattr("labseq.bench.latency.N_WARM", 1)
    monkeypatch.setattr("labseq.calibration.measure.encode_figure", lambda *_, **__: b"")
    monkeypatch.setattr("labseq.pictures.figures.encode_figure", composed)
    monkeypatch.setenv("GIT_DIR", os.devnull)  # no digest of the code's changes for each run


def composed(draw: Callable[[], Figure], *_: object, **__: object) -> bytes:
    """Compose a picture, but do not render it: other tests do."""
    draw()
    return b""


ALL_LOADINGS: Final = ("docs/tutorials/scan.md",)
"""Pages that show a duration which `labseq check` finds with all 200 random loadings."""
BY_OTHERS: Final = ("docs/tutorials/planner.md", "docs/tutorials/camera-driver.md")
"""Pages whose every block :mod:`tests.docs.test_tutorials` runs."""


def with_blocks() -> list[str]:
    """Pages with something to run."""
    names = [page.relative_to(ROOT).as_posix() for page in PAGES if page.exists()]
    names = [name for name in names if name not in BY_OTHERS]
    return [name for name in names if any(b.is_run and b.language != "yaml" for b in blocks_of(ROOT / name))]


def page_param(page: str) -> Any:
    return pytest.param(page, marks=[pytest.mark.needs(NEEDED[page])] if page in NEEDED else [])


@pytest.mark.parametrize("page", [*map(page_param, with_blocks())])
def test_a_page_can_be_followed(
    page: str, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if page in ALL_LOADINGS:
        monkeypatch.setattr("labseq.session.check.N_LOADINGS", 200)
    blocks = blocks_of(ROOT / page)
    given = prepare(page, blocks, tmp_path, store)
    reader = Reader(given.replaced, given.names)
    monkeypatch.chdir(tmp_path)
    for block in blocks:
        reader.read(block)
