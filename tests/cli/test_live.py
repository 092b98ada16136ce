from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from rich.console import Console

from labseq.cli.live import REDRAW_S, LiveView, observer_for
from labseq.console.output import LogLines


class Screen(io.TextIOWrapper):
    """A terminal of any encoding that counts how often it is drawn to."""

    def __init__(self, encoding: str = "utf-8", tty: bool = True) -> None:
        super().__init__(io.BytesIO(), encoding, write_through=True, newline="")
        self.tty = tty

    def isatty(self) -> bool:
        return self.tty

    @property
    def text(self) -> str:
        raw: Any = self.buffer
        return raw.getvalue().decode(self.encoding)


class ResolvedProfile:
    """A live view on a screen, with a clock that is set by hand."""

    def __init__(self, encoding: str = "utf-8", size: tuple[int, int] = (110, 26)) -> None:
        self.now = 0.0
        self.screen = Screen(encoding)
        width, height = size
        console = Console(
            file=self.screen, force_terminal=True, width=width, height=height, legacy_windows=False
        )
        self.view = LiveView(console, lambda: self.now)

    def play(self, events: Any) -> None:
        for name, values in events:
            self.view.event(name, values)

    def drawings(self, name: str, values: Any, after_s: float = REDRAW_S) -> int:
        """How often an event, so long after the last, makes the screen be drawn."""
        before = self.screen.text.count("shots")
        self.now += after_s
        self.view.event(name, values)
        return self.screen.text.count("shots") - before


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "ascii", "cp437"])
@pytest.mark.parametrize("size", [(110, 26), (80, 24), (40, 8)])
def test_a_run_is_shown_on_any_screen(fake: Any, encoding: str, size: tuple[int, int]) -> None:
    bench = ResolvedProfile(encoding, size)
    bench.play(fake.script(fake.run()))
    text = bench.screen.text
    assert "data/2026-01-02/0001_compact-225" in text
    assert "2/20 shots" in text
    assert text.endswith("\x1b[?25h"), "the cursor is back"
    assert ("±" in text) is (encoding == "utf-8")


def test_stdout_is_given_back(fake: Any) -> None:
    before = sys.stdout, sys.stderr
    bench = ResolvedProfile()
    events = iter(fake.script(fake.run()))
    for name, values in events:
        bench.view.event(name, values)
        if name == "shot_started":
            break
    assert sys.stdout is not before[0]
    bench.view.close()
    bench.view.close()
    assert (sys.stdout, sys.stderr) == before


def test_it_is_drawn_at_most_four_times_a_second(fake: Any) -> None:
    bench = ResolvedProfile()
    run = fake.run()
    bench.play([("run_starting", {"record": run, "run_dir": "x"})])
    image = {"image": fake.image(run.target.fill, 1), "filling_fraction": 1.0}
    assert bench.drawings("image", image) == 1
    assert bench.drawings("image", image, after_s=0.9 * REDRAW_S) == 0
    assert bench.drawings("image", image, after_s=0.1 * REDRAW_S) == 1


def test_with_real_hardware_it_is_drawn_between_shots_only(fake: Any) -> None:
    bench = ResolvedProfile()
    run = fake.run(simulated=False)
    bench.play([("run_starting", {"record": run, "run_dir": "x"})])
    image = {"image": fake.image(run.target.fill, 1), "filling_fraction": 1.0}
    assert bench.drawings("image", image) == 0
    assert bench.drawings("state", {"state": "making safe"}) == 0
    assert bench.drawings("shot_finished", {"shot": fake.shot()}) == 1


def test_what_must_be_seen_stays_on_the_screen(fake: Any) -> None:
    bench = ResolvedProfile()
    bench.play([("run_starting", {"record": fake.run(), "run_dir": "x"})])
    bench.play([("warning", {"text": "the [laser] is warm"})])
    bench.play([("safe_state", {"device": "camera", "ok": False, "error": "camera: mute"})])
    bench.view.close()
    assert bench.screen.text.count("warning: the [laser] is warm") == 1
    assert (
        bench.screen.text.count("warning: camera could not be brought to its safe state: camera: mute") == 1
    )


def test_the_screen_is_given_back_even_if_drawing_fails(fake: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = ResolvedProfile()
    bench.play([("run_starting", {"record": fake.run(), "run_dir": "x"})])
    before = sys.stdout

    def fail(*_: Any) -> Any:
        raise ValueError("broken")

    monkeypatch.setattr("labseq.cli.live.draw", fail)
    with pytest.raises(ValueError, match="broken"):
        bench.view.close()
    assert sys.stdout is not before
    assert bench.screen.text.endswith("\x1b[?25h")


def test_export_svg_needs_nothing_from_elsewhere(fake: Any, tmp_path: Path) -> None:
    bench = ResolvedProfile("ascii")
    bench.play(fake.script(fake.run()))
    bench.view.export_svg(tmp_path / "run.svg")
    text = (tmp_path / "run.svg").read_text("utf-8")
    ET.fromstring(text)
    assert "url(http" not in text.replace('"', "")
    assert text.count("●") >= 225


@pytest.mark.parametrize(
    ("tty", "term", "live"),
    [(True, "xterm-256color", True), (True, "dumb", False), (False, "xterm-256color", False)],
)
def test_the_view_is_for_terminals(tty: bool, term: str, live: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", term)
    monkeypatch.setenv("FORCE_COLOR", "1")
    observer = observer_for(Screen(tty=tty))
    assert isinstance(observer, LiveView if live else LogLines)
