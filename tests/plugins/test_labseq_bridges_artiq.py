"""The ARTIQ controller beside a run, with sipyco if it is installed, and its example experiment."""

from __future__ import annotations

import importlib.util
import sys
import threading
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from labseq_bridges import artiq_controller

from tests.remote.conftest import free_port

from . import labseq_sipyco_simulator
from .labseq_follow_rig import MAX_WAIT_S
from .test_labseq_follow_session import run_led

ONE_CYCLE = "shot.2.rearrange.cycles=1"


@pytest.fixture
def sipyco(monkeypatch: pytest.MonkeyPatch) -> Any:
    if importlib.util.find_spec("sipyco") is None:
        for name in ("sipyco", "sipyco.pc_rpc", "sipyco.common_args"):
            monkeypatch.setitem(sys.modules, name, labseq_sipyco_simulator)
        monkeypatch.setattr(labseq_sipyco_simulator, "common_args", labseq_sipyco_simulator, raising=False)
    return sys.modules.get("sipyco.pc_rpc") or importlib.import_module("sipyco.pc_rpc")


class Controlled:
    """A controller in a thread, and clients of it."""

    def __init__(self, pc_rpc: Any, address: str, port: int) -> None:
        self.pc_rpc, self.port = pc_rpc, port
        options = ["-p", str(port), "--labseq-port", address.rpartition(":")[2]]
        self.thread = threading.Thread(target=artiq_controller.main, args=(options,))
        self.thread.start()
        self._clients: list[Any] = []

    def client(self) -> Any:
        for _ in range(1000):
            try:
                client = self.pc_rpc.Client("127.0.0.1", self.port, "labseq")
            except ConnectionRefusedError:
                self.thread.join(0.01)
            else:
                self._clients.append(client)
                return client
        raise AssertionError("the controller does not listen")

    def end(self) -> None:
        self._clients[0].terminate()
        for client in self._clients:
            client.close_rpc()
        self.thread.join(MAX_WAIT_S)


@pytest.fixture
def controlled(sipyco: Any) -> Callable[[str], Controlled]:
    return lambda address: Controlled(sipyco, address, free_port())


def test_a_client_of_the_controller_leads_a_run(
    controlled: Callable[[str], Controlled], tmp_path: Path
) -> None:
    came: list[Any] = []

    def lead(address: str) -> None:
        controller = controlled(address)
        labseq = controller.client()
        with pytest.raises(RuntimeError, match="call go"):
            labseq.wait()
        came.extend([labseq.ping(), labseq.go("run 17"), labseq.wait(), labseq.occupancy(0), labseq.wait()])
        with pytest.raises(LookupError, match="no image 'third'"):
            labseq.occupancy("third")
        labseq.go()
        other = controller.client()
        aborting = threading.Timer(0.05, lambda: came.append(other.abort()))
        aborting.start()
        came.append(labseq.wait())
        aborting.join()
        labseq.go("after an abort")
        came.append(labseq.wait())
        controller.end()

    done = run_led(lead, tmp_path, "shot.2.rearrange.cycles=3", "attempts=1", shots=2)
    first, second = done.shots
    ping, go, answer, before, again, *aborted, last = came
    assert (ping, go, again["shot"]) == (True, None, 0)
    assert answer["after"] == first.occupancies[-1].astype(int).tolist()
    assert answer["before"] == before == first.occupancies[0].astype(int).tolist()
    assert (answer["is_ready"], Path(answer["file"])) == (True, first.file)
    assert [("aborted" in each["reason"], each["is_ready"]) for each in aborted] == [(True, False)] * 2
    assert (last["is_ready"], last["shot"], second.readings["leader.go"]) == (True, 1, ["after an abort"])


def artiq_of(client: Any, calls: list[str]) -> tuple[types.ModuleType, type]:
    """ARTIQ's names for an experiment without a core device: kernels run as the Python that they are."""

    class Device:
        def __init__(self, name: str) -> None:
            self._name = name

        def __getattr__(self, method: str) -> Callable[[], None]:
            return lambda: calls.append(f"{self._name}.{method}")

    class Environment:
        def __init__(self) -> None:
            self.datasets: dict[str, Any] = {}

        def setattr_device(self, name: str) -> None:
            setattr(self, name, client if name == "labseq" else Device(name))

        def set_dataset(self, name: str, value: Any) -> None:
            self.datasets[name] = value

    experiment = types.ModuleType("artiq.experiment")
    names = {"EnvExperiment": Environment, "TInt32": int, "TList": lambda of: list[of], "ms": 1e-3}
    vars(experiment).update(names, kernel=lambda method: method, delay=lambda _: calls.append("delay"))
    return experiment, Environment


def test_the_example_experiment_branches_on_the_occupancy(
    controlled: Callable[[str], Controlled], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    ended: list[Any] = []

    def lead(address: str) -> None:
        controller = controlled(address)
        experiment, _ = artiq_of(controller.client(), calls)
        monkeypatch.setitem(sys.modules, "artiq", types.ModuleType("artiq"))
        monkeypatch.setitem(sys.modules, "artiq.experiment", experiment)
        from labseq_bridges.artiq_experiment import Rearranged

        example: Any = Rearranged()
        example.build()
        example.n_shots = 2
        example.prepare()
        example.least = 223
        example.run()
        example.analyze()
        ended.append(example)
        controller.end()

    done = run_led(lead, tmp_path, ONE_CYCLE, shots=2)
    (example,) = ended
    filled = [round(225 * shot.filling_fraction) for shot in done.shots]
    assert example.datasets["n_atoms"] == filled
    n_science = sum(n >= example.least for n in filled)
    assert (example.datasets["n_science"], calls.count("ttl_science.on")) == (n_science, n_science)
