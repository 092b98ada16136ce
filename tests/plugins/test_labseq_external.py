"""Static tweezers that another system holds."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from labseq_external import ExternalSettings, ExternalStaticTweezers

from labseq.plugin import Context
from labseq.testing import StaticTweezersContract


class TestExternalStaticTweezers(StaticTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], ExternalStaticTweezers]:
        return partial(ExternalStaticTweezers, ExternalSettings())


PLUGIN = """
import numpy as np
from labseq.plugin import Camera, CameraFacts, Frame, hookimpl
from labseq.testing.fakes import RecordingCamera, RecordingMobileTweezers
LABSEQ_API = 1

@hookimpl
def labseq_register(registry):
    registry.camera('mine', lambda settings, context: RecordingCamera(context))
    registry.mobile_tweezers('mine', lambda settings, context: RecordingMobileTweezers(context))
"""
PROFILE = """labseq: 1
name: real
grid: {rows: 5, cols: 6, spacing: 4.49 um}
camera: {use: mine}
static_tweezers: {use: external}
mobile_tweezers: {use: mine}
detector: {use: blind}
simulation: {use: virtual}
plugin_folders: [.]
"""
SEQUENCE = """labseq: 1
name: s
profile: ./p.yaml
shots: 1
target: {pattern: compact, rows: 2, cols: 2}
shot:
  - image: {exposure: 1 ms}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (("mine.py", PLUGIN), ("p.yaml", PROFILE), ("s.yaml", SEQUENCE)):
        (tmp_path / name).write_text(text, "utf-8")
    return tmp_path


def test_a_run_with_a_real_camera_says_nothing_of_simulated_atoms(folder: Path, call: Any) -> None:
    arguments = (str(folder / "s.yaml"), "--output", str(folder / "data"))
    code, out, err = call("run", *arguments)
    assert code == 0, out + err
    (path,) = folder.glob("data/*/0001_*")
    for text in (out, call("show", str(path))[1]):
        assert "filling" in text
        assert "true defects" not in text
    code, out, err = call("run", *arguments, "--dry-run")
    assert code == 0, out + err
    assert "true defects" in out


def test_a_ramp_of_tweezers_without_ramps_is_refused_before_the_run(folder: Path, call: Any) -> None:
    path = folder / "s.yaml"
    path.write_text(SEQUENCE + "  - ramp: {depth: 50 %}\n", "utf-8")
    code, out, err = call("check", str(path))
    assert code == 2
    assert "these static tweezers cannot be ramped" in out + err
