import io

from hypothesis import given, strategies as st

from labseq.cli.output import columns, say

CELLS = st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=8)


@given(st.lists(st.tuples(CELLS, CELLS, CELLS), min_size=1), st.sets(st.integers(0, 2)))
def test_columns_keep_every_cell_in_its_column(rows: list[tuple[str, ...]], right: set[int]) -> None:
    lines = columns(rows, right=sorted(right))
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    for row, line in zip(rows, lines, strict=True):
        start = 0
        for i, cell in enumerate(row):
            field = line[start : start + widths[i]]
            assert field.strip() == cell
            assert field.startswith(cell) or i in right
            start += widths[i] + 2


def test_say_prints_whole_lines() -> None:
    stream = io.StringIO()
    say("a", "b", stream=stream)
    say(stream=stream)
    assert stream.getvalue() == "a\nb\n"
