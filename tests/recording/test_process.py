from __future__ import annotations

import subprocess
import sys
from dataclasses import asdict, replace

from labseq.recording.folders import Owner


def test_this_process_lives_here() -> None:
    owner = Owner.current()
    assert owner.is_here
    assert owner.lives


def test_it_comes_back_from_plain_values() -> None:
    owner = Owner.current()
    assert Owner.from_plain(asdict(owner)) == owner
    assert Owner.from_plain({}) is None
    assert Owner.from_plain({"pid": "12"}) is None
    assert Owner.from_plain({"pid": -1}) is None


def test_a_process_that_ended_does_not_live() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        owner = replace(Owner.current(), pid=child.pid, started="")
        assert owner.lives
    assert not owner.lives


def test_a_killed_process_that_nobody_has_waited_for_does_not_live() -> None:
    code = "print(flush=True); input()"
    child = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with child:
        assert child.stdout is not None
        child.stdout.readline()
        child.kill()
        child.stdout.read()  # ends when the child's descriptors are closed, which is when it dies
        owner = replace(Owner.current(), pid=child.pid, started="")
        for _ in range(100_000):  # its state changes a moment later
            if not owner.lives:
                break
        assert not owner.lives


def test_a_later_process_of_the_same_number_is_another_one() -> None:
    owner = replace(Owner.current(), started="long ago")
    assert not owner.lives or not Owner.current().started


def test_an_impossible_number_is_no_process() -> None:
    assert not replace(Owner.current(), pid=2**40).lives


def test_another_computer_is_not_here() -> None:
    assert not replace(Owner.current(), host="another").is_here
