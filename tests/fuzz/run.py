"""``poe fuzz``: many damaged files; none may end a command otherwise than with an error that names it.

Each file is read in a process that is limited in time and memory. A failure prints what repeats it: the
kind, the seed and the number of the file, and the file is kept.
"""

from __future__ import annotations

import argparse
import contextlib
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
from tests.fuzz.cases import KINDS, Templates, make_case

LIMIT_S: Final = 5.0
"""Longest time of the processor for a file; a file for which a process waits has ten times as long."""
MEMORY: Final = 1 << 30
BATCH: Final = 20


def main() -> int:
    """Read the files; the exit code is 1 if one of them did harm."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=20_000)
    parser.add_argument("--runs", type=int, default=2_000)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--only", nargs=2, metavar=("KIND", "NUMBER"), help="repeat one")
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "labseq-fuzz")
    arguments = parser.parse_args()
    shutil.rmtree(arguments.keep, ignore_errors=True)
    arguments.keep.mkdir(parents=True)
    os.environ["LABSEQ_STATE"] = str(arguments.keep / "state")
    templates = Templates(arguments.keep)
    kinds = [kind for kind in KINDS if kind != "run"]
    cases = [(kinds[n % len(kinds)], n) for n in range(arguments.files)]
    cases += [("run", n) for n in range(arguments.runs)]
    if arguments.only:
        cases = [(arguments.only[0], int(arguments.only[1]))]
    for kind in KINDS:  # imports take place here, once
        read_one(kind, -1, 0, templates, Path(tempfile.mkdtemp(dir=arguments.keep)))
    failures: Counter[str] = Counter()
    slowest: dict[str, float] = {}
    while cases:
        batch, cases = cases[:BATCH], cases[BATCH:]
        left = _in_a_child(batch, arguments, templates, failures, slowest)
        cases = left + cases
    counts = Counter(KINDS[n % len(kinds)] for n in range(arguments.files)) + Counter({"run": arguments.runs})
    print(f"\n{'kind':12} {'files':>6} {'failures':>8} {'slowest':>8}")
    for kind in KINDS:
        print(f"{kind:12} {counts[kind]:6} {failures[kind]:8} {slowest.get(kind, 0.0):6.2f} s")
    print(f"seed {arguments.seed}")
    return 1 if failures else 0


def _in_a_child(
    batch: list[tuple[str, int]],
    arguments: argparse.Namespace,
    templates: Templates,
    failures: Counter[str],
    slowest: dict[str, float],
) -> list[tuple[str, int]]:
    """Read a batch in a process of its own; returns what is left if a file ended that process."""
    receive, send = os.pipe()
    sys.stdout.flush()
    if (pid := os.fork()) == 0:
        os.close(receive)
        with os.fdopen(send, "w", buffering=1) as report:
            _read_batch(batch, arguments, templates, report)
        os._exit(0)
    os.close(send)
    with os.fdopen(receive) as report:
        lines = report.read().splitlines()
    _, status = os.waitpid(pid, 0)
    for line in lines:
        kind, number, seconds, *error = line.split(" ", 3)
        slowest[kind] = max(slowest.get(kind, 0.0), float(seconds))
        if error:
            failures[kind] += 1
            print(f"{kind} {number}: {error[0]}")
            print(f"  repeat: poe fuzz --seed {arguments.seed} --only {kind} {number}")
    if status == 0:
        return []
    kind, number = batch[len(lines)]
    failures[kind] += 1
    print(
        f"{kind} {number}: ended the process ({os.waitstatus_to_exitcode(status)}), --seed {arguments.seed}"
    )
    return batch[len(lines) + 1 :]


def _read_batch(batch: list[tuple[str, int]], arguments: Any, templates: Templates, report: Any) -> None:
    limit = _address_space() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for kind, number in batch:
        folder = Path(tempfile.mkdtemp(dir=arguments.keep))
        start_s = time.perf_counter()
        error = read_one(kind, number, arguments.seed, templates, folder)
        if error:
            folder.rename(arguments.keep / f"{kind}_{number}")
        else:
            shutil.rmtree(folder)
        report.write(f"{kind} {number} {time.perf_counter() - start_s:.3f}{error and f' {error}'}\n")


def read_one(kind: str, number: int, seed: int, templates: Templates, folder: Path) -> str:
    """Read a file within the limit of time; returns what went wrong, or ""."""
    case = make_case(kind, random.Random(f"{seed}/{kind}/{number}"), templates, folder)
    os.environ["LABSEQ_DATA"] = str(folder)

    def too_slow(*_: object) -> None:
        raise TimeoutError(f"it takes longer than {LIMIT_S:g} s")

    timers = {
        signal.SIGALRM: (signal.ITIMER_REAL, 10 * LIMIT_S),
        signal.SIGPROF: (signal.ITIMER_PROF, LIMIT_S),
    }
    before = {one: signal.signal(one, too_slow) for one in timers}
    for timer, limit_s in timers.values():
        signal.setitimer(timer, limit_s)
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
    finally:
        for one, (timer, _) in timers.items():
            signal.setitimer(timer, 0.0)
            signal.signal(one, before[one])
    return ""


def _address_space() -> int:
    with contextlib.suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    return 8 << 30


if __name__ == "__main__":
    sys.exit(main())
