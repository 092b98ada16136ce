"""Sphinx configuration."""

import labseq

project = "labseq"
author = "the labseq developers"
release = labseq.__version__
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
html_theme = "alabaster"
html_static_path = ["_static"]
html_theme_options = {"description": release, "page_width": "1100px"}
