"""Fixtures for tests of plugins. pytest finds them automatically.

Every pytest of the environment loads this module, so labseq is imported only inside
the fixtures.
"""

from __future__ import annotations

import sys
from collections.abc import Generator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from labseq.model import SiteGrid
    from labseq.roles import Context
    from labseq.testing.fakes import FakeClock

pytest.register_assert_rewrite("labseq.testing.contracts")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    call: pytest.CallInfo[None],
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Print a broken promise without the code of the suite."""
    report = yield
    contracts = sys.modules.get("labseq.testing.contracts.promises")
    error = None if call.excinfo is None else call.excinfo.value
    if report.failed and contracts is not None and isinstance(error, contracts.ContractViolation):
        report.longrepr = contracts.failure_text(error)
    return report


@pytest.fixture
def paper_grid() -> SiteGrid:
    """The paper's base array: 20 x 20 sites, triangular, 4.49 um."""
    from labseq.model import SiteGrid

    return SiteGrid()


@pytest.fixture
def virtual_clock() -> FakeClock:
    """A clock whose time passes only during waits. It records every wait."""
    from labseq.testing.fakes import FakeClock

    return FakeClock()


@pytest.fixture
def labseq_context(paper_grid: SiteGrid, virtual_clock: FakeClock) -> Context:
    """A context for a plugin's factory, with the paper's grid, virtual time and a recording simulation."""
    from labseq.roles import Context
    from labseq.testing.fakes import Calls, RecordingSimulation

    simulation = RecordingSimulation(Calls(virtual_clock))
    return Context("plugin", paper_grid, clock=virtual_clock, simulation=simulation)
