"""Where hardware profiles are."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from labseq.config import reading
from labseq.config.document import Document
from labseq.config.wording import clean, did_you_mean, listing, visible
from labseq.errors import ConfigError, Problem

_FOLDER: Final = "hardware_profiles"


def packaged_profiles_dir() -> Path:
    """The folder of the profiles that come with labseq.

    In a wheel it lies beside this file, in a checkout at the top.
    """
    here = Path(__file__).resolve().parent
    packaged = here / _FOLDER
    return packaged if packaged.is_dir() else here.parents[1] / _FOLDER


def is_path(name: str) -> bool:
    """Whether the value of ``profile`` is a path, not a name.

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
    folders = list(dict.fromkeys((beside, Path(_FOLDER), packaged_profiles_dir())))
    if is_path(name_or_path):
        path = reading.beside(beside, name_or_path)
        if reading.is_file(path):
            return path
        kind = "a folder, not a hardware profile," if reading.is_folder(path) else "no hardware profile"
        what, expected = f"there is {kind} at {visible(str(path))}", ""
        hint = reading.alike_file(path)
    else:
        for folder in folders:
            for suffix in reading.YAML_SUFFIXES:
                path = folder / f"{name_or_path}{suffix}"
                if reading.is_file(path):
                    return path
        names = _names(folders[1:])
        places = ", ".join(visible(str(folder)) for folder in folders)
        what = f"there is no hardware profile '{clean(name_or_path)}' in {places}"
        expected = listing(names) if names else "the path of one"
        hint = did_you_mean(name_or_path, names)
    if named_in is not None:
        raise named_in.error(("profile",), what, expected, hint)
    raise ConfigError(Problem(what, expected=expected, hint=hint))


def _names(folders: list[Path]) -> list[str]:
    """Names of the profiles in the folders; a sequence's folder is full of other files."""
    return list(dict.fromkeys(Path(name).stem for folder in folders for name in reading.files_in(folder)))
