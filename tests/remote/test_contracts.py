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
from labseq_remote.settings import RemoteSettings

import labseq.remote.drivers
from labseq.plugin import Clock, Context, SiteGrid
from labseq.testing import (
    CameraContract,
    DeviceContract,
    LinesContract,
    MobileTweezersContract,
    StaticTweezersContract,
)
from labseq.testing.fakes import FakeClock
from tests.remote.conftest import Served
from tests.remote.proxy import PROXY, Proxy

_port = 0
_clock: Clock = FakeClock()


@pytest.fixture(scope="module", autouse=True)
def _rough_network(server: Served) -> Generator[None]:
    global _port
    _port = server.port
    proxy = Proxy(server, is_rough=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(labseq.remote.drivers, "RealClock", lambda _: _clock)
        yield
    proxy.end()


def settings(device: str) -> RemoteSettings:
    about = {"address": f"tcp://{PROXY}:{_port}", "device": device}
    return RemoteSettings.model_validate(about)


def shared(context: Context) -> Context:
    """A context whose virtual clock the served driver has, too; that of a lab keeps real time."""
    global _clock
    _clock = context.clock
    return replace(context, grid=SiteGrid(6, 7))


class TestRemoteCamera(CameraContract):
    def context(self) -> Context:
        return shared(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteCamera]:
        return lambda context: RemoteCamera(settings("camera"), context)


class TestRemoteStaticTweezers(StaticTweezersContract):
    def context(self) -> Context:
        return shared(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteStaticTweezers]:
        return lambda context: RemoteStaticTweezers(settings("static_tweezers"), context)


@pytest.fixture(scope="module")
def _warm() -> None:
    """Compile the kernels; with an empty cache the first call would come late."""
    context = shared(Context("mobile_tweezers", clock=FakeClock()))
    RemoteMobileTweezers(settings("mobile_tweezers"), context).warm()


@pytest.mark.usefixtures("_warm")
class TestRemoteMobileTweezers(MobileTweezersContract):
    def context(self) -> Context:
        return shared(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteMobileTweezers]:
        return lambda context: RemoteMobileTweezers(settings("mobile_tweezers"), context)


class TestRemoteDevice(DeviceContract):
    commands: ClassVar = {"open": {}, "set": {"power": 0.5}}
    values: ClassVar = ("state", "power")

    def context(self) -> Context:
        return shared(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteDevice]:
        return lambda context: RemoteDevice(settings("instrument"), context)


class TestRemoteLines(LinesContract):
    def context(self) -> Context:
        return shared(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], RemoteLines]:
        return lambda context: RemoteLines(settings("lines"), context)
