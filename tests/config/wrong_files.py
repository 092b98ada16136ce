"""Tables of wrong files: a change of a right file, and below it the first message about it, exactly."""

from __future__ import annotations


def wrong_files(table: str) -> list[tuple[str, str, str]]:
    """Old text, new text and message of each case; ⏎ is a line break, ⇥ a tab, ∅ nothing."""
    lines = table.strip("\n").split("\n")
    cases: list[tuple[str, str, str]] = []
    for change, message in zip(lines[::2], lines[1::2], strict=True):
        plain = change.replace("⏎", "\n").replace("⇥", "\t").replace("∅", "")
        old, _, new = plain.partition(" => ")
        cases.append((old, new, message.removeprefix("  ")))
    return cases
