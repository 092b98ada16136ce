"""The contract of each role, with the device served over loopback.

Between them is a proxy that delays each message, and delivers it a second time after the next one.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace
from typing import ClassVar

import pytest
from labseq_remote.drivers import (
    RemoteCamera,
    RemoteDevice,
    RemoteLines,
    RemoteMobileTweezers,
    RemoteStaticTweezers,
)
from labseq_remote.settings import RemoteSettings, RemoteSimulationSettings
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
from tests.remote.proxy import PROXY, Proxy

_port = 0


@pytest.fixture(scope="module", autouse=True)
def _rough_network(server: Served) -> Generator[None]:
    global _port
    _port = server.port
    proxy = Proxy(server, is_rough=True)
    yield
    proxy.end()


def settings(device: str) -> RemoteSettings:
    about = {"address": f"tcp://{PROXY}:{_port}", "device": device, "simulated": True}
    return RemoteSettings.model_validate(about)


def with_simulation(context: Context) -> Context:
    settings = RemoteSimulationSettings(address=f"tcp://127.0.0.1:{_port}")
    context = replace(context, grid=SiteGrid(6, 7))
    return replace(context, simulation=RemoteSimulation(settings, replace(context, name="simulation")))


class TestRemoteCamera(CameraContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteCamera]:
        return lambda context: RemoteCamera(settings("camera"), context)


class TestRemoteStaticTweezers(StaticTweezersContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteStaticTweezers]:
        return lambda context: RemoteStaticTweezers(settings("static_tweezers"), context)


@pytest.fixture(scope="module")
def _warm() -> None:
    """Compile the kernels; with an empty cache the first call would come late."""
    context = with_simulation(Context("mobile_tweezers", clock=FakeClock()))
    RemoteMobileTweezers(settings("mobile_tweezers"), context).warm()


@pytest.mark.usefixtures("_warm")
class TestRemoteMobileTweezers(MobileTweezersContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteMobileTweezers]:
        return lambda context: RemoteMobileTweezers(settings("mobile_tweezers"), context)


class TestRemoteDevice(DeviceContract):
    commands: ClassVar = {"open": {}, "set": {"power": 0.5}}
    values: ClassVar = ("state", "power")

    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteDevice]:
        return lambda context: RemoteDevice(settings("instrument"), context)


class TestRemoteLines(LinesContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteLines]:
        return lambda context: RemoteLines(settings("lines"), context)


class TestRemoteSimulation(SimulationContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteSimulation]:
        there = RemoteSimulationSettings(address=f"tcp://{PROXY}:{_port}")
        return lambda context: RemoteSimulation(there, context)
