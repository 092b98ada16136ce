"""``labseq first-contact``: what it asks, what it writes, and how it ends."""

from __future__ import annotations

import io
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from labseq.cli.first_contact import page_text
from labseq.drivers import first_contact as file
from labseq.drivers.first_contact import read_contact, write_contact
from labseq.safety.first_contact import Contact

PROFILE = """labseq: 1
name: bench
grid: {rows: 4, cols: 4, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold}
simulation: {use: virtual}
devices:
  box: {use: box}
  meter: {use: meter}
plugin_folders: [plugins]
"""
PLUGIN = """
import os, signal, threading

from labseq.plugin import Device, DeviceError, hookimpl
from labseq.plugin.first_contact import ContactStep, FirstContact, Reading

LABSEQ_API = 1
calls = []


class Meter(Device):
    def __init__(self, _settings, _context):
        pass

    def open(self): pass
    def close(self): pass
    def safe_state(self): pass
    def command(self, name, **arguments): pass
    def read(self, name): pass

    def describe(self):
        return {"model": "PM100", "serial_number": "P1/7"}


class Box(Meter):
    def first_contact(self):
        return Contact()


class Contact(FirstContact):
    def __init__(self):
        readings = (Reading("delay_s", "the delay", "time", 0.0, 1e-3),)
        self.is_on = False
        self.steps = (
            ContactStep("fine", "does nothing; outputs off", 5.0, lambda: {"took_s": 1.5}),
            ContactStep("fails", "fails with its output on", 5.0, self.fail),
            ContactStep("hangs", "hangs with its output on", 0.3, self.hang),
            ContactStep("stops", "is stopped by Ctrl-C", 5.0, self.stop),
            ContactStep("seen", "plays", 5.0, lambda: {}, "scope", "a cable", readings),
        )

    def open(self):
        calls.append("open")
        return {"serial": "17", "model": "B1", "driver": "1.0", "firmware": "2"}

    def fail(self):
        self.is_on = True
        raise DeviceError("box", "jammed")

    def hang(self):
        self.is_on = True
        threading.Event().wait()

    def stop(self):
        self.is_on = True
        os.kill(os.getpid(), signal.SIGINT)
        return {}

    def safe_state(self):
        self.is_on = False
        calls.append("safe")

    def close(self):
        assert not self.is_on
        calls.append("close")

    def judge(self, measured):
        return {"reason": ", ".join(measured) or "nothing was measured"}


@hookimpl
def labseq_register(registry):
    registry.device("box", Box)
    registry.device("meter", Meter)
"""
JSON = Path("data/first-contact/17.json")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plugins").mkdir()
    Path("plugins/boxes.py").write_text(PLUGIN, encoding="utf-8")
    Path("p.yaml").write_text(PROFILE, encoding="utf-8")


@pytest.fixture
def types(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Lines that the user types."""
    return lambda *lines: monkeypatch.setattr(
        "sys.stdin", io.StringIO("".join(f"{line}\n" for line in lines))
    )


def test_a_step_that_fails_or_hangs_is_named_and_the_device_ends_safe(call: Any) -> None:
    code, out, _ = call("first-contact", "./p.yaml", "box", "--yes", *steps("fine", "fails", "hangs"))
    assert code == 3
    content = read_contact(JSON)
    assert content["measured"]["fine"] == {"took_s": 1.5}
    assert content["measured"]["fails"] == {"failed": "box: jammed"}
    assert "did not answer within 0.3 s" in content["measured"]["hangs"]["failed"]
    assert content["verdict"] == {"reason": "fine, fails, hangs"}
    assert out.count("FAILED") == 2
    page = JSON.with_suffix(".md").read_text("utf-8")
    assert "| took | 1.5 s |" in page
    assert "jammed" in page


def steps(*names: str) -> list[str]:
    return [part for name in names for part in ("--step", name)]


def test_ctrl_c_in_a_step_makes_the_device_safe_and_keeps_the_steps_before_it(call: Any) -> None:
    code, out, err = call("first-contact", "./p.yaml", "box", "--yes", *steps("fine", "stops", "seen"))
    assert code == 128 + signal.SIGINT
    assert "Traceback" not in err
    assert read_contact(JSON)["measured"] == {"fine": {"took_s": 1.5}}
    assert "| took | 1.5 s |" in JSON.with_suffix(".md").read_text("utf-8")
    assert f"file: {JSON}" in out


def test_a_data_folder_that_cannot_be_written_is_named_before_the_device_is_opened(call: Any) -> None:
    Path("full").touch()
    code, out, err = call("first-contact", "./p.yaml", "box", "--yes", "--output", "full")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "--output" in err


def test_the_page_has_the_names_and_units_of_a_reader() -> None:
    result = {
        "reset_s": 2.2e-3,
        "rate_hz": 623.75e6,
        "lowest_mv": 80,
        "memory_bytes": 1 << 32,
        "front_c": 50,
        "copy_s_per_byte": 1.25e-10,
        "status": 0x706,
        "naming_64_kib_s": None,
        "speeds": [[65536, 2.79666e9], [4097, 0.46e9]],
        "ready": True,
        "none": [],
    }
    content = {
        "card": {"model": "B1", "serial": "17", "driver": "1.0", "firmware": "2", "simulated": False},
        "computer": {"node": "pc"},
        "labseq": "1",
        "ended_utc": "2026-01-01T00:00:00+00:00",
        "measured": {"step": result},
        "verdict": {"reason": "fine"},
    }
    units = {"status": ("bits",), "speeds": ("bytes", "bytes_per_s")}
    page = page_text(Contact("box", JSON, content, units, []))
    assert page.partition("## step")[2].split("\n")[4:15] == [
        "| reset | 2.2 ms |",
        "| rate | 623.75 MHz |",
        "| lowest | 80 mV |",
        "| memory | 4 GiB |",
        "| front | 50 degrees Celsius |",
        "| copy | 0.125 ns per byte |",
        "| status | 0x706 |",
        "| naming 64 KiB | not known |",
        "| speeds | 64 KiB, 2.8 GB/s; 4097 bytes, 0.46 GB/s |",
        "| ready | yes |",
        "| none | none |",
    ]


class TestQuestions:
    def test_come_before_each_step_and_a_reading_that_makes_no_sense_is_refused(
        self, call: Any, types: Any
    ) -> None:
        types("y", "n", "n", "n", "yes", "", "3 V", "2 s", "12", "250 us")
        code, out, _ = call("first-contact", "./p.yaml", "box")
        assert code == 0
        assert read_contact(JSON)["measured"] == {"fine": {"took_s": 1.5}, "seen": {"delay_s": 250e-6}}
        assert "'3 V' is a voltage, not a time" in out
        assert "2 s is out of range; expected 0 s to 1 ms" in out
        assert "'12' has no unit" in out

    def test_without_the_instrument_a_step_is_left_out(self, call: Any, types: Any) -> None:
        types("n", "n", "n", "n", "no")
        assert call("first-contact", "./p.yaml", "box")[0] == 0
        assert read_contact(JSON)["measured"] == {}

    def test_need_somebody_who_answers(self, call: Any, types: Any) -> None:
        types()
        code, _, err = call("first-contact", "./p.yaml", "box")
        assert (code, err.count("\n")) == (2, 1)
        assert "give --yes" in err


class TestEarlierResults:
    def test_of_other_steps_are_kept(self, call: Any, types: Any) -> None:
        assert call("first-contact", "./p.yaml", "box", "--yes", "--step", "fine")[0] == 0
        types("")
        arguments = ["--yes", "--step", "seen", "--with", "scope"]
        assert call("first-contact", "./p.yaml", "box", *arguments)[0] == 0
        assert read_contact(JSON)["measured"] == {"fine": {"took_s": 1.5}, "seen": {"delay_s": None}}

    def test_of_steps_that_are_left_out_are_kept_and_their_faults_are_not_those_of_today(
        self, call: Any, types: Any
    ) -> None:
        assert call("first-contact", "./p.yaml", "box", "--yes", *steps("fine", "fails"))[0] == 3
        types("y", "n", "n", "n", "n")
        assert call("first-contact", "./p.yaml", "box")[0] == 0
        assert list(read_contact(JSON)["measured"]) == ["fine", "fails"]

    @pytest.mark.parametrize(
        ("change", "named"),
        [
            (lambda content: content["measured"]["fine"].update(took_s=0.1), "edited"),
            (lambda content: sealed(content, "computer", machine_id="another", node="pc2"), "'pc2'"),
            (lambda content: sealed(content, "card", firmware="1"), "firmware 1, but the device has 2"),
        ],
        ids=["edited", "of another computer", "of older firmware"],
    )
    def test_that_do_not_belong_to_the_device_are_refused(
        self, call: Any, types: Any, change: Any, named: str
    ) -> None:
        call("first-contact", "./p.yaml", "box", "--yes", "--step", "fine")
        content = json.loads(JSON.read_text("utf-8"))
        change(content)
        JSON.write_text(json.dumps(content), "utf-8")
        code, _, err = call("first-contact", "./p.yaml", "box", "--yes", "--step", "fine")
        assert (code, err.count("\n")) == (2, 1)
        assert named in err
        assert "take all steps again with 'labseq first-contact'" in err
        assert json.loads(JSON.read_text("utf-8")) == content
        types(*"nnnnn")
        assert call("first-contact", "./p.yaml", "box")[0] == 0, "all steps again begin a new file"
        assert read_contact(JSON)["measured"] == {}


def sealed(content: dict[str, Any], part: str, **changes: str) -> None:
    content[part].update(changes)
    content["digest"] = file.digest_of(content)


def test_a_device_whose_driver_has_no_steps_is_identified_and_the_verdict_says_so(call: Any) -> None:
    code, out, _ = call("first-contact", "./p.yaml", "meter")
    assert code == 0
    content = read_contact(Path("data/first-contact/meter-P1_7.json"))
    assert (content["card"]["model"], content["card"]["serial"]) == ("PM100", "P1/7")
    assert "only identity, settings and limits were read" in content["verdict"]["reason"]
    assert content["verdict"]["reason"] in out


def test_a_simulated_camera_gets_the_simulation_that_the_awg_must_not_see(call: Any) -> None:
    code, out, err = call("first-contact", "lab", "camera", "--dry-run")
    assert (code, err) == (0, "")
    assert "camera: DU-897" in out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["lamp"], "no device 'lamp'"),
        (["camera"], "camera is virtual"),
        (["box", "--step", "dance"], "no step 'dance'; expected"),
        (["box", "--with", "crystal ball"], "no instrument 'crystal ball'; expected"),
    ],
)
def test_a_mistake_is_one_line_with_what_was_expected(call: Any, arguments: list[str], named: str) -> None:
    code, _, err = call("first-contact", "./p.yaml", *arguments, "--yes")
    assert (code, err.count("\n")) == (2, 1)
    assert named in err


def test_the_awg_of_the_bench_gets_a_file_that_never_replaces_a_real_cards(call: Any) -> None:
    arguments = ["--yes", *steps("identity", "positions"), "--output", "elsewhere"]
    code, out, _ = call("first-contact", "bench_awg", *arguments)
    assert code == 0, out
    content = read_contact(Path("elsewhere/first-contact/12345-simulated.json"))
    assert content["card"]["simulated"]
    assert not content["verdict"]["stream"]
    assert (
        "the certificate needs the steps write_speed, lag, sustained, starve, overwrite"
        in content["verdict"]["reason"]
    )


def test_without_the_vendors_library_the_awg_is_refused_with_the_remedy(call: Any) -> None:
    card = ["--set", "profile.mobile_tweezers.card=/dev/spcm0"]
    code, _, err = call("first-contact", "bench_awg", "mobile_tweezers", "--yes", *card)
    assert (code, err.count("\n")) == (3, 1)
    assert "install Spectrum's driver" in err


def test_a_file_survives_writing_and_reading_with_its_digest(tmp_path: Path) -> None:
    path = tmp_path / "1.json"
    write_contact(path, {"schema": 1, "measured": {"b": (1.0, float("nan")), "a": {"z": 1, "y": 1e-9}}})
    assert read_contact(path)["measured"] == {"b": [1.0, None], "a": {"z": 1, "y": 1e-9}}
