"""Making a profile's devices safe, whatever else is wrong with it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

import labseq
from labseq.cli.entry import main
from labseq.errors import ConfigError
from labseq.files import devices_root
from labseq.recording import find_dead_run, mark_active
from labseq.safety.devices import check_devices
from labseq.safety.safe import SafeStateReport, make_each_safe, make_profile_safe
from labseq.testing.fakes import RecordingObserver, fake_lab
from tests.hostile import HOSTILE
from tests.plugins.labseq_soapy_rig import until

from .small_runs import OWN_DEVICE, PROFILE as SMALL_PROFILE

PROFILE = f"{SMALL_PROFILE}plugin_folders: [plugins]\ndevices:\n  shutter: SHUTTER\n"
OPEN_ORDER = ["static_tweezers", "camera", "mobile_tweezers"]
SAFE_ORDER = ["mobile_tweezers", "shutter", "camera", "static_tweezers"]

INIT = "def __init__(self, settings, context): "
INIT_FAILS = f"{INIT}raise OSError('no card')"
BROKEN = {  # what is wrong -> old and new text of the plugin, the shutter's entry, what is said
    "import": ("import labseq\n", "import nothing_like_it\n", "{use: mine}", "nothing_like_it"),
    "unknown name": ("", "", "{use: mein}", "unknown device 'mein'"),
    "settings": ("", "", "{use: mine, gain: 5}", "'gain' is not a setting of device 'mine'"),
    "constructor": (f"{INIT}pass", INIT_FAILS, "{use: mine}", "raised OSError: no card"),
    "not its role": ("def read(", "def raed(", "{use: mine}", "abstract class Mine"),
    "not a mapping": ("", "", "5", "its settings in the profile are invalid"),
}


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def write(shutter: str, old: str = "", new: str = "", profile: str = PROFILE) -> None:
    Path("plugins").mkdir(exist_ok=True)
    Path("plugins/mine.py").write_text(OWN_DEVICE.replace(old, new, 1), encoding="utf-8")
    Path("p.yaml").write_text(profile.replace("SHUTTER", shutter), encoding="utf-8")


def secured(*overrides: str) -> tuple[SafeStateReport, list[Any]]:
    seen = RecordingObserver()
    outcome = make_profile_safe("./p.yaml", overrides, seen)
    return outcome, seen.of("safe_state")


@pytest.mark.parametrize("what", BROKEN)
def test_one_broken_device_never_keeps_the_others_from_being_made_safe(what: str) -> None:
    old, new, shutter, says = BROKEN[what]
    write(shutter, old, new)
    outcome, events = secured()
    assert outcome.attempted == dict.fromkeys(["mobile_tweezers", "camera", "static_tweezers"])
    assert [t["device"] for t in events] == ["mobile_tweezers", "camera", "static_tweezers", "shutter"]
    assert [t["ok"] for t in events] == [True, True, True, False]
    (error,) = outcome.failures
    assert says in str(error)
    problems = outcome.problems.problems if outcome.problems is not None else ()
    placed = [str(error), *map(str, problems)]
    assert any(text.startswith("p.yaml:11:") for text in placed)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("spacing: 4.49 um", "spacing: 0", "p.yaml:3:35: spacing is 0"),
        ("[plugins]", "[gone, plugins]", "there is no plugin folder 'gone'"),
    ],
)
def test_what_concerns_no_device_is_reported_at_the_end(old: str, new: str, says: str) -> None:
    assert old in PROFILE
    write("{use: mine}", profile=PROFILE.replace(old, new, 1))
    outcome, _ = secured()
    assert "shutter" in outcome.attempted
    assert outcome.problems is not None
    assert says in str(outcome.problems)


HOSTILE_DEVICE = """
from tests.hostile import HOSTILE


def fail(self, *_, **__):
    raise HOSTILE[WHAT]

"""


def test_a_device_that_cannot_be_opened_is_told_to_be_safe_but_is_not_reported_as_safe() -> None:
    write("{use: mine}", "safe_state(self): pass", "safe_state(self): open('told', 'w').close()")
    plugin = Path("plugins/mine.py")
    text = plugin.read_text("utf-8").replace(
        "def open(self): pass", "def open(self): raise OSError('no answer')"
    )
    plugin.write_text(text, "utf-8")
    outcome, events = secured()
    assert [name for name, failure in outcome.attempted.items() if failure is not None] == ["shutter"]
    assert [(t["device"], "no answer" in t["error"]) for t in events if not t["ok"]] == [("shutter", True)]
    assert len(outcome.failures) == 1
    assert Path("told").exists()


@pytest.mark.parametrize("what", ["base exception", "escapes"])
def test_no_error_of_a_device_keeps_the_others_from_being_made_safe(
    what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for methods in (["open", "safe_state", "close"], ["describe"]):
        write("{use: mine}")
        plugin = Path("plugins/mine.py")
        text = plugin.read_text("utf-8").replace("return {}", "pass")
        for method in methods:
            text = text.replace(f"def {method}(self): pass", f"{method} = fail")
        plugin.write_text(HOSTILE_DEVICE.replace("WHAT", repr(what)) + text, "utf-8")
        outcome, events = secured()
        assert [t["device"] for t in events] == SAFE_ORDER
        assert [t["ok"] for t in events] == [True, "open" not in methods, True, True]
        assert all(str(failure).isprintable() for failure in outcome.failures)
        report = check_devices("./p.yaml")
        assert [one.name for one in report.devices if one.ok] == ["simulation", *OPEN_ORDER]
    with pytest.raises(SystemExit) as leaving:
        main(["--debug", "devices", "./p.yaml"])
    assert leaving.value.code == 3
    found = capsys.readouterr()
    assert "\x1b" not in found.out + found.err


EMERGENCY = """
import pathlib

def off(name):
    pathlib.Path(name).unlink()
    return "closed"
"""
STAYS = """
import time
from pathlib import Path
import labseq


def stay():
    Path("reached").touch()
    time.sleep(60)


"""
GUARDED = """class Mine(labseq.plugin.Device):
    def emergency(self):
        return labseq.plugin.Emergency(Path("emergency.py").absolute(), {"name": str(Path("on").absolute())})

"""


@pytest.mark.parametrize(("command", "method"), [("devices", "describe"), ("safe", "safe_state")])
def test_a_command_that_opens_devices_and_is_killed_leaves_them_off(command: str, method: str) -> None:
    Path("emergency.py").write_text(EMERGENCY, encoding="utf-8")
    write("{use: mine}", f"def {method}(self):", f"def {method}(self):\n        stay()\n       ")
    plugin = Path("plugins/mine.py")
    text = plugin.read_text("utf-8").replace("def open(self): pass", "def open(self): Path('on').touch()")
    plugin.write_text(
        text.replace("import labseq\n", STAYS, 1).replace("class Mine(labseq.plugin.Device):", GUARDED),
        "utf-8",
    )
    labseq = [sys.executable, "-m", "labseq", command, "./p.yaml"]
    with subprocess.Popen(labseq, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        until(lambda: process.poll() is not None or Path("reached").exists(), 120.0)
        assert process.poll() is None, process.communicate()
        process.kill()
        _, said = process.communicate(timeout=120.0)  # until the watchdog has ended, too
    assert not Path("on").exists()
    assert f"labseq-watchdog: labseq {command} died; shutter is off after " in said


def test_a_simulation_or_a_screen_that_fails_keeps_no_device_from_being_made_safe() -> None:
    lab, seen = fake_lab(simulated=True), list[str]()

    def fail(*_: object) -> None:
        raise HOSTILE["base exception"]

    vars(lab.simulation)["open"] = vars(lab.simulation)["close"] = fail
    screen = cast("Any", SimpleNamespace(event=fail))
    outcome = make_each_safe(lab.safe_order(), lab.timeouts, lab.simulation, screen)
    assert [name for name, failure in outcome.items() if failure] == ["simulation"]
    seen = [call.device for call in lab.calls if call.method == "close"]
    assert seen == SAFE_ORDER


def test_all_are_safe_in_order_without_a_detector() -> None:
    write("{use: mine}", profile=PROFILE.replace("use: threshold", "use: gone"))
    outcome, events = secured()
    assert [t["device"] for t in events] == SAFE_ORDER
    assert (list(outcome.attempted), outcome.failures, outcome.problems) == (SAFE_ORDER, [], None)


def test_without_the_simulation_nothing_virtual_can_be_made_safe() -> None:
    write("{use: mine}", profile=PROFILE.replace("simulation: {use: virtual", "simulation: {use: gone"))
    outcome, _ = secured()
    assert list(outcome.attempted) == ["shutter"]
    assert set(outcome.refused) == {"mobile_tweezers", "camera", "static_tweezers", "simulation"}


def marked_as_dead() -> tuple[str, list[str]]:
    """Profile and devices of a run that died."""
    key = str(Path("p.yaml").resolve())
    mark_active(key, [], Path("data/run"))
    for marker in devices_root().glob("*.json"):
        marker.write_text(json.dumps({**json.loads(marker.read_text("utf-8")), "boot": "another"}), "utf-8")
    assert find_dead_run(key, []) is not None
    return key, []


def test_a_run_that_died_is_forgotten_once_all_is_safe() -> None:
    write("{use: mine}")
    dead = marked_as_dead()
    secured("profile.devices.shutter.use=mine")
    assert find_dead_run(*dead) is not None  # another device may have been named in its place
    secured()
    assert find_dead_run(*dead) is None


@pytest.mark.parametrize(
    ("plugin", "profile", "problem"),
    [
        (("safe_state(self): pass", "safe_state(self): raise OSError('jammed')"), PROFILE, "jammed"),
        (("open(self): pass", "open(self): raise OSError('no answer')"), PROFILE, "no answer"),
        (
            ("", ""),
            PROFILE.replace("devices:\n  shutter: SHUTTER", "devices: 5"),
            "p.yaml:10:10: devices is 5",
        ),
    ],
)
def test_a_run_that_died_is_remembered_until_all_devices_are_safe(
    plugin: tuple[str, str], profile: str, problem: str
) -> None:
    write("{use: mine}", *plugin, profile=profile)
    dead = marked_as_dead()
    outcome, _ = secured()
    assert problem in f"{outcome.attempted.get('shutter')} {outcome.problems}"
    assert find_dead_run(*dead) is not None


SEQUENCE = """
labseq: 1
name: look
profile: ./p.yaml
shots: 1
target: {pattern: compact, rows: 2, cols: 2}
shot:
  - image: {}
"""


def test_a_run_makes_safe_what_it_can_before_anything_of_it_can_fail() -> None:
    write("{use: mine}", f"{INIT}pass", INIT_FAILS)
    Path("s.yaml").write_text(SEQUENCE, encoding="utf-8")
    dead = marked_as_dead()
    seen = RecordingObserver()
    with (
        labseq.Session.open("s.yaml", output="elsewhere", observer=seen) as session,
        pytest.raises(ConfigError, match=r"p\.yaml:11:12: .*raised OSError: no card"),
    ):
        session.run()
    assert [t["device"] for t in seen.of("safe_state") if t["ok"]] == [
        "mobile_tweezers", "camera", "static_tweezers"
    ]  # fmt: skip
    assert find_dead_run(*dead) is not None
    write("{use: mine}")
    with labseq.Session.open("s.yaml", output="elsewhere", observer=seen) as session:
        session.run()
    assert find_dead_run(*dead) is None
