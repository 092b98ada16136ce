"""The contract of each role, with the device served over loopback."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import pytest
from labseq_remote.drivers import (
    RemoteCamera,
    RemoteDevice,
    RemoteLines,
    RemoteMobileTweezers,
    RemoteStaticTweezers,
)
from labseq_remote.settings import RemoteSimulationSettings
from labseq_remote.simulation import RemoteSimulation

from labseq.plugin import Context, SiteGrid
from labseq.testing import (
    CameraContract,
    DeviceContract,
    LinesContract,
    MobileTweezersContract,
    SimulationContract,
    StaticTweezersContract,
)
from labseq.testing.fakes import FakeClock
from tests.remote.conftest import Served

_port = 0


@pytest.fixture(scope="module", autouse=True)
def _served(server: Served) -> None:
    global _port
    _port = server.port


def with_simulation(context: Context) -> Context:
    settings = RemoteSimulationSettings(address=f"tcp://127.0.0.1:{_port}")
    context = replace(context, grid=SiteGrid(6, 7))
    return replace(context, simulation=RemoteSimulation(settings, replace(context, name="simulation")))


class TestRemoteCamera(CameraContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self, server: Served) -> Callable[[Context], RemoteCamera]:
        return lambda context: RemoteCamera(server.settings("camera"), context)


class TestRemoteStaticTweezers(StaticTweezersContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self, server: Served) -> Callable[[Context], RemoteStaticTweezers]:
        return lambda context: RemoteStaticTweezers(server.settings("static_tweezers"), context)


@pytest.fixture(scope="module")
def _warm(server: Served) -> None:
    """Compile the kernels; with an empty cache the first call would come late."""
    context = with_simulation(Context("mobile_tweezers", clock=FakeClock()))
    RemoteMobileTweezers(server.settings("mobile_tweezers"), context).warm()


@pytest.mark.usefixtures("_warm")
class TestRemoteMobileTweezers(MobileTweezersContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self, server: Served) -> Callable[[Context], RemoteMobileTweezers]:
        return lambda context: RemoteMobileTweezers(server.settings("mobile_tweezers"), context)


class TestRemoteDevice(DeviceContract):
    commands: ClassVar = {"open": {}, "set": {"power": 0.5}}
    values: ClassVar = ("state", "power")

    @pytest.fixture
    def factory(self, server: Served) -> Callable[[Context], RemoteDevice]:
        return lambda context: RemoteDevice(server.settings("instrument"), context)


class TestRemoteLines(LinesContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self, server: Served) -> Callable[[Context], RemoteLines]:
        return lambda context: RemoteLines(server.settings("lines"), context)


class TestRemoteSimulation(SimulationContract):
    @pytest.fixture
    def factory(self, server: Served) -> Callable[[Context], RemoteSimulation]:
        settings: Any = RemoteSimulationSettings(address=f"tcp://127.0.0.1:{server.port}")
        return lambda context: RemoteSimulation(settings, context)
