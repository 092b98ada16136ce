"""Files after a few accidents."""

from __future__ import annotations

from hypothesis import strategies as st

PIECES = [
    *(
        b"",
        b"\t",
        b"\n",
        b"  ",
        b": ",
        b"- ",
        b"&a ",
        b"? ",
        b"!!int ",
        b"---\n",
        b"...\n",
        b"\r",
        b"\0",
        b"\xff",
    ),
    *b": [ ] { } ' \" # *a << ! | > % \\ null true -1 0 1e999 .nan 0x [] {} name use ~ ...".split(),
    *(b"9" * 200, b"10 um", b"[1, 2", b'"\\ud800"', b'"\\0"', b"\xef\xbb\xbf"),
    *("\u2028".encode(), "\x85".encode(), "\U0001f600".encode()),
]


@st.composite
def mutated(draw: st.DrawFn, good: bytes) -> bytes:
    """A good file after a few accidents to its lines, its words or its bytes."""
    text = good
    for _ in range(draw(st.integers(1, 4))):
        lines = text.splitlines(keepends=True) or [b""]
        i, j = draw(st.integers(0, len(lines) - 1)), draw(st.integers(0, len(lines) - 1))
        at, length = draw(st.integers(0, len(text))), draw(st.integers(0, 6))
        piece = draw(st.sampled_from(PIECES) | st.binary(max_size=3))
        match draw(st.integers(0, 5)):
            case 0:
                text = text[:at] + piece + text[at + length :]
            case 1:
                text = b"".join(lines[:i] + lines[i + 1 :])
            case 2:
                text = b"".join([*lines[:i], lines[j], *lines[i:]])
            case 3:
                head, colon, _ = lines[i].partition(b": ")
                text = b"".join([*lines[:i], head + colon + piece + b"\n", *lines[i + 1 :]])
            case 4:
                lines[i], lines[j] = lines[j], lines[i]
                text = b"".join(lines)
            case _:
                text = b"".join([*lines[:i], b" " * length + lines[i].lstrip(b" "), *lines[i + 1 :]])
    return text
