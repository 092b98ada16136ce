"""The pages in a real browser: live, in both themes and three sizes, and when things go wrong."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Generator
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

import labseq
from labseq.calibration_store import Store
from labseq.data.reader import open_run
from labseq.model import CalibrationEntry, SiteGrid, grid_facts
from labseq.pictures.playback import play_back_cycle
from labseq.queue.queue import Queue
from tests.recording.records import make_shot

from .clients import TOKEN, path_of, shot_of_frames, write_run
from .test_actions import entry
from .test_measured import held_at, scan_of_two

ROOT = Path(__file__).parents[2]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
MARKUP = '<img src=x onerror="document.title=1"><b>bold</b>'
SIZES = ((390, 844), (2560, 1440), (1440, 900))
WAIT_MS = 120_000

pytestmark = [pytest.mark.system, pytest.mark.needs("browser")]


def expect(of: Any) -> Any:
    """Playwright's, which is imported when a test runs: it may not be installed."""
    from playwright.sync_api import expect as wait_until

    wait_until.set_options(timeout=WAIT_MS)
    return wait_until(of)


@dataclass
class Server:
    """`labseq web` in a process of its own."""

    data: Path
    options: tuple[str, ...] = ()
    variables: dict[str, str] = field(default_factory=dict[str, str])
    port: int = 0
    address: str = ""
    process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        command = [
            sys.executable,
            "-m",
            "labseq",
            "web",
            str(self.data),
            f"--port={self.port}",
            *self.options,
        ]
        own = {
            "LABSEQ_STATE": str(self.data.parent / "state"),
            "LABSEQ_LOCKS": str(self.data.parent / "locks"),
        }
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            text=True,
            cwd=self.data.parent,
            env={**os.environ, **own, **self.variables},
        )
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().strip()
        self.port = urlsplit(self.address).port or 0

    def stop(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def server(tmp_path: Path) -> Generator[Server]:
    found = Server(tmp_path / "data")
    found.data.mkdir()
    found.start()
    yield found
    found.stop()


@pytest.fixture(scope="module")
def browser() -> Generator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        nowhere_else = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
        options = ["--no-sandbox", "--disable-gpu", nowhere_else]
        found = started.chromium.launch(executable_path=CHROMIUM, args=options)
        yield found
        found.close()


@dataclass
class Watched:
    """A page, and whatever it should not do: requests elsewhere, errors, dialogs."""

    page: Any
    faults: list[str] = field(default_factory=list[str])

    def __post_init__(self) -> None:
        def request(one: Any) -> None:
            if urlsplit(one.url).hostname != "127.0.0.1" and not one.url.startswith(("blob:", "data:")):
                self.faults.append(one.url)

        self.page.on("request", request)
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("dialog", lambda dialog: (self.faults.append(dialog.message), dialog.dismiss()))
        self.page.on("console", lambda line: line.type == "error" and self.faults.append(line.text))


@pytest.fixture
def watched(browser: Any) -> Generator[Watched]:
    context = browser.new_context(viewport={"width": 1440, "height": 900})
    context.set_default_timeout(WAIT_MS)
    yield Watched(context.new_page())
    context.close()


def test_a_run_is_watched_from_its_first_shot_to_its_last(server: Server, watched: Watched) -> None:
    """Also while other browsers do not read what they asked for."""
    page, stalled = watched.page, list[socket.socket]()
    for _ in range(20):
        client = socket.socket()
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", server.port))
        client.sendall(b"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        stalled.append(client)
    page.goto(server.address)
    expect(page.get_by_text("There is no run yet")).to_be_visible()
    writer = write_run(server.data, 0, n_shots=9)
    for index in range(9):
        writer.write_shot(make_shot(index))
        expect(page.locator(".progress-text")).to_have_text(re.compile(rf"{index + 1} of 9 shots"))
    expect(page.locator("h1 + .pill")).to_have_text(re.compile("running"))
    writer.finish("complete")
    expect(page.locator("h1 + .pill")).to_have_text(re.compile("complete"))
    for client in stalled:
        client.close()
    shown = page.locator(".tile", has_text="Filling").locator(".tile-value").inner_text()
    assert float(re.split(r"[ (]", shown)[0]) == pytest.approx(
        100 * open_run(writer.run_dir).filling_fraction, abs=0.6
    )
    for canvas in page.locator("figure:visible canvas").all():
        assert canvas.evaluate(
            "c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some(v => v)"
        )
    assert watched.faults == []


def test_each_fit_of_a_scan_of_two_values_can_be_looked_at(server: Server, watched: Watched) -> None:
    writer, page = scan_of_two(server.data), watched.page
    for index in range(10):
        writer.write_shot(held_at(index))
    page.goto(f"{server.address.rstrip('/')}/scan")
    rows = page.locator("section[aria-label^='Fits of survival'] tbody tr")
    expect(rows).to_have_count(2)
    shown = page.locator("section[aria-label='survival:image_0,image_1'] .chart").first
    before = shown.get_attribute("aria-label")
    page.get_by_label("Fit to show").select_option("1")
    expect(shown).not_to_have_attribute("aria-label", before)
    expect(shown).to_have_attribute("aria-label", re.compile("5 points, the last 10 % at duration in s 20"))
    assert watched.faults == []


GREYS = """(picture, places) => {
    let canvas = picture;
    if (picture.tagName === "IMG") {
        canvas = document.createElement("canvas");
        [canvas.width, canvas.height] = [picture.naturalWidth, picture.naturalHeight];
        canvas.getContext("2d").drawImage(picture, 0, 0);
    }
    const context = canvas.getContext("2d");
    const at = ([x, y]) => context.getImageData(x * canvas.width, y * canvas.height, 1, 1);
    return places.map((place) => at(place).data[0]);
}"""
"""Grey values of a picture or canvas at places, as fractions of its width and height."""


def test_frames_are_seen_as_they_were_taken(server: Server, watched: Watched) -> None:
    """A picture of the API, and what the page of a shot paints from it."""
    frame = np.full((60, 90), 100, np.uint16)
    frame[:15, 60:], frame[45:, :30] = 1100, 600
    greys = {(0.8, 0.1): 255, (0.2, 0.9): 127, (0.1, 0.1): 0, (0.9, 0.9): 0, (0.5, 0.5): 0}
    writer = write_run(server.data, 0, n_shots=1)
    writer.write_shot(shot_of_frames(frame))
    writer.finish("complete")
    base, page = f"http://127.0.0.1:{server.port}", watched.page
    page.goto(f"{base}/runs/{path_of(writer.run_dir).removeprefix('/api/v1/runs/')}/shots/0")
    page.evaluate(
        """async address => {
            const picture = document.body.appendChild(new Image());
            picture.id = "frame";
            picture.src = address;
            await picture.decode();
        }""",
        f"{base}{path_of(writer.run_dir)}/shots/0/frames/0.png",
    )
    picture = page.locator("#frame")
    assert picture.evaluate("one => [one.naturalWidth, one.naturalHeight]") == [90, 60]
    assert picture.evaluate(GREYS, [*greys]) == pytest.approx([*greys.values()], abs=1)
    canvas = page.locator("section[aria-label='Images'] canvas")
    page.wait_for_function(  # painted: no pixel is transparent
        "one => one.getContext('2d').getImageData(0, 0, 1, 1).data[3]", arg=canvas.element_handle()
    )
    assert canvas.evaluate(GREYS, [*greys]) == pytest.approx([*greys.values()], abs=2)


def time_of(page: Any) -> float:
    """The time that a player shows, in ms."""
    return float(page.locator(".player + p").inner_text().partition(" ms")[0])


def check_that_a_player_moves(page: Any) -> None:
    """It plays from its start to its end, stands when it is told to, and follows its slider."""
    button, slider = page.locator(".player button"), page.locator(".player input")
    first = time_of(page)
    page.wait_for_function(
        "first => parseFloat(document.querySelector('.player + p').textContent) > first", arg=first
    )
    button.click()
    expect(button).to_have_text(re.compile("Play"))
    stands = time_of(page)
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert time_of(page) == stands
    before = page.locator("canvas").first.evaluate("one => one.toDataURL()")
    slider.evaluate("one => { one.value = one.max; one.dispatchEvent(new Event('input')); }")
    expect(page.locator(".player + p")).to_have_text(re.compile("after the last batch"))
    assert page.locator("canvas").first.evaluate("one => one.toDataURL()") != before


STATES = """async ([address, path, places]) => {
    const { stateAt } = await import(address);
    const scene = await (await fetch(path)).json();
    return places.map((part) => stateAt(scene, scene.start + part * (scene.end - scene.start)));
}"""


def check_that_a_cycle_is_played(full: Server, page: Any, run: Path) -> None:
    """What the page draws is what the motion's own evaluation says, at any time."""
    base = f"http://127.0.0.1:{full.port}"
    path = f"/runs/{run.parent.name}/{run.name}/shots/1"
    page.goto(f"{base}{path}")
    page.get_by_role("button", name="Play cycle 0").click()
    check_that_a_player_moves(page)
    playback, parts = play_back_cycle(open_run(run).shots[1], 0), np.linspace(0.0, 0.999, 60).tolist()
    states = page.evaluate(STATES, [f"{base}/static/player.js", f"/api/v1{path}/motion/0", parts])
    for part, state in zip(parts, states, strict=True):
        frame = playback.at(playback.start_s + part * (playback.end_s - playback.start_s))
        assert state["batch"] == frame.batch, part
        assert np.array(state["atoms"]) == pytest.approx(frame.atoms, abs=1e-4)
        tweezers = np.array(state["tweezers"], float).reshape(-1, 4)
        assert tweezers == pytest.approx(frame.tweezers, abs=1e-4)


def test_a_page_of_a_plan_plays_without_a_server(tmp_path: Path, watched: Watched) -> None:
    path, page = tmp_path / "plan.html", watched.page
    target = "--target={pattern: compact, rows: 5, cols: 5}"
    command = [sys.executable, "-m", "labseq", "plan", "random:8x8@0.7", "--seed=1", "--planner=grid"]
    subprocess.run([*command, target, f"--animate={path}"], check=True, stdout=subprocess.DEVNULL)
    page.goto(path.as_uri())
    page.get_by_role("button").click()
    check_that_a_player_moves(page)
    assert watched.faults == [path.as_uri()]  # and no other file


RUN = """
import sys, time
from pathlib import Path
from tests.web.clients import write_run
writer = write_run(Path(sys.argv[1]), 2, n_shots=9)
print("ready", flush=True)
time.sleep(600)
"""


def test_a_run_that_is_killed_is_said_to_have_died(server: Server, watched: Watched) -> None:
    page = watched.page
    page.goto(server.address)
    run = subprocess.Popen(
        [sys.executable, "-c", RUN, str(server.data)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert run.stdout is not None
    assert run.stdout.readline() == "ready\n"  # both shots are written
    expect(page.locator("h1 + .pill")).to_have_text(re.compile("running"))
    run.send_signal(getattr(signal, "SIGKILL", signal.SIGTERM))
    run.communicate()
    expect(page.get_by_text("The run died")).to_be_visible()
    expect(page.locator(".progress-text")).to_have_text(re.compile("2 of 9 shots"))


FULL_SPEED = """
import itertools, sys
from dataclasses import replace
from pathlib import Path
from tests.recording.records import make_shot
from tests.web.clients import write_run
writer = write_run(Path(sys.argv[1]), 1, n_shots=100_000)
print("ready", flush=True)
shot = make_shot()
for index in itertools.count(1):
    writer.write_shot(replace(shot, shot_index=index))
"""


def test_every_click_counts_while_shots_come_at_full_speed(tmp_path: Path, watched: Watched) -> None:
    """Between the press and the release of a button the page gets new states."""
    data = tmp_path / "data"
    data.mkdir()
    server = Server(data, ("--control",), {"LABSEQ_WEB_TOKEN": "t" * 20})
    server.start()
    run = subprocess.Popen(
        [sys.executable, "-c", FULL_SPEED, str(data)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert run.stdout is not None
        assert run.stdout.readline() == "ready\n"
        page = watched.page
        page.goto(server.address)
        button = page.get_by_role("button", name="Stop after this shot")
        for n_clicks in range(1, 21):
            before = page.locator(".progress-text").inner_text()
            button.hover()
            page.mouse.down()
            expect(page.locator(".progress-text")).not_to_have_text(before)
            page.mouse.up()
            page.wait_for_function("true")  # the dialog was answered
            assert len(watched.faults) == n_clicks, watched.faults
        assert {*watched.faults} == {"End this run after its current shot?"}
        page.evaluate("window.confirm = () => true")
        button.click()
        expect(page.get_by_text("ends after this shot")).to_be_visible()
        assert [*data.glob("*/*/STOP")]
    finally:
        run.kill()
        run.communicate()
        server.stop()


def test_the_page_goes_on_after_the_server_was_restarted(server: Server, watched: Watched) -> None:
    page = watched.page
    writer = write_run(server.data, 1, n_shots=9)
    page.goto(server.address)
    expect(page.locator(".progress-text")).to_have_text(re.compile("1 of 9"))
    server.stop()
    expect(page.get_by_text("no connection")).to_be_visible()
    writer.write_shot(make_shot(1))
    server.start()
    expect(page.locator(".progress-text")).to_have_text(re.compile("2 of 9"))
    expect(page.get_by_text("live", exact=True)).to_be_visible()


def test_token_is_asked_for(tmp_path: Path, watched: Watched, browser: Any) -> None:
    data = tmp_path / "data"
    data.mkdir()
    server = Server(data, ("--control",), {"LABSEQ_WEB_TOKEN": TOKEN})
    server.start()
    try:
        page, base = watched.page, f"http://127.0.0.1:{server.port}"
        assert page.goto(f"{base}/runs").status == 401
        assert page.goto(f"{base}/runs?token={TOKEN[::-1]}").status == 401
        page.goto(f"{base}/runs?token={TOKEN}".replace(" ", "%20"))
        expect(page.get_by_role("heading", name="Runs")).to_be_visible()
        assert page.url == f"{base}/runs"
        other = browser.new_context().new_page()
        assert other.goto(base).status == 401
    finally:
        server.stop()


@pytest.fixture
def full(tmp_path_factory: pytest.TempPathFactory) -> Generator[Server]:
    """A data folder with something for every page: a real scan, hostile texts, a queue, calibrations."""
    home = tmp_path_factory.mktemp("lab")
    data = home / "data"
    store = Store(home / "hardware_profiles" / "calibrations" / "virtual")
    picture = io.BytesIO()
    Image.new("L", (60, 40)).save(picture, "PNG")
    for day in (3, 11, 19):
        quality = {"error_m": 1e-8 * day}
        taken = f"2026-11-{day:02}T08:00:00+00:00"
        store.add(
            CalibrationEntry(
                "overlay", {"offset_m": np.array([1e-8, 0.0])}, quality, grid_facts(SiteGrid()), {}, taken
            ),
            picture.getvalue(),
        )
    queue = Queue(data)
    queue.folder.mkdir(parents=True)
    queue.write(entry(1))
    writer = write_run(data, 2, MARKUP)
    (writer.run_dir / "notes.json").write_text(json.dumps({"comment": MARKUP, "tags": [MARKUP]}))
    writer.event("warning", text=MARKUP)
    writer.finish("failed", MARKUP * 20)
    options: Any = {"profile": str(ROOT / "hardware_profiles" / "virtual.yaml"), "seed": 1, "output": data}
    options["overrides"] = ["scan={planner.degree_of_parallelism: [2, 5, 8]}", "repeats=2"]
    with labseq.Session.open(ROOT / "sequences" / "scan_dop.yaml", **options) as session:
        session.run()
    found = Server(data, ("--control",), {"LABSEQ_WEB_TOKEN": "t" * 20})
    found.start()
    yield found
    found.stop()


def pages_of(data: Path) -> list[str]:
    runs = sorted((run.parent for run in data.glob("*/*/run.json")), key=lambda run: "scan-dop" in run.name)
    first, second = (f"{run.parent.name}/{run.name}" for run in runs)
    return [
        *(f"/now?run={first}", f"/now?run={second}", "/now?wall=1", f"/scan?run={second}", "/runs"),
        *(f"/runs/{first}", f"/runs/{second}/shots/1", f"/compare?a={first}&b={second}"),
        *("/queue", "/calibrations", "/api"),
    ]


def settled(page: Any) -> None:
    expect(page.locator("main[aria-busy='false'] h1").first).to_be_visible()


def test_pages_of_a_folder_with_something_for_each(full: Server, watched: Watched) -> None:
    """In one test, because several processes would each start the browser and take the runs."""
    page = watched.page
    page.goto(full.address)
    check_every_page_in_both_themes_and_three_sizes(full, page)
    assert watched.faults == []
    run = next(run.parent for run in full.data.glob("*/*scan-dop/run.json"))
    check_that_a_link_leads_to_the_same_shot_with_its_images_and_moves(full, page, run)
    check_that_a_cycle_is_played(full, page, run)
    check_that_a_table_is_sorted_by_a_click(full, page, run)
    check_that_any_quantity_can_be_chosen(full, page, run)
    check_that_a_comment_is_kept_and_found(full, page, run)
    page.goto(f"http://127.0.0.1:{full.port}/calibrations")
    page.wait_for_function(
        "() => document.querySelector('img.picture')?.naturalWidth === 60"  # the one that was stored
    )


def check_every_page_in_both_themes_and_three_sizes(full: Server, page: Any) -> None:
    """No overflow, no request elsewhere, no markup from a file, and nothing that axe finds serious."""
    axe = (files("axe_playwright_python") / "axe.min.js").read_text("utf-8")
    for path in pages_of(full.data):
        page.goto(f"http://127.0.0.1:{full.port}{path}")
        settled(page)
        page.evaluate(axe)
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            is_wide = page.evaluate("document.documentElement.scrollWidth > innerWidth")
            assert not is_wide, (path, width)
        for theme in ("light", "dark"):
            page.emulate_media(color_scheme=theme)
            assert serious(page, theme) == [], (path, theme)
        assert page.locator("main img[src='x'], main b").count() == 0, path
    page.emulate_media(color_scheme="no-preference")


AXE = """async rules => (await axe.run(document, {resultTypes: ['violations'], runOnly: rules})).violations
    .filter(found => ['serious', 'critical'].includes(found.impact))
    .map(found => [found.id, ...found.nodes.slice(0, 3).map(one => one.html + one.failureSummary)].join())"""


def serious(page: Any, theme: str) -> list[str]:
    """What axe-core finds; nothing but the contrast depends on the theme."""
    rules = ["wcag2a", "wcag2aa", "wcag21aa", "best-practice"] if theme == "light" else ["color-contrast"]
    return page.evaluate(AXE, rules)


def check_that_a_link_leads_to_the_same_shot_with_its_images_and_moves(
    full: Server, page: Any, run: Path
) -> None:
    shot = open_run(run).shots[1]
    page.goto(f"http://127.0.0.1:{full.port}/runs/{run.parent.name}/{run.name}")
    page.get_by_role("link", name="1", exact=True).click()
    expect(page.get_by_role("heading", name="Shot 1")).to_be_visible()
    assert page.url.endswith(f"{run.name}/shots/1")
    assert page.locator("section[aria-label='Images'] figure").count() == len(shot.images)
    captions = page.locator("section[aria-label='Cycle by cycle'] figcaption").all_inner_texts()
    assert [int(re.search(r"(\d+) moves?,", text)[1]) for text in captions] == [  # type: ignore[index]
        cycle.n_atom_moves_played for cycle in shot.cycles
    ]
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("heading", name="Shot 2")).to_be_visible()
    page.go_back()
    expect(page.get_by_role("heading", name="Shot 1")).to_be_visible()


def check_that_a_table_is_sorted_by_a_click(full: Server, page: Any, run: Path) -> None:
    page.goto(f"http://127.0.0.1:{full.port}/runs/{run.parent.name}/{run.name}")
    table = page.locator("section[aria-label='Shots'] table")
    head = table.get_by_role("button", name="degree_of_parallelism")
    for n_clicks, expected in ((1, ["2", "2", "5", "5", "8", "8"]), (2, ["8", "8", "5", "5", "2", "2"])):
        head.click()
        assert table.locator("tbody td:nth-child(3)").all_inner_texts() == expected, n_clicks
    head.click()
    assert table.locator("tbody td:nth-child(1)").all_inner_texts() == ["5", "4", "3", "2", "1", "0"]


def check_that_any_quantity_can_be_chosen(full: Server, page: Any, run: Path) -> None:
    page.goto(f"http://127.0.0.1:{full.port}/scan?run={run.parent.name}/{run.name}")
    page.get_by_label("Quantity").select_option("n_atoms")
    expect(page.get_by_role("heading", name="n_atoms by degree_of_parallelism")).to_be_visible()
    expect(page.locator("section[aria-label='Points'] tbody tr")).to_have_count(3)


def check_that_a_comment_is_kept_and_found(full: Server, page: Any, run: Path) -> None:
    page.goto(f"http://127.0.0.1:{full.port}/runs/{run.parent.name}/{run.name}")
    page.get_by_label("Comment", exact=True).last.fill("a new lens")
    page.get_by_role("button", name="Keep").click()
    expect(page.get_by_text("saved")).to_be_visible()
    page.goto(f"http://127.0.0.1:{full.port}/runs")
    page.get_by_role("searchbox").fill("new LENS")
    expect(page.locator("main .note").first).to_have_text(re.compile("1 of 2 runs"))
    expect(page.get_by_role("link", name=f"{run.parent.name}/{run.name}")).to_be_visible()
