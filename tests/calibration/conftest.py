"""Labs whose profile differs from what their simulation does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from labseq.calibration.measure import METHODS, CalibrationRequest, Outcome, calibrate
from labseq.calibration.store import Store
from labseq.testing.fakes import RecordingObserver

HEAD = """labseq: 1
name: lab
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
"""


class Lab:
    """A folder with a profile, its calibrations and its data."""

    def __init__(self, folder: Path, profile: str) -> None:
        folder.mkdir(exist_ok=True)
        self.folder, self.profile = folder, folder / "lab.yaml"
        self.store = Store(folder / "calibrations" / "lab")
        self.observer = RecordingObserver()
        self.write_profile(profile)

    def write_profile(self, text: str) -> None:
        self.profile.write_text(HEAD + text, "utf-8")

    def calibrate(self, kind: str, **changes: Any) -> Outcome:
        changes = {"output": self.folder / "data", "seed": 1} | changes
        request = CalibrationRequest(str(self.profile), **changes)
        return calibrate(METHODS[kind], request, self.observer)


@pytest.fixture(autouse=True)
def unencoded(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are composed, but not rendered, except for tests that ask for ``rendered``."""
    if "rendered" not in request.fixturenames:
        encode = "labseq.calibration.measure.encode_figure"
        monkeypatch.setattr(encode, lambda draw, **_: b"png" if draw() else b"")


@pytest.fixture
def rendered() -> None:
    """Pictures are those that users get."""


@pytest.fixture(scope="session")
def make_lab() -> Callable[[Path, str], Lab]:
    return Lab
