"""Drawings in files: text and PNG, and what is said of wrong ones."""

from __future__ import annotations

import contextlib
import io
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from PIL import Image

import labseq
from labseq.builtin.patterns import MAX_PIXELS, read_drawing
from labseq.errors import ConfigError

ROOT = Path(__file__).parents[2]
MASK = np.array([[1, 0, 1, 1], [0, 1, 0, 0], [1, 1, 1, 0]], np.bool_)


def rgba(opaque: bool) -> np.ndarray:
    """White atoms on a transparent ground, or black ones on white."""
    pixels = np.full((*MASK.shape, 4), 255, np.uint8)
    if opaque:
        pixels[MASK, :3] = 0
    else:
        pixels[..., 3] = 255 * MASK
    return pixels


def palette() -> Image.Image:
    image = Image.fromarray(MASK.astype(np.uint8), "P")
    image.putpalette([255, 255, 255, 30, 30, 120])
    return image


PICTURES = {
    "black and white": Image.fromarray(~MASK),
    "grey": Image.fromarray(np.where(MASK, 100, 200).astype(np.uint8)),
    "grey of 16 bits": Image.fromarray(np.where(MASK, 1000, 60000).astype(np.uint16)),
    "coloured": Image.fromarray(np.where(MASK[..., None], (0, 60, 120), (250, 250, 200)).astype(np.uint8)),
    "with an opaque alpha": Image.fromarray(rgba(opaque=True)),
    "on a transparent ground": Image.fromarray(rgba(opaque=False)),
    "of a palette": palette(),
}


@pytest.mark.parametrize("kind", PICTURES)
def test_dark_or_opaque_pixels_are_atoms(kind: str, tmp_path: Path) -> None:
    PICTURES[kind].save(tmp_path / "drawing.PNG")
    assert (read_drawing(tmp_path / "drawing.PNG") == MASK).all()


def test_a_text_is_a_drawing(tmp_path: Path) -> None:
    file = tmp_path / "drawing.txt"
    file.write_bytes(b"\r\n#.##\r\n.#..\r\n###.\r\n\r\n")
    assert (read_drawing(file) == MASK).all()
    file.write_text("x.oo\n.x..\nxxo.\n")
    assert (read_drawing(file, fill="xo") == MASK).all()


def test_the_lion_head_is_a_drawing_without_margins() -> None:
    lion = read_drawing(ROOT / "sequences" / "lion_head.txt")
    assert (lion.shape, np.count_nonzero(lion)) == ((17, 17), 177)
    assert lion.any(axis=0).all()
    assert lion.any(axis=1).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("#.#\n##\n", r"drawing\.txt:2:1: row 2 of the drawing has 2 characters, but row 1 has 3"),
        ("\n\n#.#\n##\n", r"drawing\.txt:4:1: row 2 of the drawing"),
        ("", "the drawing is empty"),
        ("...\n...\n", "the drawing has no atom; draw an atom as one of '#'"),
        ("#\n" * 600_000, "the file is larger than 1024 KiB"),
    ],
)
def test_a_wrong_text_is_an_error_with_its_line(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "drawing.txt").write_text(content)
    with pytest.raises(ConfigError, match=message):
        read_drawing(tmp_path / "drawing.txt")


def test_a_wrong_picture_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "drawing.png"
    file.write_text("#.#\n")
    with pytest.raises(ConfigError, match=r"drawing\.png: this is not a readable PNG"):
        read_drawing(file)
    Image.new("L", (3, 2), 255).save(file)
    with pytest.raises(ConfigError, match=r"the picture has no atom; make the pixels of atoms dark"):
        read_drawing(file)
    Image.new("1", (MAX_PIXELS + 1, 2)).save(file)
    with pytest.raises(ConfigError, match=r"the picture has 2 x 1025 pixels; expected one pixel per site"):
        read_drawing(file)


@given(at=st.floats(0, 1), junk=st.binary(max_size=8), cut=st.booleans())
@settings(max_examples=60)
def test_a_damaged_picture_is_read_or_refused(
    at: float, junk: bytes, cut: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    whole = io.BytesIO()
    PICTURES["grey"].save(whole, "PNG")
    data = whole.getvalue()
    place = int(at * len(data))
    file = tmp_path_factory.getbasetemp() / "damaged.png"
    file.write_bytes(data[:place] + junk + (b"" if cut else data[place + len(junk) :]))
    with contextlib.suppress(ConfigError):
        assert read_drawing(file).any()


def test_a_picture_that_unpacks_to_far_more_is_refused(tmp_path: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    size = (100_000).to_bytes(4, "big")
    header = chunk(b"IHDR", size + size + bytes([8, 0, 0, 0, 0]))
    file = tmp_path / "bomb.png"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(1000))))
    with pytest.raises(ConfigError, match=r"bomb\.png"):
        read_drawing(file)


SEQUENCE = """
labseq: 1
name: drawn
profile: virtual
shots: 1
target: {target}
shot:
  - load: {{duration: 500 ms}}
  - image: {{exposure: 45 ms}}
"""


@pytest.mark.parametrize("name", ["drawing.txt", "drawing.png"])
def test_a_file_is_looked_for_beside_the_sequence(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "lab" / "drawing.txt").write_text("#.##\n.#..\n###.\n")
    PICTURES["grey"].save(tmp_path / "lab" / "drawing.png")
    sequence = tmp_path / "lab" / "sequence.yaml"
    sequence.write_text(SEQUENCE.format(target=f"{{pattern: bitmap, file: {name}, origin: [2, 3]}}"))
    monkeypatch.chdir(tmp_path / "elsewhere")
    target = labseq.Session.open(sequence).assembly.target
    assert (target.fill[2:5, 3:7] == MASK).all()
    assert (target.clear[2:5, 3:7] == ~MASK).all()
    assert np.count_nonzero(target.fill | target.clear) == MASK.size


def test_a_drawing_may_be_part_of_the_sequence(tmp_path: Path) -> None:
    block = "\n  pattern: bitmap\n  sites: |\n    #.##\n    .#..\n    ###."
    sequence = tmp_path / "sequence.yaml"
    sequence.write_text(SEQUENCE.format(target=block))
    target = labseq.Session.open(sequence).assembly.target
    assert (target.fill[8:11, 8:12] == MASK).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("", r"sequence\.yaml:6:9: a bitmap needs a drawing; expected 'sites' or 'file'"),
        (", sites: '#', file: a.txt", r"sequence\.yaml:6:39: 'file' and 'sites' are both given"),
        (", sites: '#', fill: ''", r"sequence\.yaml:6:45: fill has 0 characters"),
        (", file: a.txt", r"sequence\.yaml:6:33: .*a\.txt: there is no such file"),
        (", sites: '...'", r"sequence\.yaml:6:34: the drawing has no atom"),
    ],
)
def test_wrong_settings_are_errors_with_their_place(settings: str, message: str, tmp_path: Path) -> None:
    sequence = tmp_path / "sequence.yaml"
    sequence.write_text(SEQUENCE.format(target=f"{{pattern: bitmap{settings}}}"))
    with pytest.raises(ConfigError, match=message):
        labseq.Session.open(sequence)
