"""Draw the pictures of `labseq web`: real runs in the virtual lab, in a headless Chromium.

    python docs/make_web_pictures.py

Needs Debian's chromium. The runs have seeds; what the computer took for each stage differs from time to time.
"""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

DOCS = Path(__file__).parent
ROOT = DOCS.parent
FOLDER = DOCS / "_static" / "web"
SHOTS = 200
TAKEN = 137
"""Shots that are over on the picture of a run in progress."""
PICTURES = {
    # name: page, theme, width, height
    "now": ("/now", "dark", 1440, 900),
    "wall": ("/now?wall=1", "dark", 1600, 900),
    "shot": ("/runs/{compact}/shots/2", "light", 1280, 800),
    "scan": ("/scan?run={scan}", "light", 1280, 560),
    "fit": ("/scan?run={lifetime}", "light", 1280, 640),
    "phone": ("/now", "light", 390, 844),
}
PART_WAY = "one => { one.value = 0.7 * one.min + 0.3 * one.max; one.dispatchEvent(new Event('input')); }"
"""Moves the slider of a player."""


def run(data: Path, sequence: str, *options: str) -> Path:
    """Take a run, and return its folder."""
    path, profile = ROOT / "sequences" / f"{sequence}.yaml", ROOT / "hardware_profiles" / "virtual.yaml"
    before = {*data.glob("*/*")}
    command = [
        sys.executable,
        "-m",
        "labseq",
        "run",
        str(path),
        "--profile",
        str(profile),
        f"--output={data}",
    ]
    subprocess.run([*command, "--json", *options], check=True, capture_output=True)  # noqa: S603
    (found,) = {*data.glob("*/*")} - before
    return found


@contextmanager
def serving(data: Path) -> Generator[str]:
    """A server of the data folder."""
    command = [sys.executable, "-m", "labseq", "web", str(data), "--port=0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:  # noqa: S603
        assert server.stdout is not None
        yield server.stdout.readline().strip().rstrip("/")
        server.terminate()


def stop_in_the_middle(folder: Path) -> None:
    """Leave a run as it was after its first shots, this process being the one that takes it."""
    from labseq.recording.run_file import encode_state

    index = folder / "index.jsonl"
    index.write_bytes(b"".join(index.read_bytes().splitlines(keepends=True)[:TAKEN]))
    events = (folder / "events.jsonl").read_bytes().splitlines(keepends=True)
    ends = [i for i, line in enumerate(events) if b'"shot_finished"' in line]
    (folder / "events.jsonl").write_bytes(b"".join(events[: ends[TAKEN - 1] + 2]))
    (folder / "STATE").write_bytes(encode_state("running"))


def take(folder: Path = FOLDER, names: tuple[str, ...] = tuple(PICTURES), shots: int = SHOTS) -> None:
    """Take the runs, and their pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("LABSEQ_STATE", tempfile.gettempdir())
    with tempfile.TemporaryDirectory() as home, sync_playwright() as started:
        data = Path(home) / "data"
        data.mkdir()
        run(data, "kagome", "--shots=12", "--seed=3")
        lifetime, scan = run(data, "lifetime", "--seed=1"), run(data, "scan_dop", "--seed=2")
        compact = run(data, "compact_225", f"--shots={shots}", "--seed=1")
        stop_in_the_middle(compact)
        folders = {"scan": scan, "lifetime": lifetime, "compact": compact}
        runs = {name: f"{folder.parent.name}/{folder.name}" for name, folder in folders.items()}
        chromium: Any = started.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        with serving(data) as address:
            for name in names:
                page_of, theme, width, height = PICTURES[name]
                page = chromium.new_page(
                    viewport={"width": width, "height": height}, color_scheme=theme, device_scale_factor=1.25
                )
                page.goto(address + page_of.format(**runs))
                page.locator("main[aria-busy='false'] h1").first.wait_for()
                if name == "fit":
                    page.locator(".fit-line strong").wait_for()
                if name == "shot":
                    page.get_by_role("button", name="Play cycle 0").click()
                    page.locator(".player input").evaluate(PART_WAY)
                page.wait_for_timeout(1500)  # frames are loaded one by one
                picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
                picture.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
                    folder / f"{name}.png", optimize=True
                )
                page.close()
        chromium.close()


if __name__ == "__main__":
    take()
