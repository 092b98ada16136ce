"""``poe fuzz``: many damaged files; none may end a command otherwise than with an error that names it.

Each file is read in a process that is limited in time and memory. The system ends it at its limit, even in
a loop of a C library. A failure prints what repeats it: the kind, the seed and the number of the file, and
the file is kept.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import io
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Any, Final

from labseq.errors import LabseqError
from labseq.recording.doctor import Report, examine
from tests.fuzz.cases import KINDS, Templates, damage_run, make_case

LIMIT_S: Final = 20.0
"""Longest time of the processor for a file: 5 s for each of the four times that a run is read.

A file for which a process waits has ten times as long.
"""
MEMORY: Final = 1 << 30
BATCH: Final = 20
_TIMERS: Final = {
    signal.SIGPROF: (signal.ITIMER_PROF, LIMIT_S),
    signal.SIGALRM: (signal.ITIMER_REAL, 10 * LIMIT_S),
}


def main() -> int:
    """Read the files; the exit code is 1 if one of them did harm."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=20_000)
    parser.add_argument("--runs", type=int, default=2_000)
    parser.add_argument(
        "--doctor", type=int, default=0, help="damaged runs in one data folder for one doctor"
    )
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=[k for k in KINDS if k != "run"])
    parser.add_argument("--only", nargs=2, metavar=("KIND", "NUMBER"), help="repeat one")
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "labseq-fuzz")
    arguments = parser.parse_args()
    cases = [(arguments.kinds[n % len(arguments.kinds)], n) for n in range(arguments.files)]
    cases += [("run", n) for n in range(arguments.runs)]
    if arguments.only:
        cases = [(arguments.only[0], int(arguments.only[1]))]
    shutil.rmtree(arguments.keep, ignore_errors=True)
    os.environ |= {
        "LABSEQ_STATE": str(arguments.keep / "state"),
        "LABSEQ_LOCKS": str(arguments.keep / "locks"),
    }
    results = Results(arguments.keep, arguments.seed)
    results.read(cases)
    results.print()
    if arguments.doctor:
        results.examine(arguments.doctor)
    return 1 if results.failures else 0


class Results:
    """Reads damaged files, each in a process of limited time and memory, and counts what happens.

    Args:
        folder: Gets the files that did harm.
        seed: Of all random numbers.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.failures: list[tuple[str, str]] = []
        self._folder, self._seed = folder, seed
        self._templates = Templates(folder)
        self._counts: Counter[str] = Counter()
        self._slowest: dict[str, tuple[float, int]] = {}
        self._peak: dict[str, int] = {}

    def read(self, cases: list[tuple[str, int]]) -> None:
        """Read the files with these kinds and numbers."""
        for kind in {kind for kind, _ in cases}:  # imports take place here, once
            read_one(kind, -1, 0, self._templates, self._new_folder(kind, -1))
        with contextlib.suppress(KeyboardInterrupt):  # the table then is of what was read
            while cases:
                cases = self._in_a_child(cases[:BATCH]) + cases[BATCH:]

    def examine(self, n_runs: int) -> None:
        """Let the doctor look at many damaged runs, repair them, and look again."""
        data = self._new_folder("doctor", n_runs)
        for number in range(n_runs):
            run_dir = data / f"2026-11-{1 + number // 100:02}" / f"{number:04}_damaged"
            shutil.copytree(self._templates.run_dir, run_dir)
            damage_run(random.Random(f"{self._seed}/doctor/{number}"), run_dir)
        sys.stdout.flush()
        for what in ("dry run", "repair", "again"):
            if (pid := os.fork()) == 0:
                _examine(data, what)
                os._exit(0)
            if status := os.waitpid(pid, 0)[1]:
                self._fail("doctor", n_runs, f"the {what} ended with {os.waitstatus_to_exitcode(status)}")

    def print(self) -> None:
        """Print the table."""
        print(f"\n{'kind':12} {'files':>6} {'failures':>8} {'slowest':>9} {'number':>7} {'memory':>8}")
        failures = Counter(kind for kind, _ in self.failures)
        for kind in self._counts:
            slowest_s, number = self._slowest.get(kind, (0.0, 0))
            one = f"{kind:12} {self._counts[kind]:6} {failures[kind]:8} {slowest_s:7.2f} s {number:7}"
            print(f"{one} {self._peak.get(kind, 0):5} MB")
        print(f"seed {self._seed}")

    def _in_a_child(self, batch: list[tuple[str, int]]) -> list[tuple[str, int]]:
        """Read a batch in a process of its own; returns what is left if a file ended that process."""
        receive, send = os.pipe()
        sys.stdout.flush()
        if (pid := os.fork()) == 0:
            os.close(receive)
            try:
                with os.fdopen(send, "w", buffering=1) as report:
                    self._read_batch(batch, report)
                os._exit(0)
            except BaseException:  # noqa: BLE001 - the caller must not go on twice
                traceback.print_exc()
                os._exit(1)
        os.close(send)
        with os.fdopen(receive) as report:
            lines = report.read().splitlines()
        _, status = os.waitpid(pid, 0)
        for line in lines:
            kind, number, seconds, memory, *error = line.split(" ", 4)
            self._counts[kind] += 1
            self._slowest[kind] = max(self._slowest.get(kind, (0.0, 0)), (float(seconds), int(number)))
            self._peak[kind] = max(self._peak.get(kind, 0), int(memory))
            if error:
                self._fail(kind, int(number), error[0])
        if status == 0:
            return []
        kind, number = batch[len(lines)]
        self._counts[kind] += 1
        code = os.waitstatus_to_exitcode(status)
        what = "a hang" if -code in _TIMERS else "a crash"
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        self._fail(kind, number, f"{what}: it ended the process ({how})")
        return batch[len(lines) + 1 :]

    def _fail(self, kind: str, number: int, error: str) -> None:
        self.failures.append((kind, error))
        print(f"{kind} {number}: {error}")
        print(f"  repeat: poe fuzz --seed {self._seed} --only {kind} {number}", flush=True)

    def _new_folder(self, kind: str, number: int) -> Path:
        folder = self._folder / f"{kind}_{number}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        return folder

    def _read_batch(self, batch: list[tuple[str, int]], report: Any) -> None:
        _limit_memory()
        for one in _TIMERS:
            signal.signal(one, signal.SIG_DFL)  # no handler of Python is called in a loop of C
            faulthandler.register(one, chain=True)  # prints where it is; then the system ends the process
        for kind, number in batch:
            folder = self._new_folder(kind, number)
            start_s = time.perf_counter()
            for timer, limit_s in _TIMERS.values():
                signal.setitimer(timer, limit_s)
            error = read_one(kind, number, self._seed, self._templates, folder)
            for timer, _ in _TIMERS.values():
                signal.setitimer(timer, 0.0)
            if not error:
                shutil.rmtree(folder)
            took = f"{time.perf_counter() - start_s:.3f} {_peak_mb():.0f}"
            report.write(f"{kind} {number} {took}{error and f' {error}'}\n")


def read_one(kind: str, number: int, seed: int, templates: Templates, folder: Path) -> str:
    """Read a file; returns what went wrong, or ""."""
    case = make_case(kind, random.Random(f"{seed}/{kind}/{number}"), templates, folder)
    os.environ["LABSEQ_DATA"] = str(folder)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            case.read()
    except LabseqError as error:
        text = str(error)
        if any(not (char.isprintable() or char == "\n") for char in text) or len(text) > 100_000:
            return f"an error that cannot be printed: {text[:200]!r}"
    except BaseException as error:  # noqa: BLE001 - every kind is a failure
        place = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {str(error)[:100]!r} in {place.filename}:{place.lineno}"
    return ""


def _examine(data: Path, what: str) -> None:
    """Let the doctor look at the folder, or repair its runs one by one; prints time and memory."""
    _limit_memory()
    start_s, slowest = time.perf_counter(), (0.0, "")
    if what == "repair":
        reports = list[Report]()
        for run_dir in sorted(data.glob("*/*_damaged")):
            began_s = time.process_time()
            reports.append(examine(run_dir))
            slowest = max(slowest, (time.process_time() - began_s, run_dir.name))
    else:
        reports = [examine(data, dry_run=True)]
    findings = [one for report in reports for one in report.findings]
    print(
        f"doctor, {what}: {len(findings)} findings, {sum(one.left for one in findings)} left; "
        f"{time.perf_counter() - start_s:.1f} s, most of the processor {slowest[0]:.2f} s {slowest[1]}; "
        f"{_peak_mb():.0f} MB",
        flush=True,
    )


def _limit_memory() -> None:
    limit = _address_space() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _peak_mb() -> float:
    """Most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _address_space() -> int:
    with contextlib.suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    return 8 << 30


if __name__ == "__main__":
    sys.exit(main())
