"""The first contact with a Spectrum card, on simulated cards that differ from what the driver assumes."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from labseq_spcm.first_contact import SpcmFirstContact
from labseq_spcm.first_contact_verdict import judge
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm_sim import (
    M4I6631,
    CardModel,
    Faults,
    SampleSpan,
    SimulatedCard,
    card_with,
    installed,
    setup,
)
from labseq_spcm_sim.faults import MANUAL_SPEEDS

from labseq.drivers.first_contact import write_contact
from labseq.plugin import ConfigError, Context, DeviceError, DeviceTimeoutError
from labseq.testing.fakes import FakeClock

from .card_process import PLUGIN, TweezersOfProcess
from .card_process_emergency import Connection
from .labseq_soapy_rig import until
from .small_run import write

RATE_HZ = 624e6
BLOCK_S = 65536 / 4 / RATE_HZ


@dataclass
class Lab:
    """A contact with a simulated card on a virtual clock."""

    contact: SpcmFirstContact
    card: SimulatedCard
    clock: FakeClock

    def take(self, *names: str) -> dict[str, Any]:
        """The results of steps; each leaves the card as ``safe_state`` does."""
        results: dict[str, Any] = {}
        for step in self.contact.steps:
            if step.name in names:
                results[step.name] = dict(step.run())
                self.contact.safe_state()
                assert not self.card.running
                assert not any(self.card.outputs_on)
        return results

    def spans(self) -> list[SampleSpan]:
        return [span for span in self.card.played(0) if span.values().any()]


@contextmanager
def met(
    new_card: Callable[..., SimulatedCard] = SimulatedCard, *, keep_history: bool = False, **settings: Any
) -> Generator[Lab]:
    clock = FakeClock()
    card = new_card(clock, keep_history=keep_history)
    with installed(card) as name:
        chosen = SpcmSettings.model_validate({"card": name, "sample_rate": RATE_HZ, **settings})
        driver = SpcmMobileTweezers(chosen, Context("mobile_tweezers", clock=clock))
        contact = driver.first_contact()
        assert isinstance(contact, SpcmFirstContact)
        contact.open()
        try:
            yield Lab(contact, card, clock)
        finally:
            contact.close()


def with_faults(faults: Faults = Faults(), model: CardModel = M4I6631) -> Callable[..., SimulatedCard]:  # noqa: B008
    return lambda clock, **options: SimulatedCard(clock, faults=faults, model=model, **options)


ALONE = ("identity", "times", "positions", "write_speed", "lag", "sustained", "starve", "threads")
UNSEEN = "the certificate needs the step overwrite with an oscilloscope"


@pytest.mark.parametrize(
    ("faults", "named"),
    [
        (Faults(), ""),
        (Faults(copies_samples=True), "samples are copied when they are handed over, at 8 GB/s"),
        (Faults(position_lag_s=131e-6), "late, longer than a block"),
        (Faults(fifo_short_bytes=4096), "the card's buffer takes 4096 bytes less than its size, 131072"),
        (Faults(pinning_s=1e-3), "naming a transfer buffer takes 1 ms"),
        (Faults(underrun_not_ready=True), "sets OVERRUN (0x400) and not READY"),
        (Faults(write_speeds=MANUAL_SPEEDS), "blocks of 64 KiB are written at 0.464 GB/s"),
    ],
    ids=["none", "copies", "lag", "short", "pinning", "not ready", "slow"],
)
def test_what_a_card_does_otherwise_is_named_and_nothing_else(faults: Faults, named: str) -> None:
    with met(with_faults(faults)) as lab:
        measured = lab.take(*ALONE)
        verdict = lab.contact.judge(measured)
    parts = verdict["reason"].split("; ")
    assert not verdict["stream"], "nobody has looked at the outputs"
    assert UNSEEN in parts
    others = [part for part in parts if part != UNSEEN]
    assert [named in part for part in others][:1] == [True] * bool(named)
    follows = {"the card ran dry after"} if faults.write_speeds else set()
    assert all(any(text in part for text in follows) for part in others[1:])
    if faults.position_lag_s:
        assert measured["lag"]["idle_median_s"] == pytest.approx(131e-6, abs=3e-6)
        assert measured["lag"]["playing_spread_s"] < BLOCK_S, "a constant lag is no variation"


def test_write_speed_is_that_of_the_bus_also_from_the_continuous_buffer() -> None:
    model = replace(M4I6631, continuous_bytes=32 << 20)
    with met(with_faults(Faults(write_speeds=MANUAL_SPEEDS, pinning_s=1e-3), model)) as lab:
        speeds = lab.take("write_speed")["write_speed"]
    assert dict(speeds["user"]) == pytest.approx(dict(MANUAL_SPEEDS), rel=0.01)
    assert [speed for _, speed in speeds["continuous"]] == pytest.approx([2549e6] * 5, rel=0.01)


@pytest.mark.parametrize(
    ("reference_hz", "named"), [(10e6, "and not the sample_rate, 624 MHz"), (0.0, "not lock")]
)
def test_rates_from_a_reference_are_those_that_the_card_makes(reference_hz: float, named: str) -> None:
    model = replace(M4I6631, reference_hz=reference_hz, reference_divider=1)
    with met(with_faults(model=model), reference_clock="10 MHz") as lab:
        result = lab.take("reference")["reference"]
        verdict = lab.contact.judge({"reference": result})
    made = {asked: actual for asked, actual, _ in result["rates"]}
    assert made[620_000_000] == (620_000_000 if reference_hz else 0)
    assert made[624_000_000] != 624_000_000
    assert named in verdict["reason"]


def test_the_option_dds_is_read_where_the_card_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """With figures that others read from an M4i.9622."""
    with met() as lab:
        spcm = lab.contact._bench.card.spcm
        assert "no licence of the option DDS" in lab.take("dds")["dds"]["skipped"]
        option: dict[int, Any] = {
            spcm.SPC_PCIEXTFEATURES: spcm.SPCM_FEAT_EXTFW_DDS20,
            spcm.SPC_DDS_NUM_CORES: 23,
            spcm.SPC_DDS_AVAIL_FREQ_SLOPE_STEP: 2775.5,
        }
        monkeypatch.setitem(setup._RULES, spcm.SPC_CARDMODE, lambda _setup, value: value)
        lab.card._identity.update(option)
        facts = lab.take("dds")["dds"]
    assert (facts["cores"], facts["frequency_slope_step_hz_per_s"]) == (23, 2775.5)
    assert facts["amplitude_slope_step_per_s"] is None, "this card does not tell"


class TestScope:
    """What an oscilloscope shows is read from what the simulated card played."""

    @pytest.mark.parametrize("copies", [False, True])
    def test_bursts_over_silence_appear_unless_samples_are_copied(self, copies: bool) -> None:
        with met(with_faults(Faults(copies_samples=copies)), keep_history=True) as lab:
            measured = lab.take(*ALONE)
            before = len(lab.spans())
            result = lab.take("overwrite")["overwrite"]
            bursts = lab.spans()[before:]
            lengths_s = [span.n_samples / span.sample_rate_hz for span in bursts]
            readings = {"bursts": float(len(bursts)), "shortest_s": min(lengths_s, default=0.0)}
            verdict = lab.contact.judge({**measured, "overwrite": result | readings})
        assert len(bursts) == (0 if copies else 20)
        assert verdict["stream"] is not copies
        unread = {"bursts": readings["bursts"], "shortest_s": None}
        assert not lab.contact.judge({**measured, "overwrite": result | unread})["stream"], "perhaps cut"
        faster = SpcmSettings(sample_rate=625e6, card_buffer=1 << 17)
        later = judge({**measured, "overwrite": result | readings}, faster)
        assert "overwrite measured with another sample_rate" in later["reason"]
        assert not later["stream"], "a certificate is not carried over to other settings"
        if copies:
            assert "0 of 20 bursts" in verdict["reason"]
        else:
            assert {span.amplitude_v for span in bursts} == {0.08}
            assert min(lengths_s) == pytest.approx(BLOCK_S, rel=0.01)

    def test_settings_that_a_stream_refuses_get_no_certificate(self) -> None:
        settings = SpcmSettings(card="simulated", notify_size=1 << 19)
        reason = judge({"dds": {"failed": "refused; try again"}}, settings)["reason"]
        assert reason.endswith("; the step dds failed: refused: try again"), "one line of the page for each"
        assert "card_buffer is 131072: expected at least twice notify_size, 1048576" in reason
        with met(with_faults(Faults(write_speeds=MANUAL_SPEEDS)), sample_rate=320e6) as lab:
            reason = lab.contact.judge(lab.take("write_speed"))["reason"]
        assert "(notify_size 524288 with card_buffer 1048576 is enough)" in reason

    def test_the_trigger_step_plays_at_each_edge_and_its_delay_is_compared(self) -> None:
        with met(keep_history=True) as lab:
            start_s = lab.clock.now()
            edges_s = [start_s + 0.1 + 0.5 * n for n in range(19)]
            for edge_s in edges_s:
                lab.card.trigger_at(edge_s)
            result = lab.take("trigger")["trigger"]
            delay_s = lab.spans()[0].start_s - edges_s[0]
            assert result["played"] == len(edges_s) == len(lab.spans())
            fits = lab.contact.judge({"trigger": {**result, "delay_s": delay_s, "jitter_s": 0.0}})
            late = lab.contact.judge({"trigger": {**result, "delay_s": delay_s + 30e-9, "jitter_s": 0.0}})
        assert "trigger" not in fits["reason"]
        assert "differs from the manual's by 30 ns" in late["reason"]

    def test_without_a_trigger_the_step_says_what_to_check(self) -> None:
        with met() as lab, pytest.raises(DeviceTimeoutError, match="cable at Ext0"):
            lab.take("trigger")

    def test_the_relays_close_five_times_and_nothing_plays(self) -> None:
        with met(keep_history=True) as lab:
            assert lab.take("relay_steps") == {"relay_steps": {"switched": 5}}
            assert not lab.spans()
            register = lab.contact._bench.card.spcm.SPC_ENABLEOUT0
            states = [entry.value for entry in lab.card.log if entry.register == register]
        assert sum(after > before for before, after in itertools.pairwise(states)) == 5

    def test_the_ramp_is_the_drivers_own(self) -> None:
        with met(keep_history=True) as lab:
            result = lab.take("ramp")["ramp"]
            volts = [span.amplitude_v for span in lab.spans()]
        assert result["full_scale_v"] == volts[0]
        assert len({v for v in volts if v < volts[0]}) > 5, "it falls in steps while the tones play"


@pytest.fixture
def outliving(tmp_path: Path) -> Iterator[str]:
    """The path of a card in a process of its own, which is ended afterwards."""
    place = str(tmp_path / "card")
    yield place
    connection = Connection(place)
    connection("power_off")
    connection.close()


def test_a_killed_process_leaves_the_card_running_and_another_one_stops_it(outliving: str) -> None:
    settings = SpcmSettings(card=f"simulated@{outliving}", sample_rate=RATE_HZ)
    contact = TweezersOfProcess(settings, Context("mobile_tweezers")).first_contact()
    assert isinstance(contact, SpcmFirstContact)
    contact.open()
    try:
        (step,) = [step for step in contact.steps if step.name == "second_process"]
        result = step.run()
    finally:
        contact.close()
    assert result["runs_on_after_kill"]
    assert not result["runs_after_off"]
    assert 0 < result["off_by_another_process_s"] < step.limit_s
    instrument = Connection(outliving)
    running, relays = instrument("state")
    instrument.close()
    assert (running, relays) == (False, (False, False))


def test_a_step_that_is_interrupted_while_another_process_has_the_card_leaves_it_off(
    outliving: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = SpcmSettings(card=f"simulated@{outliving}", sample_rate=RATE_HZ)
    contact = TweezersOfProcess(settings, Context("mobile_tweezers")).first_contact()
    assert isinstance(contact, SpcmFirstContact)
    contact.open()
    (step,) = [step for step in contact.steps if step.name == "second_process"]
    with monkeypatch.context() as patch:
        patch.setattr(contact._bench, "pause", lambda _: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            step.run()
    instrument = Connection(outliving)
    assert instrument("state")[0], "the child has played"
    contact.safe_state()
    assert instrument("state") == (False, (False, False))
    contact.close()
    instrument.close()


class TestMeasuredCard:
    def test_does_in_a_dry_run_what_was_measured(self, tmp_path: Path) -> None:
        faults = Faults(True, 131e-6, 4096, 1e-3, True, MANUAL_SPEEDS)
        path = tmp_path / "777.json"
        model = replace(M4I6631, name="M4i.6622-x8", amplitude_mv=(80, 480))
        with met(
            lambda clock, **_: SimulatedCard(clock, faults=faults, model=model, serial_number=777)
        ) as lab:
            identity = {**lab.contact.open(), "simulated": False}
            measured = lab.take(*ALONE)
            first = lab.contact.judge(measured)["reason"]
            write_contact(path, {"schema": 1, "card": identity, "computer": {}, "measured": measured})
        given = SpcmSettings.model_validate({"faults": {"first_contact": path}}).faults
        with met(card_with(given.model_dump())) as lab:
            assert lab.contact.open() == {key: identity[key] for key in lab.contact.open()}
            again = lab.contact.judge(lab.take(*ALONE))["reason"]
            highest_mv = lab.take("identity")["identity"]["highest_amplitude_mv"]
        assert highest_mv == 480
        words = (
            "are copied",
            "late, longer",
            "4096 bytes less",
            "naming a transfer",
            "not READY",
            "0.464 GB/s",
        )
        for word in words:
            assert word in first, word
            assert word in again, word

    def test_refuses_an_edited_file_in_one_line_with_the_remedy(self, tmp_path: Path) -> None:
        path = tmp_path / "777.json"
        write_contact(path, {"schema": 1, "card": {"serial": "777", "model": "M4i.6631-x8"}, "measured": {}})
        path.write_text(path.read_text("utf-8").replace("777", "778"), "utf-8")
        context = Context("mobile_tweezers", clock=FakeClock())
        settings = SpcmSettings.model_validate({"card": "simulated", "faults": {"first_contact": path}})
        with pytest.raises(ConfigError, match=r"digest does not match.*labseq first-contact"):
            SpcmMobileTweezers(settings, context)


def test_another_model_and_a_card_in_use_are_refused() -> None:
    digitizer = replace(M4I6631, name="M4i.4420-x8", card_type=0x74420)
    with (
        pytest.raises(DeviceError, match=r"is a M4i\.4420-x8 .*name a Spectrum"),
        met(with_faults(model=digitizer)),
    ):
        pass
    with met() as lab:
        settings = lab.contact._bench.settings
        context = Context("mobile_tweezers", clock=lab.clock)
        other = SpcmMobileTweezers(settings, context).first_contact()
        with pytest.raises(DeviceError, match=r"in use; .*close other programs"):
            other.open()


def test_the_command_that_is_killed_while_an_output_is_on_leaves_the_card_off(
    outliving: str, tmp_path: Path
) -> None:
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "card.py").write_text(PLUGIN, encoding="utf-8")
    card = f"{{use: spcm_process, card: 'simulated@{outliving}', sample_rate: {RATE_HZ / 1e6:g} MHz}}"
    write(tmp_path, mobile=card)
    with (tmp_path / "p.yaml").open("a", encoding="utf-8") as profile:
        profile.write("plugin_folders: [plugins]\n")
    step = ["--yes", "--with", "scope", "--step", "relay_steps"]
    command = [sys.executable, "-m", "labseq", "first-contact", "./p.yaml", "mobile_tweezers", *step]
    place = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(command, cwd=tmp_path, env=place, stdin=subprocess.DEVNULL) as process:
        instrument: list[Connection] = []

        def outputs_on() -> bool:
            with suppress(OSError, ValueError):
                instrument[:] = instrument or [Connection(outliving)]
            return bool(instrument) and instrument[0]("state")[1] == (True, True)

        until(outputs_on, 120.0)
        process.kill()
    until(lambda: not outputs_on())
    assert instrument[0]("state") == (False, (False, False))
    instrument[0].close()
    assert not list((tmp_path / "data").rglob("*.json")), "nothing was measured"
