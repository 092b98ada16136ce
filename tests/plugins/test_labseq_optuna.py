"""The scanner that asks Optuna keeps the promises of its role, learns, and says what it needs."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import partial
from typing import Any, ClassVar

import pytest
from labseq_optuna.scanner import OptunaScanner, OptunaSettings

from labseq.plugin import ConfigError, ScanRange, ScanSpace, VisitedPoint
from labseq.plugin.messages import install_hint
from labseq.testing import ScannerContract
from labseq.testing.contracts.deciders import ScannerFactory

SPEED = ScanRange("profile.mobile_tweezers.speed", 0.05, 0.2)
CYCLES = ScanRange("shot.2.rearrange.cycles", 1, 40, is_whole=True)


class TestTpe(ScannerContract):
    n_points: ClassVar[int] = 12

    @pytest.fixture
    def factory(self) -> ScannerFactory:
        return partial(OptunaScanner, OptunaSettings(n_random=4))


class TestRandom(ScannerContract):
    n_points: ClassVar[int] = 6

    @pytest.fixture
    def factory(self) -> ScannerFactory:
        return partial(OptunaScanner, OptunaSettings(sampler="random"))


def visited(sampler: Any, n_points: int, seed: int) -> list[float]:
    """Scores on a hill whose top is 0."""
    space = ScanSpace((SPEED, CYCLES), n_points, seed=seed)
    scanner = OptunaScanner(OptunaSettings(sampler=sampler), space)
    points: list[VisitedPoint] = []
    for _ in range(n_points):
        point = scanner.next_point(points)
        away = [one.fraction(point[one.address]) - 0.8 for one in (SPEED, CYCLES)]
        points.append(VisitedPoint(point, -sum(part**2 for part in away)))
    return [point.score for point in points]


def test_tpe_gathers_around_the_top_and_random_does_not() -> None:
    late = {kind: visited(kind, 40, seed=1)[-15:] for kind in ("tpe", "random")}
    assert sum(late["tpe"]) / 15 > -0.05 > sum(late["random"]) / 15


def test_another_seed_gives_other_points() -> None:
    assert visited("tpe", 3, seed=1) != visited("tpe", 3, seed=2)


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match=re.escape(f"; install it with {install_hint('optuna')}")):
        OptunaScanner(OptunaSettings(), ScanSpace((SPEED,), 5))


def test_the_package_is_imported_only_where_it_is_used() -> None:
    code = "import labseq_optuna.scanner, sys; print('optuna' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
