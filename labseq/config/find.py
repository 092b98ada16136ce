"""Finds hardware profiles and sequences by name, including the packaged ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from labseq.errors import ConfigError, Problem
from labseq.files import PROFILES, SEQUENCES, packaged_profiles_dir, packaged_sequences_dir
from labseq.messages import clean, did_you_mean, listing, visible
from labseq.settings import path_beside
from labseq.text_files import (
    YAML_SUFFIXES,
    alike_file,
    files_in,
    is_file,
    is_folder,
    something_else,
)

if TYPE_CHECKING:
    from labseq.config.document import Document


def is_path(name: str) -> bool:
    """Whether a text is a path instead of the name of a profile or sequence.

    Example:
        >>> is_path("virtual"), is_path("mine.yaml"), is_path("../mine")
        (False, True, True)
    """
    return "/" in name or "\\" in name or name.lower().endswith(YAML_SUFFIXES)


def find_profile(name_or_path: str | Path, beside: Path, *, named_in: Document | None = None) -> Path:
    """Find a hardware profile.

    Args:
        name_or_path: A name is searched in ``beside``, in ./hardware_profiles and among the packaged
            profiles. Text with a path separator or with the ending .yaml or .yml is a path, relative to
            ``beside``. A ``Path`` is relative to the working directory.
        beside: Folder of the file that names the profile.
        named_in: The sequence whose key ``profile`` names it, for messages.

    Raises:
        ConfigError: There is no such profile. The message names the searched folders and the known profiles.
    """
    if isinstance(name_or_path, Path):
        return name_or_path
    folders = list(dict.fromkeys((beside, Path(PROFILES), packaged_profiles_dir())))
    if is_path(name_or_path):
        path = path_beside(beside, name_or_path)
        if is_file(path):
            return path
        kind = "a folder, not a hardware profile," if is_folder(path) else "no hardware profile"
        what, expected = f"there is {kind} at {visible(str(path))}", ""
        hint = alike_file(path)
    else:
        path = _named(name_or_path, folders)
        if path is not None:
            return path
        names = _names(folders[1:])
        places = ", ".join(visible(str(folder)) for folder in folders)
        what = f"there is no hardware profile '{clean(name_or_path)}' in {places}"
        expected = listing(names) if names else "the path of one"
        hint = did_you_mean(name_or_path, names)
    if named_in is not None:
        raise named_in.error(("profile",), what, expected, hint)
    raise ConfigError(Problem(what, expected=expected, hint=hint))


def find_sequence(given: Path) -> Path:
    """Find a sequence.

    Args:
        given: A path, relative to the working directory, or a name without a path separator and without the
            ending .yaml or .yml. A name is searched in the working directory, in ./sequences and among the
            packaged sequences.

    Raises:
        ConfigError: There is no such sequence. The message names the searched folders and the known
            sequences.
    """
    name = str(given)
    if is_path(name) or given.suffix:
        packaged = packaged_sequences_dir() / given.name
        if is_file(packaged) and not is_file(given) and not something_else(given):
            copied = "or copy it with 'labseq demo --copy .'"
            hint = f"use '{packaged.stem}' for labseq's own sequence, {copied}"
            raise ConfigError(Problem("there is no such file", visible(name), hint=hint))
        return given
    folders = (Path(), Path(SEQUENCES), packaged_sequences_dir())
    path = given if is_file(given) else _named(name, folders)
    if path is not None or something_else(given):
        return path or given
    names = _names([*folders[1:]])
    places = ", ".join(visible(str(folder)) for folder in folders)
    what = f"there is no sequence '{clean(name)}' in {places}"
    hint = did_you_mean(name, names) or alike_file(given)
    raise ConfigError(Problem(what, expected=listing(names) if names else "a file", hint=hint))


def _named(name: str, folders: Sequence[Path]) -> Path | None:
    """The first file with a name in the folders, with the suffix .yaml or .yml."""
    paths = (folder / f"{name}{suffix}" for folder in folders for suffix in YAML_SUFFIXES)
    return next((path for path in paths if is_file(path)), None)


def _names(folders: list[Path]) -> list[str]:
    """Names of the YAML files in the folders, without their endings."""
    return list(dict.fromkeys(Path(name).stem for folder in folders for name in files_in(folder)))
