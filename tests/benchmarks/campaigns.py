"""Time for the shots of a campaign: one run, and two runs that share them, at once and in turn.

python -m tests.benchmarks.campaigns --shots 300
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

CAMPAIGN = """labseq: 1
sequence: compact_225
axes: {shot.2.rearrange.stop_when: [never]}
seed: 1
"""
CASES = {"one run": (1, 1), "two runs in turn": (2, 1), "two runs at once": (2, 2)}
"""Name -> number of runs, and of processes."""


def main() -> None:
    """Print wall and processor time of whole commands, each relative to one run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--shots", type=int, default=300)
    parser.add_argument("--repeats", type=int, default=2, help="the fastest counts")
    arguments = parser.parse_args()
    best: dict[str, tuple[float, float]] = {}
    for _ in range(arguments.repeats):
        for name, (n_runs, n_workers) in CASES.items():
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder, "campaign.yaml")
                file.write_text(f"{CAMPAIGN}repeats: {arguments.shots}\nruns: {n_runs}\n", encoding="utf-8")
                command = [sys.executable, "-m", "labseq", "campaign", "run", str(file)]
                command += ["--output", str(Path(folder, "data")), f"--workers={n_workers}"]
                before, start_s = os.times(), time.perf_counter()
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                wall_s, after = time.perf_counter() - start_s, os.times()
            cpu_s = after.children_user + after.children_system
            cpu_s -= before.children_user + before.children_system
            best[name] = min(best.get(name, (wall_s, cpu_s)), (wall_s, cpu_s))
    wall_s, cpu_s = best["one run"]
    for name, (wall, cpu) in best.items():
        print(
            f"{name:17} {wall:5.1f} s ({wall_s / wall:.2f} times as fast), {cpu:5.1f} s of processor time "
            f"({cpu / cpu_s:.2f} times as much)"
        )


if __name__ == "__main__":
    main()
