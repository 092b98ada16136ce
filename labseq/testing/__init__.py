"""Contract suites, hypothesis strategies and fakes for authors of plugins.

A plugin's test inherits the suite of its role and provides one fixture::

    from functools import partial
    from labseq.testing import CameraContract


    class TestMyCamera(CameraContract):
        @pytest.fixture
        def factory(self):
            return partial(MyCamera, MySettings(port="simulated"))

``factory(context)`` constructs the plugin like labseq, after the
settings were read. Each failure names the broken promise.

``SUITES`` has the suite of each kind of plugin, and ``docs/reference/testing.md`` lists all promises.

Runs never import it, because it needs pytest and hypothesis (``pip install "labseq[testing]"``). Names are
resolved when they are first used, because pytest loads this package wherever labseq is installed.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

from labseq.messages import install_hint

if TYPE_CHECKING:
    from labseq.testing import fakes as fakes, strategies as strategies
    from labseq.testing.contracts import (
        SUITES as SUITES,
        AnalysisContract as AnalysisContract,
        CameraContract as CameraContract,
        ContractViolation as ContractViolation,
        DetectorContract as DetectorContract,
        DeviceContract as DeviceContract,
        LinesContract as LinesContract,
        MobileTweezersContract as MobileTweezersContract,
        PatternContract as PatternContract,
        PlannerContract as PlannerContract,
        ScannerContract as ScannerContract,
        SimulationContract as SimulationContract,
        StaticTweezersContract as StaticTweezersContract,
        StepContract as StepContract,
    )

_MODULES: Final = ("fakes", "strategies")


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(f"module 'labseq.testing' has no attribute '{name}'")
    for package in ("pytest", "hypothesis"):
        if find_spec(package) is None:
            text = f"labseq.testing needs {package}; install it with: {install_hint('testing')}"
            raise ModuleNotFoundError(text, name=package)
    if name in _MODULES:
        return importlib.import_module(f"labseq.testing.{name}")
    contracts = importlib.import_module("labseq.testing.contracts")
    if name not in contracts.__all__:
        raise AttributeError(f"module 'labseq.testing' has no attribute '{name}'")
    return getattr(contracts, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES, *importlib.import_module("labseq.testing.contracts").__all__})
