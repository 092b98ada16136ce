"""Times from the death or hang of a process to its outputs being off, by device and cause.

A shutter on a serial line and a timing box, each simulated in a process of its own that logs when it was
switched off. `python tests/benchmarks/time_to_off.py --repeats 200 --load 2` takes some 10 minutes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.plugins.outputs_rig import CAUSES, outputs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=200, help="of each cause")
    parser.add_argument("--load", type=int, default=0, help="processes that compute meanwhile")
    options = parser.parse_args()
    load = [multiprocessing.Process(target=_compute, daemon=True) for _ in range(options.load)]
    for process in load:
        process.start()
    print(f"{options.repeats} repeats, {options.load} processes that compute; times in ms")
    print(f"{'cause':10} {'device':10} {'median':>7} {'p99':>7} {'worst':>7} {'not off':>7}")
    for cause in CAUSES:
        times: dict[str, list[float]] = {"shutter": [], "lines": []}
        with tempfile.TemporaryDirectory() as folder, outputs(Path(folder)) as devices:
            for _ in range(options.repeats):
                for name, time_s in devices.times_to_off(cause).items():
                    times[name].append(1e3 * time_s)
        for name, found in times.items():
            found.sort()
            shown = (
                [found[len(found) // 2], found[int(0.99 * (len(found) - 1) + 0.5)], found[-1]]
                if found
                else []
            )
            numbers = " ".join(f"{one:7.1f}" for one in shown)
            print(f"{cause:10} {name:10} {numbers} {options.repeats - len(found):7d}", flush=True)


def _compute() -> None:
    while True:
        sum(range(100_000))


if __name__ == "__main__":
    main()
