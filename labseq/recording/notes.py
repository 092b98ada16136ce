"""Note and tags of a run, in notes.json in its folder, written by the web page and the command line."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self, cast

from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import read_file, write_file
from labseq.messages import clean
from labseq.plain import dumps, now_utc, parse_object
from labseq.recording.folders import NOTES_FILE

MAX_NOTE: Final = 10_000
"""Maximum number of characters of a note."""
MAX_TAG: Final = 60
"""Maximum number of characters of a tag."""
MAX_TAGS: Final = 20


@dataclass(frozen=True, slots=True)
class Notes:
    """The note and tags of a run.

    Attributes:
        comment: The note, any text.
        tags: Words or short phrases by which to find it.
    """

    comment: str = ""
    tags: tuple[str, ...] = ()

    @classmethod
    def of(cls, comment: str, tags: Iterable[str] = ()) -> Self:
        """Notes as a user gives them. Spaces around tags and repeated tags are removed.

        Raises:
            ConfigError: A text is too long, or there are too many tags.
        """
        tidied = tuple(dict.fromkeys(text for tag in tags if (text := " ".join(tag.split()))))
        if len(comment) > MAX_NOTE:
            raise ConfigError(Problem("the note is too long", expected=f"at most {MAX_NOTE} characters"))
        if long := [tag for tag in tidied if len(tag) > MAX_TAG]:
            what = f"the tag '{clean(long[0][:MAX_TAG])}...' is too long"
            raise ConfigError(Problem(what, expected=f"at most {MAX_TAG} characters"))
        if len(tidied) > MAX_TAGS:
            raise ConfigError(Problem(f"there are {len(tidied)} tags", expected=f"at most {MAX_TAGS}"))
        return cls(comment, tidied)

    def encoded(self) -> bytes:
        """The content of notes.json."""
        values = {"comment": self.comment, "tags": self.tags, "t_utc": now_utc()}
        return dumps(values, indent=1).encode() + b"\n"


def read_notes(folder: Path) -> Notes:
    """Note and tags of a run. Empty if there are none or the file is damaged."""
    values: Mapping[str, Any] = {}
    with suppress(RecordingError):
        if (folder / NOTES_FILE).exists():
            values = parse_object(read_file(folder / NOTES_FILE, 1 << 20)) or {}
    tags: Any = values.get("tags")
    listed = cast("list[Any]", tags)[:MAX_TAGS] if isinstance(tags, list) else []
    comment = str(values.get("comment") or "")[:MAX_NOTE]
    return Notes(comment, tuple(str(tag)[:MAX_TAG] for tag in listed))


def write_notes(folder: Path, notes: Notes) -> None:
    """Replace note and tags of a run.

    Raises:
        RecordingError: The folder cannot be written to.
    """
    write_file(folder / NOTES_FILE, notes.encoded())
