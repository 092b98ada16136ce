"""Animations of plans as GIF files and pages with a player."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.pictures.figures import (
    POINTS_PER_INCH,
    Extent,
    check_place,
    extent_of_sites,
    make_figure,
    place_sites,
    save_bytes,
)
from labseq.pictures.plans import check_size
from labseq.pictures.playback import Frame, Playback

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image

ENDINGS: Final = (".gif", ".html")
"""File name endings of animations."""
COLOURS: Final = {
    "bg": "#ffffff", "ink": "#1b2530", "ink-2": "#5a6877", "site": "#b9c3cd", "goal": "#dfeaf4",
    "atom": "#2f6fae", "move": "#e07b1a", "error": "#c8102e",
}  # fmt: skip
"""Colours of sites, target, atoms, tweezers, and atoms that are or will be lost."""
FRAMES_PER_S: Final = 20
HOLD_MS: Final = (600, 2500)
"""How long the first and the last frame are shown."""


@dataclass(frozen=True, slots=True, eq=False)
class Animation:
    """A motion to animate, and two lines of text above it."""

    title: str
    source: str
    playback: Playback


def check_animation(path: Path, shape: tuple[int, int]) -> None:
    """Check that an animation of (n_rows, n_cols) sites can be made and saved, before anything is planned.

    Raises:
        ConfigError: The name does not end in .gif or .html, its folder does not exist, the array is too
            large, or a GIF needs matplotlib, which is not installed.
    """
    check_place(path, ENDINGS, drawn=path.suffix.lower() != ".html")
    check_size(path, shape)


def save_animation(path: Path, animation: Animation) -> None:
    """Save an animation as the kind of file that the ending names.

    Raises:
        ConfigError: The file cannot be written.
    """
    save_bytes(path, _page(animation) if path.suffix.lower() == ".html" else _gif(animation))


def _page(animation: Animation) -> bytes:
    """A self-contained page with the motion as JSON and the script that plays it."""
    folder = files("labseq.pictures")
    script, style = (folder.joinpath(name).read_text("utf-8") for name in ("player.js", "player.css"))
    # "<" could let a name end the script
    scene = json.dumps(animation.playback.as_json(), separators=(",", ":")).replace("<", "\\u003c")
    colours = "; ".join(f"--{name}: {value}" for name, value in COLOURS.items())
    title, source = escape(animation.title), escape(animation.source)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ {colours}; }}
{style}</style>
</head>
<body>
<h1>{title}</h1>
<p>{source}</p>
<figure></figure>
<script type="application/json" id="scene">{scene}</script>
<script type="module">
{script}
const style = getComputedStyle(document.documentElement);
const scene = JSON.parse(document.getElementById("scene").textContent);
const player = makePlayer(scene, (name) => style.getPropertyValue(`--${{name}}`).trim());
document.querySelector("figure").append(...player.elements);
player.draw();
addEventListener("resize", player.draw);
</script>
</body>
</html>
""".encode()


def _gif(animation: Animation) -> bytes:
    from matplotlib import style
    from PIL import Image

    playback, file = animation.playback, io.BytesIO()
    moving_s = (playback.end_s - playback.start_s) / playback.speed
    times_s = np.linspace(playback.start_s, playback.end_s, 2 + round(FRAMES_PER_S * moving_s))
    durations_ms = [HOLD_MS[0], *[1000 // FRAMES_PER_S] * (len(times_s) - 2), HOLD_MS[1]]
    with style.context(["default", {"text.parse_math": False}]):
        drawing, palette = _Drawing(animation), _palette()
        images = (
            Image.fromarray(drawing.pixels(t_s)).quantize(palette=palette, dither=Image.Dither.NONE)
            for t_s in times_s
        )
        first = next(images)
        first.save(
            file, "GIF", save_all=True, append_images=images, duration=durations_ms, loop=0, optimize=True
        )
    return file.getvalue()


def _palette() -> Image:
    """The colours of all frames, with the shades of rims and fading on each background."""
    from PIL import Image

    shades = {"move": 10, "atom": 5, "site": 2, "ink": 4, "ink-2": 3, "error": 3}
    on = {"bg": tuple(shades), "goal": ("move", "atom", "site", "error"), "atom": ("move", "error")}
    colours: list[int] = []
    for below, names in on.items():
        base = np.array(_rgb(below))
        for name in names:
            parts = np.linspace(0.0, 1.0, shades[name] + 1)[:, None]
            colours += (base + parts * (np.array(_rgb(name)) - base)).round().astype(int).ravel().tolist()
    palette = Image.new("P", (1, 1))
    palette.putpalette(colours)
    return palette


def _rgb(name: str) -> list[int]:
    return [int(COLOURS[name][i : i + 2], 16) for i in (1, 3, 5)]


class _Drawing:
    """A figure that draws its sites once, and the rest for each frame."""

    def __init__(self, animation: Animation) -> None:
        self._playback = playback = animation.playback
        ends = np.array([atom.knots[-1, 1:] for atom in playback.atoms]).reshape(-1, 2)
        extent = extent_of_sites(ends.round().astype(np.int64), playback.grid)
        self._site_in = min(max(6.4 / extent.width, 0.06), 0.3)
        self._figure = _sheet(animation, extent, self._site_in)
        self._axes = self._figure.axes[0]
        _draw_sites(self._axes, playback, self._site_in)
        self._artists = _Artists(self._axes, self._site_in * POINTS_PER_INCH)
        self._canvas: Any = self._figure.canvas
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)

    def pixels(self, t_s: float) -> NDArray[np.uint8]:
        """The frame of a time, uint8 (height, width, 3)."""
        self._canvas.restore_region(self._background)
        self._artists.show(self._playback, t_s)
        for artist in self._artists.all:
            self._axes.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


HEAD_IN, FOOT_IN = 0.5, 0.75
"""Room above the array for the title, and below it for the time and the key, in inches."""


def _sheet(animation: Animation, extent: Extent, site_in: float) -> Figure:
    """A figure with the title, and axes in which one site after the other is ``site_in`` apart."""
    width_in, height_in = extent.width * site_in, extent.height * site_in
    across, down = max(width_in, 6.4), height_in + HEAD_IN + FOOT_IN
    figure = make_figure(across, down, dpi=100)
    left = (across - width_in) / 2
    axes = figure.add_axes((left / across, FOOT_IN / down, width_in / across, height_in / down))
    axes.set_xlim(extent.left, extent.right)
    axes.set_ylim(extent.bottom, extent.top)
    axes.set_axis_off()
    for text, y_in, size, colour in (
        (animation.title, 0.1, 9, COLOURS["ink"]),
        (animation.source, 0.3, 7, COLOURS["ink-2"]),
    ):
        size = min(size, 1.75 * POINTS_PER_INCH * (across - 0.3) / max(1, len(text)))
        figure.text(0.15 / across, 1 - y_in / down, text, fontsize=size, color=colour, va="top")
    return figure


def _draw_sites(axes: Axes, playback: Playback, site_in: float) -> None:
    """Draw the target, the sites and the key, which do not move."""
    from matplotlib.lines import Line2D

    points, grid = site_in * POINTS_PER_INCH, playback.grid
    for sites, part, name in (
        (playback.target.fill, 1.04, "goal"),
        (np.ones(grid.shape, np.bool_), 0.18, "site"),
    ):
        x, y = place_sites(np.argwhere(sites), grid).T
        axes.plot(x, y, "o", ms=part * points, color=COLOURS[name], mew=0)
    ring = {"marker": "o", "mfc": "none", "mec": COLOURS["move"], "ms": 8}
    looks: list[tuple[str, dict[str, Any]]] = [
        ("target site", {"marker": "o", "ms": 8, "color": COLOURS["goal"]}),
        ("atom", {"marker": "o", "ms": 5, "color": COLOURS["atom"]}),
        ("tweezer with an atom", {**ring, "mew": 1.5, "mfc": f"{COLOURS['move']}59"}),
        ("without one", {**ring, "mew": 0.8}),
    ]
    if any(atom.is_lost for atom in playback.atoms):
        looks.append(
            ("will be lost", {"marker": "o", "ms": 5, "mfc": COLOURS["atom"], "mec": COLOURS["error"]})
        )
        looks.append(("lost", {"marker": "x", "ms": 5, "color": COLOURS["error"]}))
    if any(atom.fate == "ejected" for atom in playback.atoms):
        looks.append(("ejected", {"marker": "x", "ms": 5, "color": COLOURS["ink-2"]}))
    figure: Any = axes.figure
    figure.legend(
        handles=[Line2D([], [], linestyle="none", label=label, **look) for label, look in looks],
        loc="lower left", ncols=len(looks), frameon=False, fontsize=7, handletextpad=0.1, columnspacing=1.0,
    )  # fmt: skip


class _Artists:
    """The parts of a frame that change."""

    def __init__(self, axes: Axes, points: float) -> None:
        from matplotlib.collections import LineCollection

        def dots(part: float, **look: Any) -> Any:
            return axes.scatter([], [], s=(part * points) ** 2, animated=True, **look)

        thick = 0.1 * points
        ring = {"facecolors": "none", "edgecolors": COLOURS["move"]}
        figure: Any = axes.figure
        self._tones: Any = LineCollection([], linewidths=0.5 * thick, animated=True)
        self._trails: Any = LineCollection(
            [], colors=COLOURS["move"], alpha=0.7, linewidths=thick, animated=True
        )
        for lines in (self._tones, self._trails):
            axes.add_collection(lines)
        self._atoms = dots(0.6, c=COLOURS["atom"], linewidths=0)
        self._doomed = dots(0.6, facecolors="none", edgecolors=COLOURS["error"], linewidths=1.3 * thick)
        self._holding = dots(1.0, linewidths=1.4 * thick, **ring)
        self._empty = dots(1.0, linewidths=0.7 * thick, **ring)
        self._ejected = dots(0.6, marker="x", c=COLOURS["ink-2"], linewidths=thick)
        self._lost = dots(0.6, marker="x", c=COLOURS["error"], linewidths=1.4 * thick)
        down = figure.get_figheight()
        self._text = figure.text(0.02, 0.52 / down, "", fontsize=9, animated=True)
        self.all = (
            self._tones, self._trails, self._holding, self._empty, self._atoms, self._doomed, self._ejected,
            self._lost, self._text,
        )  # fmt: skip

    def show(self, playback: Playback, t_s: float) -> None:
        """Move everything to its place at a time."""
        grid, frame = playback.grid, playback.at(t_s)
        n_rows, n_cols = grid.shape
        rows = [[(row, -0.8), (row, n_cols - 0.2)] for row in frame.rows[:, 0]]
        columns = [[(-0.8, column), (n_rows - 0.2, column)] for column in frame.columns[:, 0]]
        self._tones.set_segments(list(place_sites(np.array(rows + columns).reshape(-1, 2, 2), grid)))
        self._tones.set_color(_faded(0.45 * np.concatenate([frame.rows[:, 1], frame.columns[:, 1]])))
        self._trails.set_segments([place_sites(trail, grid) for trail in playback.trails(t_s)])
        lost = np.array([atom.is_lost for atom in playback.atoms], np.bool_)
        there = frame.is_there
        for artist, shown in (
            (self._atoms, there),
            (self._doomed, there & lost),
            (self._ejected, ~there & ~lost),
            (self._lost, ~there & lost),
        ):
            artist.set_offsets(place_sites(frame.atoms[shown], grid))
        tweezers = frame.tweezers
        for artist, shown in ((self._holding, tweezers[:, 3] > 0), (self._empty, tweezers[:, 3] == 0)):
            artist.set_offsets(place_sites(tweezers[shown, :2], grid))
            artist.set_edgecolors(_faded(tweezers[shown, 2]))
        self._holding.set_facecolors(_faded(0.35 * tweezers[tweezers[:, 3] > 0, 2]))
        self._text.set_text(_caption(playback, frame, t_s, int(np.count_nonzero(~there & lost))))


def _faded(depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """The colour of tweezers, float64 (n, 4), more transparent for less deep tweezers."""
    from matplotlib.colors import to_rgba

    colours = np.tile(to_rgba(COLOURS["move"]), (len(depth), 1))
    colours[:, 3] = np.clip(depth, 0.0, 1.0)
    return colours


def _caption(playback: Playback, frame: Frame, t_s: float, n_lost: int) -> str:
    """The time, the batch and the tweezers that are on."""
    tweezers, last = frame.tweezers, len(playback.batch_s) - 1
    n, n_empty = len(tweezers), int(np.count_nonzero(tweezers[:, 3] == 0))
    parts = [
        f"{1e3 * t_s:.3f} ms",
        f"batch {frame.batch} of 0 to {last}" if frame.batch <= last else "after the last batch",
        *([f"{n} tweezer{'s' * (n > 1)}"] if n else []),
        *([f"{n_empty} without an atom"] if n_empty else []),
        *([f"{n_lost} lost"] if n_lost else []),
    ]
    return ", ".join(parts)
