"""Times from the death or hang of a process to its outputs being off, by device and cause.

A shutter on a serial line, a timing box, a card in each of its modes and a radio, all of them simulated in
processes of their own that note when they were switched off. The radio ramps for 10 ms, after the 20 ms that
it has buffered. `python -m tests.benchmarks.time_to_off --repeats 200 --load 2` takes half an hour.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
from pathlib import Path

from tests.plugins.outputs_rig import CARDS, CAUSES, outputs

DEVICES = ("shutter", "lines", "radio", *CARDS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=200, help="of each cause")
    parser.add_argument("--load", type=int, default=0, help="processes that compute meanwhile")
    parser.add_argument("--devices", nargs="+", choices=DEVICES, default=DEVICES)
    parser.add_argument("--causes", nargs="+", choices=[*CAUSES], default=[*CAUSES])
    options = parser.parse_args()
    load = [multiprocessing.Process(target=_compute, daemon=True) for _ in range(options.load)]
    for process in load:
        process.start()
    print(f"{options.repeats} repeats, {options.load} processes that compute; times in ms")
    print(f"{'cause':10} {'device':10} {'median':>7} {'p99':>7} {'worst':>7} {'not off':>7}")
    for cause in options.causes:
        times: dict[str, list[float]] = {name: [] for name in options.devices}
        with tempfile.TemporaryDirectory() as folder, outputs(Path(folder), options.devices) as devices:
            for _ in range(options.repeats):
                for name, time_s in devices.times_to_off(cause).items():
                    times[name].append(1e3 * time_s)
        for name, found in times.items():
            _print_row(cause, name, sorted(found), options.repeats)


def _print_row(cause: str, name: str, found: list[float], n: int) -> None:
    ranks = (len(found) // 2, int(0.99 * (len(found) - 1) + 0.5), len(found) - 1)
    numbers = " ".join(f"{found[rank]:7.1f}" for rank in ranks) if found else " " * 23
    print(f"{cause:10} {name:10} {numbers} {n - len(found):7d}", flush=True)


def _compute() -> None:
    while True:
        sum(range(100_000))


if __name__ == "__main__":
    main()
