"""The package as a plugin author's pytest sees it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from labseq.model import SiteGrid
from labseq.roles import Context
from labseq.testing.fakes import FakeClock, RecordingSimulation

MODULE = """
import pytest
from labseq.testing import CameraContract
from labseq.testing.fakes import RecordingCamera


class ForgetfulCamera(RecordingCamera):
    def arm(self, n_frames, exposure_s, trigger):
        super().arm(n_frames, 0.02, trigger)


class TestForgetfulCamera(CameraContract):
    @pytest.fixture
    def factory(self):
        return ForgetfulCamera


class TestWithoutFactory(CameraContract):
    pass
"""


def test_the_fixtures_fit_together(
    labseq_context: Context, paper_grid: SiteGrid, virtual_clock: FakeClock
) -> None:
    assert paper_grid.shape == (20, 20)
    assert labseq_context.grid is paper_grid
    assert labseq_context.clock is virtual_clock
    assert isinstance(labseq_context.simulation, RecordingSimulation)


@pytest.mark.system
def test_a_plugin_author_sees_the_broken_promise(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(MODULE)
    options = ["-q", "-p", "no:cacheprovider", "--tb=short", "-k", "frame", "test_mine.py"]
    command = [sys.executable, "-m", "pytest", *options]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "test_mine.py::TestForgetfulCamera::test_gives_a_frame" in done.stdout
    assert "promise: arm, trigger, read gives a Frame" in done.stdout
    assert "the frame's exposure is 0.02 s; expected 0.01 s" in done.stdout
    assert "1 failed" in done.stdout
    assert "TestWithoutFactory needs a fixture 'factory'" in done.stdout


@pytest.mark.system
def test_the_plugin_itself_imports_next_to_nothing() -> None:
    code = "import sys, labseq.testing.pytest_plugin as p; print(*sorted(m for m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = done.stdout.split()
    assert "labseq.testing.pytest_plugin" in modules
    heavy = {"numpy", "hypothesis", "pydantic", "numba", "labseq.model", "labseq.testing.contracts"}
    assert not heavy & set(modules)
