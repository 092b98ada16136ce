"""Alarms: each sign that the machine does not see or move atoms, alone and in runs."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labseq_virtual.camera import VirtualCamera
from labseq_virtual.simulation import VirtualSimulation

import labseq
from labseq.config.profile import AlarmSettings
from labseq.errors import AlarmError
from labseq.model import Frame, ImageRecord, ShotRecord
from labseq.sequencer.clock import CLOCK_SET, ClockJumps
from labseq.session.alarms import Alarms
from labseq.testing.fakes import RecordingObserver

from .small_runs import PROFILE
from .whole_runs import SMALL_FRAMES

RNG = np.random.default_rng(7)
SHAPE = (40, 40)


def frame(noise: float = 5.0) -> np.ndarray[Any, Any]:
    return RNG.normal(500.0, noise, (40, 40)).astype(np.uint16)


def image(n_atoms: int = 1200, confidence: float = 1.0, counts: Any = None) -> ImageRecord:
    occupancy = (np.arange(1600) < n_atoms).reshape(SHAPE)
    pixels = Frame(frame() if counts is None else counts, 0.01, 0.0)
    return ImageRecord(pixels, occupancy, np.full(SHAPE, confidence, np.float32), 1, -1, 0.0, 0.01)


class Watched:
    """Alarms whose warnings are kept, of shots that a test makes."""

    def __init__(self, **settings: Any) -> None:
        self.warnings: list[str] = []
        self.alarms = Alarms(AlarmSettings(**settings), lambda _, text: self.warnings.append(text))
        self.n = 0

    def shot(self, *images: ImageRecord, status: Any = "complete", readings: Any = ()) -> list[str]:
        """Look at a shot; returns the names of the alarms that began."""
        record, n_before = ShotRecord(self.n, 0, 1, ""), len(self.warnings)
        record.images, record.status, record.readings = list(images), status, dict(readings)
        self.n += 1
        self.alarms.look(record)
        return [text.split("'")[1] for text in self.warnings[n_before:]]


@pytest.mark.parametrize(
    ("bad", "names"),
    [
        (image(counts=np.full((40, 40), 65535, np.uint16)), ["saturated"]),
        (image(counts=np.minimum(frame(50.0), 550)), ["saturated"]),
        (image(0), ["atoms"]),
        (image(1600), ["full"]),
        (image(confidence=0.98), ["confidence"]),
    ],
)
def test_one_image_gives_its_alarm(bad: ImageRecord, names: list[str]) -> None:
    watched = Watched()
    assert watched.shot(image(), image()) == []
    assert watched.shot(bad) == names
    assert watched.shot(image()) == []


def test_an_old_frame_is_an_alarm() -> None:
    watched, pixels = Watched(), frame()
    assert watched.shot(image(counts=pixels)) == []
    assert watched.shot(image(counts=pixels.copy())) == ["frozen"]
    assert watched.shot(image(), image()) == []


def test_a_loading_far_below_its_mean_is_an_alarm() -> None:
    watched = Watched(stop_after=12)
    for n_atoms in (1200, 1180, 1220, 1210, 1190, 1230, 1200, 1170, 1200):
        assert watched.shot(image(n_atoms)) == []
    assert watched.shot(image(590)) == []  # nine shots are too few to compare with
    assert watched.shot(image(560)) == ["loading"]
    assert watched.shot(image(580)) == []
    for _ in range(12):  # the mean is that of the shots before the failure, however long it lasts
        watched.shot(image(400))
    with pytest.raises(AlarmError, match=r"'loading' in 12 shots in a row"):
        watched.alarms.raise_if_lasting()


@pytest.mark.parametrize(("n_sites", "loading"), [(1, 0.5), (9, 0.3), (25, 0.9), (100, 0.75), (400, 0.2)])
def test_chance_alone_gives_no_alarm_in_a_thousand_shots(n_sites: int, loading: float) -> None:
    watched, rng = Watched(), np.random.default_rng(3)
    for n_shot in range(1000):
        occupancy = rng.random((1, n_sites)) < loading
        # the doubt of a detector that is right at 99.9 % of the sites
        doubt = np.where(rng.random((1, n_sites)) < 4e-3, rng.random((1, n_sites)), 0.0).astype(np.float32)
        seen = ImageRecord(None, occupancy, 1 - doubt, 1, -1, 0.0, 0.01)
        assert watched.shot(seen) == [], n_shot


def test_few_sites_are_judged_over_several_shots() -> None:
    dark = ImageRecord(None, np.zeros((3, 3), bool), np.zeros((3, 3), np.float32), 1, -1, 0.0, 0.01)
    watched = Watched()
    began = [watched.shot(dark) for _ in range(112)]
    assert (began[11], began[111]) == (["atoms"], ["confidence"])
    assert began.count([]) == 110
    assert "0 atoms on the first image, at 108 sites, in the last 12 shots" in watched.warnings[0]


def test_sleep_and_a_clock_that_is_set_are_readings_of_the_shot_that_saw_them_and_alarms() -> None:
    wall_s, monotonic_s, boot_s = 1e9, 100.0, 100.0
    jumps = ClockJumps(lambda: wall_s, lambda: monotonic_s, lambda: boot_s)
    wall_s, monotonic_s, boot_s = wall_s + 30.5, monotonic_s + 30.0, boot_s + 30.0  # a shot; the clock drifts
    assert jumps.since_last() == {}
    wall_s, boot_s = wall_s + 3600.0, boot_s + 3600.0
    slept = jumps.since_last()
    assert slept == {"computer.slept_s": 3600.0}
    wall_s -= 7200.0
    was_set = jumps.since_last()
    assert was_set == {"computer.clock_set_s": -7200.0}
    assert jumps.since_last() == {}
    watched = Watched()
    for readings, words in ((slept, "slept for 3600 s"), ({}, ""), (was_set, "jumped by -7200 s")):
        assert watched.shot(image(), readings=readings) == ["clock"] * bool(readings)
        assert words in "".join(watched.warnings[-1:])


def test_an_alarm_warns_once_and_ends_the_run_after_some_shots_in_a_row() -> None:
    watched = Watched(stop_after=3)
    for _ in range(2):
        watched.shot(image(0))
        watched.alarms.raise_if_lasting()
    watched.shot(image(0), status="failed")  # does not count
    watched.alarms.raise_if_lasting()
    watched.shot(image(0))
    assert len(watched.warnings) == 1
    with pytest.raises(AlarmError, match=r"alarm 'atoms' in 3 shots in a row .*: 0 atoms on the first image"):
        watched.alarms.raise_if_lasting()


def test_every_limit_can_be_switched_off() -> None:
    off: dict[str, Any] = {"saturated": 1, "frozen": False, "atoms": 0, "full": 0, "confidence": 0}
    watched, pixels = Watched(**off), np.full((40, 40), 65535, np.uint16)
    assert watched.shot(image(0, 0.5, pixels), image(1600, 0.5, pixels)) == []


def run(tmp_path: Path, n_shots: int, *overrides: str) -> tuple[list[str], BaseException | None, Path]:
    observer, error = RecordingObserver(), None
    with labseq.Session.open(
        "sequences/compact_225.yaml",
        shots=n_shots,
        seed=3,
        overrides=[*SMALL_FRAMES, "shot.2.rearrange.cycles=1", *overrides],
        output=tmp_path,
        observer=observer,
    ) as session:
        try:
            session.run()
        except AlarmError as failure:
            error = failure
        assert session.run_dir is not None
    warnings = [values["text"] for name, values in observer.events if name == "warning"]
    return [text for text in warnings if "alarm" in text], error, session.run_dir


def test_a_good_run_has_no_alarm(tmp_path: Path) -> None:
    assert run(tmp_path, 20)[:2] == ([], None)


def test_a_run_without_atoms_ends_and_can_be_resumed(tmp_path: Path) -> None:
    warnings, error, folder = run(
        tmp_path, 12, "profile.simulation.loading=0%", "profile.alarms.stop_after=4"
    )
    assert [text.split("'")[1] for text in warnings] == ["atoms"]
    assert isinstance(error, AlarmError)
    assert error.exit_code == 3
    stopped = labseq.open_run(folder)
    assert (len(stopped.shots), stopped.status) == (4, "failed")
    assert "alarm 'atoms' in 4 shots in a row" in stopped.error


def test_moved_atoms_that_do_not_arrive_are_an_alarm(tmp_path: Path) -> None:
    """Tweezers so fast that they leave their atoms behind, on sites that then look as if others had come."""
    warnings, _, _ = run(tmp_path, 3, "profile.mobile_tweezers.speed=2000 um/ms")
    assert any("'arrived'" in text and "atoms arrived on sites that were empty" in text for text in warnings)


ONE_IMAGE = """labseq: 1
name: seen
profile: ./p.yaml
shots: 14
seed: 1
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
"""


class Broken:
    """A lab that breaks after ten shots, in the way that an alarm is for."""

    def __init__(self, alarm: str, patch: pytest.MonkeyPatch) -> None:
        self.n, self.first = 0, None
        read, load, look = VirtualCamera.read, VirtualSimulation.load, Alarms.look

        def read_frame(camera: VirtualCamera, timeout_s: float) -> Frame:
            seen = read(camera, timeout_s)
            self.first = self.first or seen
            pixels = {"saturated": np.full_like(seen.image, 65535), "frozen": self.first.image}
            return replace(seen, image=pixels.get(alarm, seen.image)) if self.n >= 10 else seen

        def load_atoms(simulation: VirtualSimulation, *times: float) -> None:
            if self.n < 10 or alarm != "loading":
                load(simulation, *times)

        def count(alarms: Alarms, shot: ShotRecord) -> None:
            look(alarms, shot)
            self.n += 1

        def jumps(_: ClockJumps) -> dict[str, float]:
            return {CLOCK_SET: 3600.0} if self.n == 10 and alarm == "clock" else {}

        patch.setattr(ClockJumps, "since_last", jumps)
        patch.setattr(VirtualCamera, "read", read_frame)
        patch.setattr(VirtualSimulation, "load", load_atoms)
        patch.setattr(Alarms, "look", count)


@pytest.mark.parametrize(
    ("alarm", "overrides"),
    [
        ("saturated", ["profile.alarms.full=0", "profile.alarms.frozen=false"]),
        ("frozen", []),
        ("loading", ["profile.alarms.atoms=0"]),
        ("clock", []),
        ("full", ["profile.simulation.loading=100%"]),
        ("confidence", ["profile.detector.width=1000", "shots=40"]),
        ("confidence", ["profile.simulation.image.em_gain=200", "shots=40"]),
    ],
)
def test_a_run_that_breaks_gives_its_alarm_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, alarm: str, overrides: list[str]
) -> None:
    (tmp_path / "p.yaml").write_text(PROFILE, encoding="utf-8")
    (tmp_path / "seen.yaml").write_text(ONE_IMAGE, encoding="utf-8")
    Broken(alarm, monkeypatch)
    observer = RecordingObserver()
    with (
        labseq.Session.open(
            tmp_path / "seen.yaml", overrides=overrides, observer=observer, output=tmp_path
        ) as session,
        suppress(AlarmError),
    ):
        session.run()
    warnings = [values["text"] for name, values in observer.events if name == "warning"]
    assert [text.split("'")[1] for text in warnings if "alarm" in text] == [alarm]
