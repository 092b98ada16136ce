"""A data folder with a run, and the application without a network."""

from pathlib import Path

import pytest

from tests.recording.damages import copied, write_whole_run

from .clients import Client, client_of


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole run, which no test changes."""
    return write_whole_run(tmp_path_factory.mktemp("made"))


@pytest.fixture
def run_dir(template: Path, tmp_path: Path) -> Path:
    """A copy of it, in a data folder of its own."""
    return copied(template, tmp_path / "data")


@pytest.fixture
def client(run_dir: Path) -> Client:
    """The application of that data folder."""
    return client_of(run_dir.parent.parent)
