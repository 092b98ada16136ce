"""Everything that can be made, made once for all tests."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest

from labseq.roles import ROLES
from labseq.scaffold.new import CreatedFiles, make_file, make_plugin


class Folder(NamedTuple):
    """A folder with a plugin of every kind, a planner as a package, a sequence and a profile.

    Attributes:
        path: The folder.
        plugins: Kind -> what was made, under the name that :func:`name_of` gives it.
        package: The package, a planner.
        sequence: The sequence "first".
        profile: The profile "mine".
    """

    path: Path
    plugins: dict[str, CreatedFiles]
    package: CreatedFiles
    sequence: CreatedFiles
    profile: CreatedFiles


def name_of(kind: str) -> str:
    """Six letters, as the templates are laid out for: names of other lengths may fold lines otherwise."""
    return f"own{kind[:3]}"


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    folder = tmp_path_factory.mktemp("made")
    plugins = {kind: make_plugin(kind, name_of(kind), folder) for kind in ROLES}
    package = make_plugin("planner", "packed", folder, package=True)
    sequence = make_file("sequence", "first", folder)
    profile = make_file("profile", "mine", folder)
    return Folder(folder, plugins, package, sequence, profile)
