"""Every way out of a run: devices safe in the stated order, data whole, exit code right."""

import json
import signal
import sys

import pytest

import labseq

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(sys.platform == "win32", reason="signals are sent the POSIX way here"),
]

SAFE_ORDER = [
    "mobile_tweezers.safe_state",
    "shutter.safe_state",
    "camera.safe_state",
    "static_tweezers.safe_state",
]

LOAD_AND_IMAGE = "  - load: {duration: 500 ms}\n  - image: {exposure: 45 ms}\n"
LONG_STEPS = {  # steps, the call that is waited for, and whether the device is slow there
    "load": ("  - load: {duration: 600 s}\n", "static_tweezers.start:2", False),
    "image": (LOAD_AND_IMAGE, "camera.read:1", True),
    "wait": (
        "  - device: {name: shutter, do: open}\n  - wait: {duration: 600 s}\n",
        "shutter.command:1",
        False,
    ),
    "device": ("  - device: {name: shutter, do: open, timeout: 1 h}\n", "shutter.command:1", True),
    "rearrange, moving": (
        LOAD_AND_IMAGE + "  - rearrange: {window: 60 ms}\n",
        "mobile_tweezers.wait:1",
        True,
    ),
    "rearrange, imaging": (LOAD_AND_IMAGE + "  - rearrange: {window: 60 ms}\n", "camera.read:2", True),
}
SIGNALS = [(signal.SIGINT, 130), (signal.SIGTERM, 143)]


def safe_calls(calls):
    return [call for call in calls if call.endswith("safe_state")]


@pytest.mark.parametrize(
    ("step", "number", "code"),
    [(step, *SIGNALS[i % 2]) for i, step in enumerate(LONG_STEPS)],  # a handler knows nothing of steps
)
def test_a_signal_in_any_step_ends_safely(bench, step, number, code):
    steps, call, slow = LONG_STEPS[step]
    bench.write_sequence(steps)
    if slow:
        bench.environment["WATCHED_SLOW"] = call
    process = bench.start(
        "run", "sequence.yaml", "--realtime", "--json", "--set", "profile.timeouts.call=2 h"
    )
    name, _, n = call.partition(":")
    bench.await_calls(process, name, int(n))
    returncode, out, err = bench.interrupt(process, number)
    assert returncode == code, err
    assert safe_calls(bench.calls()) == SAFE_ORDER
    assert "Traceback" not in err
    assert json.loads(out.splitlines()[-1])["status"] == "stopped"
    run = labseq.open_run(bench.run_dir())
    assert run.status == "stopped"
    (attempt,) = run.attempts
    assert attempt.status == "interrupted"
    if step != "load":  # which calls no device: the signal may come just before it
        assert attempt.timing  # what the shot has is written


def test_a_signal_before_the_run_has_begun_ends_it(bench):
    process = bench.start("run", "sequence.yaml", "--realtime")
    bench.await_calls(process, "static_tweezers.open")
    returncode, _, err = bench.interrupt(process)
    assert returncode == 130, err
    assert safe_calls(bench.calls()) == SAFE_ORDER


@pytest.mark.parametrize(
    ("call", "says"),
    [
        ("mobile_tweezers.prepare", "mobile_tweezers: prepare() raised RuntimeError: rehearsed failure"),
        ("static_tweezers.open", "static_tweezers: open() raised RuntimeError: rehearsed failure"),
    ],
)
def test_a_device_that_fails_is_named_and_all_are_made_safe(bench, call, says):
    bench.environment["WATCHED_FAILS"] = call
    done = bench.run("run", "sequence.yaml")
    assert done.returncode == 3, done.stderr
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    assert safe_calls(bench.calls()) == SAFE_ORDER
    assert labseq.open_run(bench.run_dir()).status == "failed"


def test_one_device_that_cannot_be_made_safe_never_stops_the_others(bench):
    bench.environment["WATCHED_FAILS"] = "mobile_tweezers.safe_state"
    done = bench.run("run", "sequence.yaml", "--shots", "1")
    assert safe_calls(bench.calls()) == SAFE_ORDER
    failures = [e["values"] for e in bench.events("safe_state") if not e["values"]["ok"]]
    assert [f["device"] for f in failures] == ["mobile_tweezers"]
    assert "mobile_tweezers" in done.stderr + done.stdout


@pytest.mark.parametrize("call", ["camera.read", "mobile_tweezers.safe_state"])
def test_a_device_that_hangs_is_given_up(bench, call):
    bench.environment["WATCHED_HANGS"] = call
    done = bench.run_apart("run", "sequence.yaml", "--shots", "1", "--set", "profile.timeouts.call=0.3 s")
    assert safe_calls(bench.calls()) == SAFE_ORDER
    device = call.split(".")[0]
    if call == "camera.read":
        assert done.returncode == 3
        assert "camera: read() did not answer within" in done.stderr
    failures = [e["values"]["device"] for e in bench.events("safe_state") if not e["values"]["ok"]]
    assert failures == ([device] if call.endswith("safe_state") else [])


def kill_a_run(bench):
    """Kill a run in its first shot; its data are here, those of later runs there."""
    bench.write_sequence("  - load: {duration: 600 s}\n")
    process = bench.start("run", "sequence.yaml", "--realtime", "--output", "here")
    bench.await_calls(process, "static_tweezers.start", 2)
    process.kill()
    process.communicate()
    assert safe_calls(bench.calls()) == []
    (state,) = bench.folder.glob("here/*/*/STATE")
    assert labseq.open_run(state.parent).status == "failed"
    bench.log.unlink()
    bench.write_sequence("  - load: {duration: 1 ms}\n  - image: {exposure: 45 ms}\n")


def test_after_a_run_that_was_killed_the_next_makes_the_devices_safe_first(bench):
    kill_a_run(bench)
    done = bench.run("run", "sequence.yaml", "--shots", "1", "--output", "there")
    assert done.returncode == 0, done.stderr
    assert "died" in done.stderr + done.stdout
    assert safe_calls(bench.calls()) == SAFE_ORDER * 2
    first_start = bench.calls().index("static_tweezers.start")
    assert bench.calls().index("mobile_tweezers.safe_state") < first_start
    bench.log.unlink()
    bench.run("run", "sequence.yaml", "--shots", "1", "--output", "there")
    assert safe_calls(bench.calls()) == SAFE_ORDER


def test_after_a_run_that_was_killed_the_devices_may_be_made_safe_by_hand(bench):
    kill_a_run(bench)
    assert bench.run("safe", "watched.yaml").returncode == 0
    bench.log.unlink()
    done = bench.run("run", "sequence.yaml", "--shots", "1", "--output", "there")
    assert done.returncode == 0, done.stderr
    assert safe_calls(bench.calls()) == SAFE_ORDER


def test_the_safe_command(bench):
    done = bench.run("safe", "watched.yaml")
    assert done.returncode == 0, done.stderr
    assert safe_calls(bench.calls()) == SAFE_ORDER
    assert {c for c in bench.calls() if c.endswith(".close")} == {
        f"{d}.close" for d in ("mobile_tweezers", "shutter", "camera", "static_tweezers")
    }
    bench.environment["WATCHED_FAILS"] = "camera.open"
    done = bench.run("safe", "watched.yaml")
    assert done.returncode == 3
    assert "camera" in done.stdout + done.stderr
    bench.environment["WATCHED_FAILS"] = "camera.close"
    done = bench.run("safe", "watched.yaml")
    assert done.returncode == 0
    assert "could not be closed: camera: close() raised RuntimeError" in done.stdout
