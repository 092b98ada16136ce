"""The labscript device: from the labscript file to the shot file, through a run that edges start.

labscript itself makes folders in the home of the user and starts servers when it is imported, so its classes
are replaced by their documented interface.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import json
import shutil
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import labseq_bridges
import numpy as np
import pytest

import labseq

from .test_labseq_follow_session import FOLLOW, Led
from .test_labseq_ttl_leader import virtual_without_lines

DEVICE = Path(labseq_bridges.__file__).parent / "labscript_device"
LINES = "lines: {use: ttl, go: {busy: 5, ready: 6, failed: 7, simulated_go_delay: 2 s}, channels: {}}"
LEADER = "leader: {use: tcp_leader, port: 0, deadline: 60 s}"
ADDRESS = "planner.degree_of_parallelism"


class LabscriptDevice:
    """`labscript.Device`: connection table properties, and a group in the shot file."""

    def __init__(self, name: str, parent_device: object, connection: object) -> None:
        assert parent_device is connection is None
        self.name = name

    def init_device_group(self, file: h5py.File) -> h5py.Group:
        return file.require_group("devices").create_group(self.name)


def set_passed_properties(property_names: dict[str, list[str]]) -> Callable[[Any], Any]:
    def decorate(init: Any) -> Any:
        @functools.wraps(init)
        def keeping(self: Any, *args: Any, **kwargs: Any) -> None:
            bound = inspect.signature(init).bind(self, *args, **kwargs)
            bound.apply_defaults()
            self.properties = {
                name: bound.arguments[name] for name in property_names["connection_table_properties"]
            }
            init(self, *args, **kwargs)

        return keeping

    return decorate


class DeviceTab:
    """`blacs.device_base_class.DeviceTab`: notes the worker that is to be started."""

    def create_worker(self, name: str, worker: str, arguments: dict[str, Any]) -> None:
        self.worker = (name, worker, arguments)


def named(path: str) -> Any:
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """The folder among the user's devices, as the page says; device -> tab that BLACS finds."""
    tabs: dict[str, str] = {}
    names: dict[str, dict[str, Any]] = {
        "labscript": {
            "Device": LabscriptDevice,
            "LabscriptError": type("LabscriptError", (Exception,), {}),
            "set_passed_properties": set_passed_properties,
        },
        "labscript_utils": {},
        "labscript_utils.h5_lock": {},
        "labscript_devices": {
            "register_classes": lambda name, BLACS_tab, runviewer_parser: tabs.update({name: BLACS_tab})  # noqa: N803
        },
        "blacs": {},
        "blacs.device_base_class": {"DeviceTab": DeviceTab},
        "blacs.tab_base_classes": {"Worker": object},
    }
    for name, contents in names.items():
        module = types.ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    user_devices = tmp_path / "userlib" / "user_devices"
    shutil.copytree(DEVICE, user_devices / "labseq", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.syspath_prepend(str(user_devices.parent))
    for name in [name for name in sys.modules if name.startswith("user_devices")]:
        monkeypatch.delitem(sys.modules, name)
    spec = importlib.util.spec_from_file_location(
        "register_classes", user_devices / "labseq/register_classes.py"
    )
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))  # as BLACS does, outside its package
    return tabs


def compiled(path: Path, port: int, values: dict[str, Any]) -> Any:
    """A labscript file with the device, compiled to a shot file."""
    device = named("user_devices.labseq.labscript_devices.Labseq")("labseq", port=port)
    for address, value in values.items():
        device.set_value(address, value)
    with h5py.File(path, "w") as file:
        device.generate_code(file)
    return device


def test_values_go_to_labseq_and_occupancies_to_the_shot_file(
    installed: dict[str, str], tmp_path: Path
) -> None:
    tab = named(installed["Labseq"])()
    tab.initialise_workers()
    _, worker_path, _ = tab.worker
    profile = tmp_path / "led.yaml"
    virtual = virtual_without_lines().replace("\ndevices:\n", f"\ndevices:\n  {LEADER}\n")
    profile.write_text(f"{virtual}\n{LINES}\n")
    sequence = tmp_path / "s.yaml"
    text = FOLLOW.read_text().replace("profile: follower", "profile: ./led.yaml")
    sequence.write_text(f"{text}\nleader: {{may_set: [{ADDRESS}]}}\n")
    refused: list[str] = []
    files = [tmp_path / f"{number}.h5" for number in range(2)]

    def lead(address: str) -> None:
        port = int(address.rpartition(":")[2])
        worker = named(worker_path)()
        for file, tweezers in zip(files, (3, 5), strict=True):
            device = compiled(file, port, {ADDRESS: tweezers})
            vars(worker).update(device.properties, device_name="labseq")
            if not hasattr(worker, "_leader"):
                worker.init()
                wrong = tmp_path / "wrong.h5"
                compiled(wrong, port, {"shot.9.hold": 1})
                with pytest.raises(Exception, match=r"shot\.9\.hold") as caught:
                    worker.transition_to_buffered("labseq", str(wrong), {}, fresh=True)
                refused.append(str(caught.value))
                worker.abort_transition_to_buffered()
            worker.transition_to_buffered("labseq", str(file), {}, fresh=True)
            assert worker.transition_to_manual()
        worker.shutdown()

    observer = Led(lead)
    changes = ["shot.0.wait.device=lines", "shot.2.rearrange.cycles=1"]
    options: dict[str, Any] = {"shots": 2, "seed": 1, "output": tmp_path / "data", "observer": observer}
    with labseq.Session.open(sequence, overrides=changes, **options) as session:
        observer.session = session
        done = session.run()
        assert observer.thread is not None
        observer.thread.join()
    assert refused
    assert [shot.parameters[ADDRESS] for shot in done.shots] == [3, 5]
    for path, shot in zip(files, done.shots, strict=True):
        with h5py.File(path, "r") as file:
            group: Any = file["data/labseq"]
            assert group.attrs["is_ready"]
            assert json.loads(group["answer"][()])["shot"] == shot.index
            seen = [group[name][:] for name in sorted(group) if name.startswith("occupancy")]
        assert len(seen) == len(shot.occupancies)
        np.testing.assert_array_equal(seen[-1], shot.occupancies[-1])


def test_a_value_that_no_file_can_hold_is_refused_when_the_shot_is_compiled(
    installed: dict[str, str], tmp_path: Path
) -> None:
    assert installed
    with pytest.raises(Exception, match=r"value of 'shot.1.hold' is <object .*; expected a number"):
        compiled(tmp_path / "shot.h5", 5750, {"shot.1.hold": object()})
