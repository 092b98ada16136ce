from __future__ import annotations

import io
import sys
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, strategies as st
from rich.console import Console

from labseq.cli.live import REDRAW_S, LiveView, Picture, Tally, draw_scan, observer_for
from labseq.console.arrays import ASCII, UNICODE
from labseq.console.events import LogLines
from labseq.model import StageTiming

from .conftest import make_row, make_run


@pytest.fixture(autouse=True)
def own_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    """A view that a test leaves open keeps stdout and stderr, but no longer than the test."""
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    monkeypatch.setattr(sys, "stderr", sys.stderr)


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


class Terminal:
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


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "ascii"])
@pytest.mark.parametrize("size", [(110, 26), (40, 8)])
def test_a_run_is_shown_on_any_screen(fake: Any, encoding: str, size: tuple[int, int]) -> None:
    terminal = Terminal(encoding, size)
    terminal.play(fake.script(fake.run()))
    text = terminal.screen.text
    assert "data/2026-01-02/0001_compact-225" in text
    assert "2/20 shots" in text
    assert text.endswith("\x1b[?25h"), "the cursor is back"
    assert ("●" in text) is (encoding == "utf-8" and size[0] > 40)


def test_stdout_is_given_back(fake: Any) -> None:
    before = sys.stdout, sys.stderr
    terminal = Terminal()
    events = iter(fake.script(fake.run()))
    for name, values in events:
        terminal.view.event(name, values)
        if name == "shot_started":
            break
    assert sys.stdout is not before[0]
    terminal.view.close()
    terminal.view.close()
    assert (sys.stdout, sys.stderr) == before


def test_the_view_is_drawn_at_most_four_times_a_second(fake: Any) -> None:
    terminal = Terminal()
    run = fake.run()
    terminal.play([("run_starting", {"record": run, "run_dir": "x"})])
    image = {"image": fake.image(run.target.fill, 1), "filling_fraction": 1.0}
    assert terminal.drawings("image", image) == 1
    assert terminal.drawings("image", image, after_s=0.9 * REDRAW_S) == 0
    assert terminal.drawings("image", image, after_s=0.1 * REDRAW_S) == 1


def test_with_real_hardware_it_is_drawn_between_shots_only(fake: Any) -> None:
    terminal = Terminal()
    run = fake.run(simulated=False)
    terminal.play([("run_starting", {"record": run, "run_dir": "x"})])
    image = {"image": fake.image(run.target.fill, 1), "filling_fraction": 1.0}
    assert terminal.drawings("image", image) == 0
    assert terminal.drawings("state", {"state": "making safe"}) == 0
    assert terminal.drawings("shot_finished", {"row": fake.row()}) == 1


def test_warnings_stay_on_the_screen(fake: Any) -> None:
    terminal = Terminal()
    terminal.play([("run_starting", {"record": fake.run(), "run_dir": "x"})])
    terminal.play([("warning", {"text": "the [laser] is warm"})])
    terminal.play([("safe_state", {"device": "camera", "ok": False, "error": "camera: mute"})])
    terminal.view.close()
    assert terminal.screen.text.count("warning: the [laser] is warm") == 1
    assert (
        terminal.screen.text.count("warning: camera could not be brought to its safe state: camera: mute")
        == 1
    )


def test_the_screen_is_given_back_even_if_drawing_fails(fake: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    terminal.play([("run_starting", {"record": fake.run(), "run_dir": "x"})])
    before = sys.stdout

    def fail(*_: Any) -> Any:
        raise ValueError("broken")

    monkeypatch.setattr(Tally, "time_left_s", property(fail))
    with pytest.raises(ValueError, match="broken"):
        terminal.view.close()
    assert sys.stdout is not before
    assert terminal.screen.text.endswith("\x1b[?25h")


@pytest.mark.parametrize(
    ("tty", "term", "live"),
    [(True, "xterm-256color", True), (True, "dumb", False), (False, "xterm-256color", False)],
)
def test_the_view_is_for_terminals(tty: bool, term: str, live: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", term)
    monkeypatch.setenv("FORCE_COLOR", "1")
    observer = observer_for(Screen(tty=tty))
    assert isinstance(observer, LiveView if live else LogLines)


RECENT = ["first", "second", "third"]


def tally_of(fake: Any, run: Any, n_shots: int = 2) -> Tally:
    tally = Tally(lambda: 0.0)
    for name, values in fake.script(run, n_shots=n_shots):
        if name != "run_finished":
            tally.add(name, values)
    return tally


def picture(tally: Tally, width: int, height: int, glyphs: Any = UNICODE, recent: Any = RECENT) -> list[str]:
    console = Console(file=io.StringIO(), width=width, height=height, color_system=None)
    console.print(Picture(tally, recent, glyphs))
    return [line.rstrip() for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]


@pytest.mark.parametrize("size", [(200, 60), (107, 24), (80, 20), (60, 24), (20, 5), (8, 2)])
@pytest.mark.parametrize(("n", "glyphs"), [(20, UNICODE), (60, UNICODE), (20, ASCII)])
def test_a_picture_never_exceeds_the_terminal(fake: Any, size: tuple[int, int], n: int, glyphs: Any) -> None:
    lines = picture(tally_of(fake, fake.run(target=fake.target(n))), *size, glyphs)
    assert len(lines) < size[1]
    assert max(map(len, lines)) <= size[0]


def test_80_columns_cut_no_head_and_no_number(fake: Any) -> None:
    tally = tally_of(fake, fake.run(n_shots=10_000))
    for _ in range(1000):
        tally.add("stage", {"timing": StageTiming("read_out", 2, 0, 0.0, 43.1e-3, 12.9e-3, 2.89e-3)})
    recent = ["shot 3  window 30 ms" + 2 * "  1 defect (defect-free after 3 cycles)"]
    lines = picture(tally, 80, 40, recent=recent)
    text = "\n".join(" ".join(line.split()) for line in lines)
    assert "stage host p99 modelled budget over\n" in text
    assert "read_out 12.9 ms 12.9 ms 43.1 ms 2.89 ms 1000\n" in text
    assert text.count("after 3 cycles)") == 2
    tally.best = "0.98578, point 2 (15, 242.5 um/ms, another value)"
    text = "\n".join(picture(tally, 80, 24))
    assert "seen defect-free  2 of 2" in text
    assert "best so far       0.98578, point 2" in text


def test_a_wide_terminal_shows_everything(fake: Any) -> None:
    lines = picture(tally_of(fake, fake.run()), 120, 30)
    text = "\n".join(lines)
    assert lines[0].startswith("compact-225  ━━━━━━")
    assert "2/20 shots" in lines[0]
    assert "defect-free       2 of 2 (100.0 %), 65-100 %" in text
    assert "filling           100 %" in text
    assert text.count("● " * 14 + "●") == 15
    assert "shot 1, image of cycle 1:" in text
    assert lines[-3:] == RECENT


@pytest.mark.parametrize(
    ("size", "drawn"),
    [((120, 30), "● ● ●"), ((80, 24), "●●●"), ((80, 16), "███"), ((70, 24), None)],
)
def test_the_array_shrinks_before_it_goes(fake: Any, size: tuple[int, int], drawn: str | None) -> None:
    text = "\n".join(picture(tally_of(fake, fake.run()), *size))
    sizes = [candidate for candidate in ("● ● ●", "●●●", "███") if candidate in text]
    assert sizes == ([drawn] if drawn else [])
    assert "defect-free" in text


def test_on_real_hardware_there_is_one_clock(fake: Any) -> None:
    for simulated, heads in (
        (True, "stage host p99 modelled budget over"),
        (False, "stage p50 p99 budget over"),
    ):
        lines = picture(tally_of(fake, fake.run(simulated=simulated)), 120, 30)
        assert [line for line in lines if heads in " ".join(line.split())]


def test_a_defect_and_a_surplus_atom_are_counted(fake: Any) -> None:
    run = fake.run()
    tally = tally_of(fake, run)
    occupancy = run.target.fill.copy()
    occupancy[5, 5] = False
    tally.add("image", {"image": fake.image(occupancy, cycle=3)})
    lines = picture(tally, 120, 30)
    assert any(line.rstrip().endswith("224 atoms, 1 defect") for line in lines)
    assert "○" in "\n".join(lines)


def test_the_status_takes_the_place_of_the_time_left(fake: Any) -> None:
    tally = tally_of(fake, fake.run(), n_shots=20)
    assert picture(tally, 80, 24)[0].endswith("20/20 shots  0:00 left")
    tally.add("run_finished", {"record": fake.run(), "status": "stopped", "error": ""})
    assert picture(tally, 80, 24)[0].endswith("20/20 shots  stopped")


def test_a_scan_is_drawn_where_there_is_room(fake: Any) -> None:
    scan = {
        "addresses": ["dop"],
        "points": [[3], [7]],
        "written": [["3"], ["7"]],
        "point_of_shot": [0, 1] * 10,
    }
    run = replace(fake.run(), scan=scan)
    tally = tally_of(fake, run)
    assert any("filling by dop" in line for line in picture(tally, 120, 36))
    assert not any("filling by dop" in line for line in picture(tally, 120, 18))


def scan(values: list[Any], *, repeats: int = 1) -> dict[str, Any]:
    return {
        "addresses": ["planner.dop"],
        "points": [[value] for value in values],
        "written": [[str(value)] for value in values],
        "point_of_shot": [i for i in range(len(values)) for _ in range(repeats)],
    }


def scan_tally(values: list[Any], shots: list[tuple[int, bool, float]], *measured: str) -> Tally:
    """A run that measures whether the target is met, unless others are named."""
    settings = {"measure": [{"value": name} for name in measured or ("defect_free",)]}
    tally = Tally(lambda: 0.0)
    record = replace(make_run(), scan=scan(values), resolved=settings)
    tally.add("run_starting", {"record": record, "run_dir": "x"})
    for index, success, filling in shots:
        tally.add("shot_finished", {"row": make_row(index, success=success, filling=filling)})
    return tally


def plot(tally: Tally, width: int = 40, height: int = 6, glyphs: Any = UNICODE) -> list[str]:
    assert tally.scan is not None
    return [line.plain for line in draw_scan(tally.scan, tally.measured, width, height, glyphs)]


def test_points_stand_in_the_order_of_their_values() -> None:
    tally = scan_tally([7, 3, 15], [(0, True, 1.0), (1, False, 0.9), (2, True, 1.0), (2, False, 0.9)])
    assert plot(tally) == [
        "defect-free by dop",
        " 100 %      ████      ",
        "            ████      ",
        "            ████ ████ ",
        "   0 % ▁▁▁▁ ████ ████ ",
        "       3            15",
    ]


def test_the_first_quantity_that_has_values_is_drawn() -> None:
    shots = [(0, False, 0.98), (2, False, 0.99)]
    drawn = plot(scan_tally([1, 2, 3], shots, "reading.power_w", "filling", "defect_free"), glyphs=ASCII)
    assert drawn[0] == "filling by dop"
    assert (drawn[1][:7], drawn[-2][:7]) == ("  99 % ", "  98 % ")
    assert drawn[-2][7:] == "....      #### "


def test_before_the_first_shot_there_is_no_plot() -> None:
    assert plot(scan_tally([1, 2], [(0, False, float("nan")), (99, True, 1.0)])) == []


@given(
    st.lists(st.integers(0, 500), min_size=1, max_size=120, unique=True),
    st.lists(st.tuples(st.integers(0, 120), st.booleans(), st.floats(0, 1)), max_size=60),
    st.integers(16, 60),
    st.integers(4, 12),
    st.sampled_from([UNICODE, ASCII]),
)
def test_a_plot_never_exceeds_its_room(
    values: list[int], shots: list[tuple[int, bool, float]], width: int, height: int, glyphs: Any
) -> None:
    drawn = plot(scan_tally(values, shots), width, height, glyphs)
    assert len(drawn) in (0, height)
    assert all(len(line) <= max(width, len("defect-free by dop")) for line in drawn)
