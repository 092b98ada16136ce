"""Finds hardware profiles and sequences by name, including those that come with labseq."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from labseq import text_files as reading
from labseq.config.document import Document
from labseq.errors import ConfigError, Problem
from labseq.files import PROFILES, SEQUENCES, packaged_profiles_dir, packaged_sequences_dir
from labseq.messages import clean, did_you_mean, listing, visible


def is_path(name: str) -> bool:
    """Whether a text is a path, not the name of a profile or sequence.

    Example:
        >>> is_path("virtual"), is_path("mine.yaml"), is_path("../mine")
        (False, True, True)
    """
    return "/" in name or "\\" in name or name.lower().endswith(reading.YAML_SUFFIXES)


def find_profile(name_or_path: str | Path, beside: Path, *, named_in: Document | None = None) -> Path:
    """Find a hardware profile.

    Args:
        name_or_path: A name, looked for in ``beside``, in ./hardware_profiles and
            among the packaged profiles; text with a path separator or with the
            ending .yaml or .yml is a path, relative to ``beside``; a ``Path`` is
            taken as it is, relative to the working directory.
        beside: Folder of the file that names the profile.
        named_in: The sequence whose key ``profile`` names it, for messages.

    Raises:
        ConfigError: There is no such profile; with the places and the names there are.
    """
    if isinstance(name_or_path, Path):
        return name_or_path
    folders = list(dict.fromkeys((beside, Path(PROFILES), packaged_profiles_dir())))
    if is_path(name_or_path):
        path = reading.beside(beside, name_or_path)
        if reading.is_file(path):
            return path
        kind = "a folder, not a hardware profile," if reading.is_folder(path) else "no hardware profile"
        what, expected = f"there is {kind} at {visible(str(path))}", ""
        hint = reading.alike_file(path)
    else:
        found = _named(name_or_path, folders)
        if found is not None:
            return found
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
        given: A path, relative to the working directory; or a name, without a path separator and without
            the ending .yaml or .yml: it is looked for in the working directory, in ./sequences and
            among the packaged sequences.

    Raises:
        ConfigError: There is no sequence of this name; with the places and the names there are.
    """
    name = str(given)
    if is_path(name) or given.suffix:
        packaged = packaged_sequences_dir() / given.name
        if reading.is_file(packaged) and not reading.is_file(given) and not reading.something_else(given):
            raise ConfigError(Problem("there is no such file", visible(name), hint=_hint_at(packaged)))
        return given
    folders = (Path(), Path(SEQUENCES), packaged_sequences_dir())
    found = given if reading.is_file(given) else _named(name, folders)
    if found is not None or reading.something_else(given):
        return found or given
    names = _names([*folders[1:]])
    places = ", ".join(visible(str(folder)) for folder in folders)
    what = f"there is no sequence '{clean(name)}' in {places}"
    hint = did_you_mean(name, names) or reading.alike_file(given)
    raise ConfigError(Problem(what, expected=listing(names) if names else "a file", hint=hint))


def _hint_at(packaged: Path) -> str:
    return f"say '{packaged.stem}' for the one that comes with labseq, or copy it by 'labseq demo --copy .'"


def _named(name: str, folders: Sequence[Path]) -> Path | None:
    """The first file of a name in the folders, whichever YAML ending it has."""
    paths = (folder / f"{name}{suffix}" for folder in folders for suffix in reading.YAML_SUFFIXES)
    return next((path for path in paths if reading.is_file(path)), None)


def _names(folders: list[Path]) -> list[str]:
    """Names of the profiles in the folders; a sequence's folder is full of other files."""
    return list(dict.fromkeys(Path(name).stem for folder in folders for name in reading.files_in(folder)))
