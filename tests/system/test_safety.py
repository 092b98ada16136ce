"""Every way out of a run: devices safe in the stated order, data whole, exit code right."""

import signal
import sys

import pytest

import labseq

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(sys.platform == "win32", reason="signals are sent the POSIX way here"),
]

SAFE_ORDER = [
    f"{device}.safe_state" for device in ("mobile_tweezers", "shutter", "camera", "static_tweezers")
]
LOAD_AND_IMAGE = "  - load: {duration: 500 ms}\n  - image: {exposure: 45 ms}\n"
REARRANGE = LOAD_AND_IMAGE + "  - rearrange: {window: 60 ms}\n"
OPEN = "  - device: {name: shutter, do: open, timeout: 1 h}\n"
LONG_STEPS = {  # steps, the call at which a signal comes, and whether the device is slow there
    "load": ("  - load: {duration: 600 s}\n", "static_tweezers.start:2", ""),
    "image": (LOAD_AND_IMAGE, "camera.read:1", "slow"),
    "wait": (OPEN + "  - wait: {duration: 600 s}\n", "shutter.command:1", ""),
    "device": (OPEN, "shutter.command:1", "slow"),
    "rearrange, moving": (REARRANGE, "mobile_tweezers.wait:1", "slow"),
    "rearrange, imaging": (REARRANGE, "camera.read:2", "slow"),
}


def safe_calls(calls):
    return [call for call in calls if call.endswith("safe_state")]


@pytest.mark.parametrize(
    ("step", "number"), [*((step, signal.SIGINT) for step in LONG_STEPS), ("image", signal.SIGTERM)]
)
def test_a_signal_in_any_step_ends_safely(bench, step, number):
    steps, call, slow = LONG_STEPS[step]
    bench.write_sequence(steps)
    bench.environment["WATCHED_SIGNAL"] = f"{call}:{int(number)}:{slow}"
    run = bench.run_apart if (step, number) == ("rearrange, moving", signal.SIGINT) else bench.run
    done = run("run", "sequence.yaml", "--realtime", "--set", "profile.timeouts.call=2 h")
    assert done.returncode == 128 + number, done.stderr
    assert safe_calls(bench.calls()) == SAFE_ORDER
    assert "Traceback" not in done.stderr
    found = labseq.open_run(bench.run_dir())
    assert found.status == "stopped"
    assert done.stderr.rstrip().endswith(found.error)
    (attempt,) = found.attempts
    assert attempt.status == "interrupted"
    if step != "load":  # which calls no device: the signal may come just before it
        assert attempt.timing  # what the shot has is written


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGHUP", 129)])  # Ctrl-C, a lost terminal
def test_a_signal_before_the_run_has_begun_ends_it(bench, name, code):
    number = getattr(signal, name)
    if (before := signal.getsignal(number)) is signal.SIG_IGN:  # the tests run under nohup
        signal.signal(number, signal.SIG_DFL)
    bench.environment["WATCHED_SIGNAL"] = f"static_tweezers.open:1:{int(number)}:slow"
    try:
        done = bench.run("run", "sequence.yaml", "--realtime", "--set", "profile.timeouts.call=2 h")
    finally:
        signal.signal(number, before)
    assert done.returncode == code, done.stderr
    assert safe_calls(bench.calls()) == SAFE_ORDER


@pytest.mark.parametrize("call", ["mobile_tweezers.prepare", "static_tweezers.open"])
def test_a_device_that_fails_is_named_and_all_are_made_safe(bench, call):
    bench.environment["WATCHED_FAILS"] = call
    done = bench.run("run", "sequence.yaml")
    assert done.returncode == 3, done.stderr
    assert call.replace(".", ": ") + "() raised RuntimeError: rehearsed failure" in done.stderr
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


def test_devices_that_hang_are_given_up_and_do_not_keep_the_process(bench):
    bench.environment["WATCHED_HANGS"] = "camera.read mobile_tweezers.safe_state"
    short = ("--set", "profile.timeouts.call=0.3 s", "--set", "profile.timeouts.safe_state=0.3 s")
    done = bench.run_apart("run", "sequence.yaml", "--shots", "1", *short)
    assert safe_calls(bench.calls()) == SAFE_ORDER
    assert done.returncode == 3
    assert "camera: read() did not answer within" in done.stderr
    failures = [e["values"]["device"] for e in bench.events("safe_state") if not e["values"]["ok"]]
    assert failures == ["mobile_tweezers"]


def test_after_a_run_that_was_killed_the_next_makes_the_devices_safe_first(bench):
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
    done = bench.run("run", "sequence.yaml", "--shots", "1", "--output", "there")
    assert done.returncode == 0, done.stderr
    assert "died" in done.stderr + done.stdout
    assert safe_calls(bench.calls()) == SAFE_ORDER * 2
    first_start = bench.calls().index("static_tweezers.start")
    assert bench.calls().index("mobile_tweezers.safe_state") < first_start
    bench.log.unlink()
    bench.run("run", "sequence.yaml", "--shots", "1", "--output", "there")
    assert safe_calls(bench.calls()) == SAFE_ORDER


def test_the_safe_command(bench):
    done = bench.run("safe", "watched.yaml")
    assert done.returncode == 0, done.stderr
    assert safe_calls(bench.calls()) == SAFE_ORDER
    closed = [call for call in bench.calls() if call.endswith(".close")]
    assert sorted(closed) == sorted(call.replace("safe_state", "close") for call in SAFE_ORDER)
    bench.environment["WATCHED_FAILS"] = "camera.open"
    done = bench.run("safe", "watched.yaml")
    assert done.returncode == 3
    assert "camera" in done.stdout + done.stderr
    bench.environment["WATCHED_FAILS"] = "camera.close"
    done = bench.run("safe", "watched.yaml")
    assert done.returncode == 0
    assert "could not be closed: camera: close() raised RuntimeError" in done.stdout
