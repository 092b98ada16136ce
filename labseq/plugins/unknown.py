"""Explains why no plugin offers a name in a file, and what to do about it."""

from __future__ import annotations

import difflib
import os
import re
from contextlib import suppress
from pathlib import Path

from labseq.errors import LabseqError, PluginLoadError, UnknownPluginError
from labseq.files import PLUGINS
from labseq.plugins.host import PluginHost, plugin_files


def unknown_plugin(host: PluginHost, kind: str, name: str, file: Path | None) -> LabseqError:
    """The error for a name that no plugin offers, because a plugin did not load or the name is misspelt.

    Args:
        file: The file with the name.
    """
    broken = [info for info in host.infos if info.state == "failed"]
    for info in broken:
        if info.name.removeprefix("labseq_").split(" ")[0] == name.removeprefix("labseq_"):
            return PluginLoadError(info.name, info.reason, info.source)
    known = host.registry.names(kind)
    hints = [f"did you mean '{near}'?" for near in difflib.get_close_matches(name, known, n=1)]
    hints += [_missing_folder(file), _advice(kind, name, file)]
    # most steps and patterns are labseq's own, so such a name is more likely misspelt
    if kind not in ("step", "pattern"):
        hints += [f"plugin '{info.name}' did not load ({info.reason})" for info in broken]
    return UnknownPluginError(kind, name, known, "; ".join(filter(None, hints)))


def _advice(kind: str, name: str, file: Path | None) -> str:
    """The option or key that loads a plugin of ``./plugins``, or of that folder next to ``file``, or "".

    The plugin is found in the text of the folder's files. None of them is run.
    """
    offers = re.compile(rf"\.{kind}\(\s*[\"']{re.escape(name)}[\"']")
    for folder in [Path(PLUGINS)] + ([file.parent / PLUGINS] if file is not None else []):
        with suppress(OSError, ValueError):  # ValueError for another drive of Windows
            for path in plugin_files(folder):
                if not offers.search(path.read_text("utf-8", "replace")):
                    continue
                add = f"use --plugins {folder}"
                if file is not None and file.is_file():
                    relative = Path(os.path.relpath(folder, file.parent)).as_posix()
                    add = f"add 'plugin_folders: [{relative}]' to {file.name}, or {add}"
                return f"{path} offers it but is not loaded ({add})"
    return ""


def _missing_folder(file: Path | None) -> str:
    """A hint at the folder ``plugins`` that a file names but that was not copied along with it, or ""."""
    with suppress(OSError, ValueError):
        if file is None or (folder := file.parent / PLUGINS).is_dir():
            return ""
        if re.search(rf"^plugin_folders:.*\b{PLUGINS}\b", file.read_text("utf-8"), re.MULTILINE):
            return f"its plugin folder {folder} does not exist"
    return ""
