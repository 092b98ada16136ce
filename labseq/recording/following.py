"""Goes along with a run in progress, shot by shot."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

from labseq.errors import RecordingError
from labseq.recording import folders
from labseq.recording.durable import parse_object
from labseq.recording.run_file import is_index_row
from labseq.recording.shot import Shot, load_content


class Follower:
    """Gives each shot that counts once, when it is in the index of its run.

    It keeps nothing but its place in the index.

    Args:
        run_dir: The run's folder.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._offset = 0

    def new(self) -> Generator[Shot]:
        """The shots since the last time, until there are no more for now.

        Raises:
            RecordingError: The index cannot be read.
        """
        path = self._run_dir / folders.INDEX_FILE
        try:
            with path.open("rb") as index:
                index.seek(self._offset)
                for line in index:
                    if not line.endswith(b"\n"):
                        return
                    self._offset += len(line)
                    row = parse_object(line)
                    if row is not None and is_index_row(row) and row["counts"]:
                        yield Shot(self._run_dir / row["file"], row, load_content)
        except FileNotFoundError:
            return
        except OSError as error:
            raise RecordingError(path, f"cannot be read: {error.strerror}; check the disk") from error
