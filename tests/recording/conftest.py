"""A recorded run for tests that damage it."""

from pathlib import Path

import pytest

from .damages import copied, write_whole_run


@pytest.fixture(scope="package")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole run, which no test changes."""
    return write_whole_run(tmp_path_factory.mktemp("made"))


@pytest.fixture
def run_dir(template: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return copied(template, tmp_path / "data")
