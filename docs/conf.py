"""Sphinx configuration."""

import labseq

project = "labseq"
author = "the labseq developers"
release = labseq.__version__
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
smartquotes = False  # quotes and dashes are to be copied
html_theme = "alabaster"
html_static_path = ["_static"]
html_css_files = ["labseq.css"]
html_theme_options = {"description": release, "page_width": "1100px"}
