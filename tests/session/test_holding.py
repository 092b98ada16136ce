"""One at a time on the same real devices."""

from __future__ import annotations

import errno
import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.errors import DeviceError
from labseq.recording import lock_files, marker_roots
from labseq.session.profile import resolve_profile
from labseq.session.safe import check_devices, lock_devices, make_profile_safe
from labseq.testing.fakes import RecordingObserver

from .small_runs import OWN_DEVICE, PROFILE

SEQUENCE = """
labseq: 1
name: look
profile: ./p.yaml
shots: 2
target: {pattern: compact, rows: 2, cols: 2}
shot:
  - load: {duration: 1 ms}
  - image: {}
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plugins").mkdir()
    Path("plugins/mine.py").write_text(OWN_DEVICE, encoding="utf-8")
    Path("s.yaml").write_text(SEQUENCE, encoding="utf-8")
    write("mine")


def write(shutter: str) -> None:
    own = f"plugin_folders: [plugins]\ndevices: {{shutter: {{use: {shutter}}}}}\n"
    Path("p.yaml").write_text(PROFILE + own, encoding="utf-8")


@pytest.fixture
def held() -> Generator[None]:
    with lock_devices(resolve_profile("./p.yaml"), marker_roots(Path("data")), "the run x", pytest.fail):
        yield


def run(observer: RecordingObserver | None = None, **options: Any) -> labseq.Run:
    with labseq.Session.open("s.yaml", observer=observer, **options) as session:
        return session.run()


def test_a_second_run_is_refused_with_the_name_of_the_first(held: None) -> None:
    with pytest.raises(
        DeviceError, match=r"bench: its devices are in use by the run x \(process \d+ on .*\)"
    ) as e:
        run(output="elsewhere")
    assert "labseq stop" in str(e.value)
    assert not Path("elsewhere").exists()


def test_the_devices_are_free_after_a_run_and_after_one_that_failed() -> None:
    run()
    with lock_devices(resolve_profile("./p.yaml"), marker_roots(Path("data")), "me", pytest.fail):
        pass
    Path("plugins/mine.py").write_text(
        OWN_DEVICE.replace("open(self): pass", "open(self): 1 / 0"), encoding="utf-8"
    )
    with pytest.raises(DeviceError):
        run()
    with lock_devices(resolve_profile("./p.yaml"), marker_roots(Path("data")), "me", pytest.fail):
        pass


def test_a_run_locks_its_devices_with_its_name() -> None:
    class Looking(RecordingObserver):
        reported = ""

        def event(self, name: str, values: object) -> None:
            if name == "run_started":
                with pytest.raises(DeviceError) as caught:
                    check_devices("./p.yaml")
                self.reported = str(caught.value)

    looking = Looking()
    done = run(looking)
    assert f"in use by the run {done.path} (process {os.getpid()} on " in looking.reported


def test_devices_are_not_tested_while_they_are_in_use(held: None) -> None:
    with pytest.raises(DeviceError, match="bench: its devices are in use by the run x"):
        check_devices("./p.yaml")
    assert check_devices("./p.yaml", dry_run="fast").devices  # it touches none
    assert not Path("data").exists()


def test_devices_are_made_safe_even_while_they_are_in_use(held: None) -> None:
    seen = RecordingObserver()
    assert not make_profile_safe("./p.yaml", observer=seen).failures
    assert [v["text"][:39] for v in seen.of("warning")] == ["its devices are in use by the run x (pr"]


def test_simulated_devices_and_dry_runs_are_not_locked(held: None) -> None:
    assert run(dry_run="full").status == "complete"
    write("virtual")
    assert run().status == "complete"
    assert check_devices("./p.yaml").devices


def test_a_folder_without_locks_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    Path("data").mkdir()
    seen = RecordingObserver()
    assert run(seen).status == "complete"
    texts = [values["text"] for values in seen.of("warning")]
    folder = lock_files(marker_roots(Path("data")), "x")[0].parent
    assert texts[0].startswith(
        f"the folder {folder} does not support file locks: nothing keeps a run on another"
    )
    assert "no file could be locked: nothing keeps another run from the same devices" in texts
