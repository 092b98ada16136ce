"""The driver works around the faults of ``spcm`` 1.13 and the manners of the card, one test for each."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from labseq_spcm.card import AwgCard
from labseq_spcm.dds_program import ENTRY, TYPE_INT64
from labseq_spcm.library import load_spcm
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.simulator import SimulatedCard, ToneSpan, installed, vendor_library_found

from labseq import Context, DeviceError, LabseqError, MotionSpec, Plan
from labseq.motion import tone_program
from labseq.testing.fakes import FakeClock

AMP0, TIMEOUT, TRIG_ORMASK = 30010, 295130, 40410
DDS_CMD, CORES_ON_CH1, TRG_COUNT = 608003, 608041, 608013
EXEC_AT_TRG, WRITE_TO_CARD = 2, 8


@dataclass
class Machine:
    tweezers: SpcmMobileTweezers
    simulated: SimulatedCard
    motion: MotionSpec

    @property
    def card(self) -> AwgCard:
        card = self.tweezers._card
        assert card is not None
        return card

    def play(self, n_batches: int = 1) -> None:
        moves: list[Any] = [([(0, 0)], [(0, 3)])] * n_batches
        duration_s = self.tweezers.prepare(tone_program(Plan.from_batches(moves), motion=self.motion))
        self.tweezers.play()
        self.tweezers.wait(duration_s + 1.0)

    def written(self, register: int) -> list[float]:
        return [entry.value for entry in self.simulated.log if entry.register == register]


@contextmanager
def machine(mode: str = "dds", tones: tuple[int, int] = (16, 5)) -> Generator[Machine]:
    clock = FakeClock()
    simulated = SimulatedCard(clock)
    motion = MotionSpec(max_row_tones=tones[0], max_column_tones=tones[1])
    with installed(simulated) as name:
        settings = SpcmSettings.model_validate({"card": name, "mode": mode})
        tweezers = SpcmMobileTweezers(settings, Context("mobile_tweezers", clock=clock, motion=motion))
        tweezers.open()
        try:
            yield Machine(tweezers, simulated, motion)
        finally:
            tweezers.close()


@pytest.fixture
def unraisable(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """What finalizers raise."""
    seen: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda raised: seen.append(raised.exc_value))
    return seen


class TestFaultsOfThePackage:
    def test_a_closed_card_is_not_closed_again_by_the_garbage_collector(
        self, unraisable: list[object]
    ) -> None:
        with machine():
            pass
        gc.collect()
        assert not unraisable

    def test_a_card_with_an_error_pending_is_closed_in_silence(self, unraisable: list[object]) -> None:
        with machine() as lab:
            lab.simulated.write(AMP0, 9000)
        gc.collect()
        assert not unraisable

    def test_a_card_that_was_not_found_is_forgotten_in_silence(self, unraisable: list[object]) -> None:
        with machine():
            other = SpcmMobileTweezers(SpcmSettings(card="simulated-none"), Context(clock=FakeClock()))
            with pytest.raises(DeviceError):
                other.open()
        gc.collect()
        assert not unraisable

    def test_register_lists_longer_than_1024_entries_are_written_whole(self) -> None:
        with machine() as lab:
            entries = np.zeros(3000, ENTRY)
            entries["register"], entries["type"] = TIMEOUT, TYPE_INT64
            entries["value"] = np.arange(3000)
            lab.card.write_list(entries, "many values")
            assert lab.written(TIMEOUT)[-3000:] == list(range(3000))

    def test_two_cards_in_one_process_keep_their_own_cores(self) -> None:
        with machine(tones=(20, 1)) as first, machine(tones=(16, 5)) as second:
            first.play()
            second.play()
            for lab, core in ((first, 20), (second, 8)):
                (span, *_) = lab.simulated.played(1)
                assert isinstance(span, ToneSpan)
                assert [tone.core for tone in span.tones] == [core]

    def test_commands_are_sent_in_whole_blocks(self) -> None:
        with machine() as lab:
            lab.play(100)
            commands = [(e.register, e.value) for e in lab.simulated.log if e.register >= 603000]
            sent = [i for i, command in enumerate(commands) if command == (DDS_CMD, WRITE_TO_CARD)]
            assert len(sent) > 5
            assert all(commands[i - 1] == (DDS_CMD, EXEC_AT_TRG) for i in sent)

    def test_no_more_commands_are_sent_than_the_queue_has_room_for(self) -> None:
        with machine() as lab:
            moves: list[Any] = [([(0, 0)], [(0, 3)])] * 200
            lab.tweezers.prepare(tone_program(Plan.from_batches(moves), motion=lab.motion))
            n_sent = sum(603000 <= e.register < DDS_CMD for e in lab.simulated.log)
            assert 3000 < n_sent < 4100
            lab.simulated.log.clear()
            lab.tweezers.play()
            lab.tweezers.wait(1.0)
            assert sum(603000 <= e.register < DDS_CMD for e in lab.simulated.log) > 3000

    def test_the_package_is_imported_when_warming_and_prints_nothing(self) -> None:
        code = """
import sys
from labseq import Context, MotionSpec
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
motion = MotionSpec(max_row_tones=16, max_column_tones=4)
tweezers = SpcmMobileTweezers(SpcmSettings(card="simulated", mode="dds"), Context(motion=motion))
assert "spcm" not in sys.modules
tweezers.warm()
assert "spcm" in sys.modules
tweezers.open()
tweezers.close()
"""
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


class TestMannersOfTheCard:
    def test_a_refused_value_is_an_error_and_the_next_call_works(self) -> None:
        with machine() as lab:
            with pytest.raises(DeviceError, match=r"amplitude = 9000: .*SPC_AMP0"):
                lab.card.write(AMP0, 9000, "amplitude")
            assert lab.card.set(AMP0, 1600, "amplitude") == 1600

    def test_a_snapped_mask_is_noticed(self) -> None:
        with machine() as lab, pytest.raises(DeviceError, match="was set to 1, and the card reads"):
            lab.card.set(CORES_ON_CH1, 1, "cores of output 1")

    @pytest.mark.parametrize("mode", ["replay", "fifo", "dds"])
    def test_the_cards_own_software_trigger_is_never_used(self, mode: str) -> None:
        with machine(mode) as lab:
            lab.play()
            assert set(lab.written(TRIG_ORMASK)) == {0}

    def test_the_first_dds_block_is_not_lost_in_run_after_run(self) -> None:
        with machine() as lab:
            for _ in range(3):
                lab.simulated.forget(1e9)
                lab.play()
                spans = lab.simulated.played(1)
                assert spans[-1].end_s - spans[0].start_s == pytest.approx(223.6e-6, abs=0.2e-6)

    def test_the_end_is_not_taken_from_the_queue_that_empties_one_block_early(self) -> None:
        with machine() as lab:
            lab.play()
            assert not [span for span in lab.simulated.played(1) if span.end_s > lab.tweezers._clock.now()]
            assert lab.simulated.read(TRG_COUNT)[1] > 0


class TestWithoutTheLibrary:
    def test_importing_the_plugin_imports_no_spcm(self) -> None:
        code = (
            "import sys, json, labseq_spcm, labseq_spcm.mobile_tweezers\n"
            "from labseq.registry import Registry\n"
            "labseq_spcm.labseq_register(Registry())\n"
            "names = ('spcm', 'spcm_core', 'labseq_spcm.simulator', 'numba', 'matplotlib')\n"
            "print(json.dumps([name for name in names if name in sys.modules]))"
        )
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert json.loads(run.stdout) == []

    @pytest.mark.skipif(vendor_library_found(), reason="the vendor's library is installed here")
    @pytest.mark.parametrize("after_a_simulated_card", [False, True])
    def test_opening_names_the_package_and_the_simulated_card(self, after_a_simulated_card: bool) -> None:
        code = (
            "import sys\n"
            "from labseq import Context, LabseqError\n"
            "from labseq_spcm.mobile_tweezers import SpcmMobileTweezers\n"
            "from labseq_spcm.settings import SpcmSettings\n"
            "for card in sys.argv[1:]:\n"
            "    tweezers = SpcmMobileTweezers(SpcmSettings(card=card), Context('mobile_tweezers'))\n"
            "    try:\n"
            "        tweezers.open()\n"
            "    except LabseqError as error:\n"
            "        print(error.exit_code, error)\n"
            "    tweezers.close()\n"
        )
        cards = ["simulated"] if after_a_simulated_card else []
        run = subprocess.run(
            [sys.executable, "-c", code, *cards, "/dev/spcm0"], capture_output=True, text=True, check=True
        )
        assert run.stdout.startswith("3 mobile_tweezers: the Python package 'spcm' finds no driver library")
        assert "`card: simulated`" in run.stdout
        assert not run.stderr


def test_a_package_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "spcm", None)
    with pytest.raises(
        DeviceError, match=r"'spcm' cannot be imported .* `pip install spcm`; .* `card: simulated`"
    ):
        load_spcm("mobile_tweezers")


def test_closing_goes_through_even_if_the_card_is_broken() -> None:
    with machine("replay") as lab:
        lab.simulated.break_down("for this test")
        lab.tweezers.close()
        with pytest.raises(LabseqError, match="not open"):
            lab.tweezers.play()
