"""Wrong files as a session meets them: every error of both, in one go, and none that only follows from another."""

# ruff: noqa: E501 - messages stand here as they are printed

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.errors import ConfigError
from labseq.session.check import check
from tests.profiles import virtual_without_lines

ROOT = Path(__file__).parents[2]
SEQUENCE = (ROOT / "sequences" / "compact_225.yaml").read_text(encoding="utf-8")
PROFILE = virtual_without_lines()
TIME = "expected a time such as '45 ms' (s, ms, us, ns, min, h)"
NO_HOOK = "it implements no hook; write '@hookimpl' above 'def labseq_register'"

CASES: list[tuple[str, dict[str, str], list[str]]] = [
    (
        "a wrong exposure hides no image from the rearrangement",
        {"- image: {exposure: 45 ms}": "- image: {exposure: 45 parsecs}"},
        [f"s.yaml:12:23: exposure: 'parsecs' in '45 parsecs' is not a unit of time; {TIME}"],
    ),
    (
        "a misspelt image hides no image from the rearrangement",
        {"- image: {exposure: 45 ms}": "- imge: {exposure: 45 ms}"},
        ["s.yaml:12:5: unknown step 'imge'; expected ...; did you mean 'image'?"],
    ),
    (
        "no image before the rearrangement",
        {"  - image: {exposure: 45 ms}\n  #": "  #"},
        ["s.yaml:13:5: 'rearrange' needs an image before it in the shot; expected an 'image' step before it"],
    ),
    (
        "the file's own keys and plugins' settings",
        {"shots: 20": "shots: 0", "rows: 15": "rows: 0", "duration: 500 ms": "time: 500 ms"},
        [
            "s.yaml:5:8: shots is 0; expected at least 1",
            "s.yaml:7:34: rows is 0; expected at least 1",
            "s.yaml:11:12: 'time' is not a setting of step 'load'; expected duration",
        ],
    ),
    (
        "sequence and profile",
        {"use: psca": "use: pcsa", "spacing: 4.49 um": "spacing: 0", "readout: 5 ms": "readout: 5 Hz"},
        [
            "p.yaml:16:12: spacing is 0; expected more than 0",
            f"p.yaml:27:12: readout: '5 Hz' is a frequency, not a time; {TIME}",
            "s.yaml:8:16: unknown planner 'pcsa'; expected ...; did you mean 'psca'?",
        ],
    ),
    (
        "quantities without units",
        {
            "duration: 500 ms": "duration: 500",
            "spacing: 4.49 um": "spacing: 4.49",
            "window: 60 ms": "window: 0",
        },
        [
            "p.yaml:16:12: spacing is 4.49, without a unit; expected a length such as '4.49 um' (m, mm, um, nm); write '4.49 um' or '4.49 m'",
            "s.yaml:11:22: duration is 500, without a unit; expected a time such as '45 ms' (s, ms, us, ns, min, h); write '500 ms' or '500 s'",
        ],
    ),
    (
        "a wrong grid says nothing of the target's size",
        {"rows: 20 ": "rows: -20 "},
        ["p.yaml:14:9: rows is -20; expected at least 1"],
    ),
    (
        "no profile: the settings are checked all the same",
        {"profile: p.yaml": "profile: ./gone.yaml", "rows: 15": "rows: 0", "use: psca": "use: elsewhere"},
        [
            "s.yaml:4:10: there is no hardware profile at gone.yaml",
            "s.yaml:7:34: rows is 0; expected at least 1",
        ],
    ),
    (
        "plugin folders missing: what they would offer is not unknown",
        {"shots: 20": "shots: 0\nplugin_folders: [gone]", "use: psca": "use: mine"},
        [
            "s.yaml:5:8: shots is 0; expected at least 1",
            "s.yaml:6:18: there is no plugin folder 'gone'; expected a folder at gone",
        ],
    ),
    (
        "a target larger than the grid",
        {"rows: 15": "rows: 25"},
        [
            "s.yaml:7:9: the size of the target is 25 rows x 15 columns; the limit is the grid of 20 rows x 20 columns; choose a smaller target, or a profile with a larger grid"
        ],
    ),
    (
        "a device that the profile lacks",
        {"- image: {exposure: 45 ms}": "- device: {name: shuter, do: open}\n  - image: {exposure: 45 ms}"},
        [
            "s.yaml:12:20: the profile 'virtual' has no device 'shuter'; expected one of 'shutter', 'synthesizer'"
        ],
    ),
    (
        "tones outside the AOD's band",
        {
            "column_frequency: {centre: 100 MHz, step: 1.6 MHz}": "column_frequency: {centre: 100 MHz, step: 3 MHz}"
        },
        [
            "p.yaml:23:21: moving atoms: the frequency of column tone 0 in batch 0 is 71.5 MHz; the limit is the band of 82 to 118 MHz"
        ],
    ),
    (
        "a command that the device does not have",
        {"- image: {exposure: 45 ms}": "- device: {name: shutter, do: opne}\n  - image: {exposure: 45 ms}"},
        ["s.yaml:12:33: shutter: unknown command 'opne'; expected ...; did you mean 'open'?"],
    ),
    (
        "an exposure that the camera cannot make, and one that times out",
        {"- image: {exposure: 45 ms}": "- image: {exposure: 11 s}"},
        [
            "s.yaml:12:23: camera: exposure is 11 s; the limit is more than 0 and at most 10 s; choose another exposure",
            "p.yaml:125:9: device calls time out after 10 s, but an exposure takes 11 s; expected more than 11 s",
        ],
    ),
    (
        "frames that the detector does not take",
        {"frame: [512, 512]": "frame: [600, 600]"},
        [
            "p.yaml:67:8: detector: the frame is uint16 (512, 512), but according to the detector's settings the sites are on uint16 frames of (600, 600); calibrate the sites, or check the detector's `centre_px`, `pixel_size`, `angle` and `frame`"
        ],
    ),
    (
        "edges too close for the lines",
        {
            "- load: {duration: 500 ms}": "- wait: {duration: 1 us}\n  - load: {duration: 2 us}",
            "plugin_folders: []": "lines: {use: ttl, channels: {light: {channel: 2, on: [wait, load]}, mot: {channel: 3, on: [load]}}}",
        },
        [
            "s.yaml:11:22: lines: `wait`: time between the edges of 'light' at 0 s and of 'light' at 1 us is 1 us; the limit is at least 5 us; change a lead, a lag or a pulse",
            "s.yaml:12:22: lines: `load`: time between the edges of 'light', 'mot' at 0 s and of 'light', 'mot' at 2 us is 2 us; the limit is at least 5 us; change a lead, a lag or a pulse",
        ],
    ),
    (
        "a tone of a step outside the AOD's band",
        {"- image: {exposure: 45 ms}": "- image: {exposure: 45 ms}\n  - probe: {offset: [40 um, 0 um]}"},
        [
            "s.yaml:13:12: the frequency of the tone of column 12 at an offset of 40 um is 118.254 MHz; "  # noqa: ISC004 - one message
            "the limit is the band of 82 to 118 MHz; choose a smaller offset, or sites further from the edge",
        ],
    ),
    (
        "values of a scan's other points",
        {
            "shots: 20": "scan: {shot.1.image.exposure: [45 ms, 9 s], profile.camera.max_exposure: [10 s, 5 s]}",
        },
        [
            "s.yaml:5:39: camera: exposure is 9 s; the limit is more than 0 and at most 5 s; choose another exposure",
        ],
    ),
]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def write(changes: dict[str, str]) -> None:
    sequence, profile = SEQUENCE.replace("profile: virtual", "profile: p.yaml"), PROFILE
    for old, new in changes.items():
        assert old in sequence or old in profile
        sequence, profile = (
            (sequence.replace(old, new, 1), profile)
            if old in sequence
            else (sequence, profile.replace(old, new, 1))
        )
    Path("s.yaml").write_text(sequence, encoding="utf-8")
    Path("p.yaml").write_text(profile, encoding="utf-8")


def messages(**options: Any) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        check(labseq.Session.open("s.yaml", **options))
    return [str(problem) for problem in caught.value.problems]


@pytest.mark.parametrize(("changes", "expected"), [pytest.param(*case[1:], id=case[0]) for case in CASES])
def test_all_messages(changes: dict[str, str], expected: list[str]) -> None:
    write(changes)
    # What plugins offer, and so what is expected, changes with the plugins.
    assert [
        re.sub(r"^(.* unknown .*; expected )(one of )?'.*'(;|$)", r"\1...\3", m) for m in messages()
    ] == expected


def test_a_run_refuses_what_the_check_refuses(tmp_path: Path) -> None:
    write(CASES[-2][1])
    with (
        pytest.raises(ConfigError) as caught,
        labseq.Session.open("s.yaml", output=tmp_path / "data") as session,
    ):
        session.run()
    assert [str(problem) for problem in caught.value.problems] == CASES[-2][2]
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("address", ["shot.1.image.exposure", "shot.2.rearrange.exposure"])
def test_a_driver_states_the_limits_of_its_device_before_it_is_open(address: str) -> None:
    write({})
    problem = f"--set {address}=1 us: camera: exposure is 1 us; the limit is 10 us to 10 s"
    assert messages(profile="bench", overrides=[f"{address}=1 us"]) == [f"{problem}; choose another exposure"]


def test_a_card_that_would_play_a_pause_between_batches_is_refused_one() -> None:
    write({})
    key = "profile.mobile_tweezers.overhead_per_batch"
    what = f"--set {key}=1 us: a dead time before each batch is set for 'spcm', which would play silence"
    (message,) = messages(profile="bench_awg", overrides=[f"{key}=1 us"])
    assert message.startswith(f"{what}; expected none, as only `use: virtual`")


def test_wrong_options_are_reported_with_the_files() -> None:
    write({"rows: 15": "rows: 0"})
    expected = [
        "--set planr.x=1: .* did you mean 'planner'",
        "--shots 0: shots is 0",
        "--set profile.camera.gain=5: 'gain' .* did you mean 'em_gain'",
        "s.yaml:7:34: rows is 0",
    ]
    found = messages(shots=0, overrides=["planr.x=1", "profile.camera.gain=5"])
    assert all(re.match(*pair) for pair in zip(expected, found, strict=True)), found


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "spacing: 4.49 um",
            "spacing: 4.49 m",
            "the region of interest of site (0, 0), according to the detector's settings, is rows ",
        ),
        ("threshold: 1630", "threshold: gone.npy", "thresholds cannot be read from 'gone.npy': No such file"),
    ],
)
def test_what_a_constructor_refuses_has_its_place(old: str, new: str, words: str) -> None:
    write({old: new})
    (message,) = messages()
    assert message.startswith("p.yaml:67:3: ")
    assert words in message


PLUGIN = """
from labseq.plugin import hookimpl
LABSEQ_API = 1

class Mine:
    def __init__(self, settings, context): pass
    def plan(self, occupancy, target): return None

@hookimpl
def labseq_register(registry):
    registry.planner("mine", Mine)
"""


@pytest.mark.parametrize(
    ("old", "new", "use", "words"),
    [
        ("LABSEQ_API", "import nothing_like_it\nLABSEQ_API", "mine", "No module named 'nothing_like_it'"),
        ("@hookimpl\n", "", "mine", NO_HOOK),
        (
            '"mine"',
            '"psca"',
            "psca",
            "planner 'psca' is already offered by 'labseq_psca'; rename one of them",
        ),
    ],
)
def test_a_plugin_that_does_not_load_is_reported_where_it_is_named(
    old: str, new: str, use: str, words: str
) -> None:
    write({"{use: psca, degree_of_parallelism: 7}": f"{{use: {use}}}", "rows: 15": "rows: 0"})
    Path("plugins").mkdir()
    Path("plugins/mine.py").write_text(PLUGIN.replace(old, new, 1), encoding="utf-8")
    first, second = messages(overrides=["plugin_folders=[plugins]"])
    assert first == "s.yaml:7:34: rows is 0; expected at least 1"
    assert second.startswith("s.yaml:8:16: plugin 'mine' failed to load: ")
    assert words in second


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("def plan(", "def plann(", "planner 'mine' has no method plan; see labseq.plugin.Planner"),
        ("settings, context)", "settings)", "takes 2 positional arguments but 3 were given; it comes from"),
    ],
)
def test_a_class_that_does_not_suit_its_role_is_reported_where_it_is_named(
    old: str, new: str, words: str
) -> None:
    write({"{use: psca, degree_of_parallelism: 7}": "{use: mine}"})
    Path("plugins").mkdir()
    assert old in PLUGIN
    Path("plugins/mine.py").write_text(PLUGIN.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        check(labseq.Session.open("s.yaml", overrides=["plugin_folders=[plugins]"]))
    assert str(caught.value).startswith("s.yaml:8:10: plugin 'mine' ")
    assert words in str(caught.value)
