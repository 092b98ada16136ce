from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from labseq.cli.live import Tally, draw
from labseq.console.output import ASCII, UNICODE

RECENT = ["first", "second", "third"]


def tally_of(fake: Any, run: Any, n_shots: int = 2) -> Tally:
    tally = Tally(lambda: 0.0)
    for name, values in fake.script(run, n_shots=n_shots):
        if name != "run_finished":
            tally.note(name, values)
    return tally


def picture(tally: Tally, width: int, height: int, glyphs: Any = UNICODE, recent: Any = RECENT) -> list[str]:
    return draw(tally, recent, width, height, glyphs).plain.split("\n")


@pytest.mark.parametrize(
    "size", [(200, 60), (110, 26), (107, 24), (80, 24), (80, 20), (60, 24), (40, 10), (20, 5), (8, 2)]
)
@pytest.mark.parametrize("glyphs", [UNICODE, ASCII])
@pytest.mark.parametrize("n", [20, 60])
def test_a_picture_never_exceeds_the_terminal(fake: Any, size: tuple[int, int], glyphs: Any, n: int) -> None:
    lines = picture(tally_of(fake, fake.run(target=fake.target(n))), *size, glyphs)
    assert len(lines) < size[1]
    assert max(map(len, lines)) <= size[0]


def test_a_wide_terminal_shows_everything(fake: Any) -> None:
    lines = picture(tally_of(fake, fake.run()), 120, 30)
    text = "\n".join(lines)
    assert lines[0].startswith("compact-225  ━━━━━━╌")
    assert "2/20 shots" in lines[0]
    assert f"defect-free       2 of 2 (100.0 %), 65{UNICODE.to}100 %" in text
    assert "filling           100.00 ± 0.00 %" in text
    assert text.count("● " * 14 + "●") == 15
    assert "shot 2, image of cycle 2:" in text
    assert lines[-3:] == RECENT


def test_rows_are_sheared_as_on_the_array(fake: Any) -> None:
    def left_edges(**grid: Any) -> list[int]:
        lines = picture(tally_of(fake, fake.run(**grid)), 120, 30)
        return [line.index("● ● ● ●") for line in lines if "● " * 14 + "●" in line]

    right, left, square = left_edges(), left_edges(shear=-1), left_edges(lattice="square")
    assert [b - a for a, b in pairwise(right)] == [1] * 14
    assert [b - a for a, b in pairwise(left)] == [-1] * 14
    assert len(set(square)) == 1


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


def test_stage_table_shows_budgets(fake: Any) -> None:
    rows = {
        line.split()[0]: line.split()[1:]
        for line in picture(tally_of(fake, fake.run(lattice="square")), 60, 30)
        if line[:5] in {"plan ", "move "}
    }
    times = ["800", "us", "800", "us", "7.5", "ms"]
    assert rows == {"plan": [*times, "-"], "move": [*times, "60", "ms"]}


def test_before_the_first_image_there_is_no_array(fake: Any) -> None:
    tally = Tally(lambda: 0.0)
    tally.note("run_starting", {"record": fake.run(), "run_dir": "x"})
    text = "\n".join(picture(tally, 120, 30, recent=[]))
    assert "0/20 shots" in text
    assert "●" not in text


def test_a_defect_and_a_surplus_atom_are_counted(fake: Any) -> None:
    run = fake.run()
    tally = tally_of(fake, run)
    occupancy = run.target.fill.copy()
    occupancy[5, 5] = False
    tally.note("image", {"image": fake.image(occupancy, cycle=3)})
    lines = picture(tally, 120, 30)
    assert any(line.rstrip().endswith("224 atoms, 1 defect") for line in lines)
    assert "○" in "\n".join(lines)


def test_the_status_takes_the_place_of_the_time_left(fake: Any) -> None:
    tally = tally_of(fake, fake.run(), n_shots=20)
    assert picture(tally, 80, 24)[0].endswith("20/20 shots  0:00 left")
    tally.note("run_finished", {"record": fake.run(), "status": "stopped", "error": ""})
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
    assert any("defect-free by dop" in line for line in picture(tally, 120, 36))
    assert not any("defect-free by dop" in line for line in picture(tally, 120, 18))
