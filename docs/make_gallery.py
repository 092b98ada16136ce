"""Draw the pictures of the pattern gallery, each from the snippet that follows it on the page.

    python docs/make_gallery.py

A picture whose name ends in ``_square`` is drawn on a square grid, all others on the triangular
one of the profile ``virtual``.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from labseq import SiteGrid, TargetPattern
from labseq.assembly.plugin_choice import construct_target, load_plugins, resolve
from labseq.config.document import Document
from labseq.pictures.targets import save_target
from labseq.settings import PatternChoice

DOCS = Path(__file__).parent
PAGE = DOCS / "reference" / "patterns.md"
PICTURES = DOCS / "_static" / "patterns"
SEQUENCES = DOCS.parent / "sequences"

_EXAMPLE = re.compile(r"!\[[^\]]+\]\(\.\./_static/patterns/(\w+)\.png\)\n\n```yaml\n(.+?)```", re.DOTALL)


@dataclass(frozen=True)
class Example:
    """A picture of the gallery, and the snippet of a sequence that it shows."""

    name: str
    snippet: str

    @property
    def picture(self) -> Path:
        return PICTURES / f"{self.name}.png"

    @property
    def grid(self) -> SiteGrid:
        return SiteGrid(lattice="square" if self.name.endswith("_square") else "triangular")

    @property
    def pattern(self) -> str:
        return PatternChoice.model_validate(self._document().data["target"]).use

    def target(self) -> TargetPattern:
        """What a sequence with this snippet asks for, on the example's grid.

        Raises:
            ConfigError: The snippet is wrong.
        """
        document = self._document()
        choice = PatternChoice.model_validate(document.data["target"]).placed("target")
        return construct_target(resolve(load_plugins(), document, "pattern", choice), self.grid)

    def _document(self) -> Document:
        """The snippet as if it stood in a file beside the sequences."""
        document = Document.parse(self.snippet, f"{self.name} in {PAGE.name}")
        return replace(document, path=SEQUENCES / "gallery.yaml")


def examples() -> Iterator[Example]:
    """All examples of the page, in order."""
    for match in _EXAMPLE.finditer(PAGE.read_text(encoding="utf-8")):
        yield Example(*match.groups())


def main() -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    for example in examples():
        save_target(example.picture, example.target(), example.grid)
        sys.stdout.write(f"{example.picture.relative_to(DOCS)}: {example.target().name}\n")


if __name__ == "__main__":
    main()
