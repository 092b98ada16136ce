"""Sphinx configuration."""

import re
import sys
from pathlib import Path

import labseq

sys.path.insert(0, str(Path(__file__).parent))

from make_reference import complete

project = "labseq"
author = "the labseq developers"
release = labseq.__version__
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
smartquotes = False  # quotes and dashes are to be copied
html_theme = "furo"
html_title = f"labseq {release}"
html_static_path = ["_static"]
html_css_files = ["labseq.css"]
html_show_sphinx = False
html_theme_options = {"top_of_page_buttons": []}


def add_parts(_app: object, page: str, source: list[str]) -> None:
    """Put the generated parts of the reference into a page; make the links of an index page its contents."""
    source[0] = complete(source[0])
    if page.endswith("/index"):
        pages = dict.fromkeys(re.findall(r"\]\(((?:\.\./explanation/)?[\w-]+)\.md\)", source[0]))
        source[0] += "\n```{toctree}\n:hidden:\n\n" + "\n".join(pages) + "\n```\n"


def setup(app: object) -> None:
    """Connect what this file defines."""
    app.connect("source-read", add_parts)  # pyright: ignore[reportAttributeAccessIssue]
