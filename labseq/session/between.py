"""What is done between two shots of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from labseq.recording import RunWriter
from labseq.session.policies import Checks
from labseq.session.stopping import look_for_stop


class ShotHooks:
    """Looks for a request to stop, and at what the last shots came to; puts down what is skipped.

    Args:
        writer: The run's folder.
        checks: The checks of the sequence.
        emit: Told every event: name and values.
    """

    def __init__(
        self, writer: RunWriter, checks: Checks, emit: Callable[[str, Mapping[str, Any]], None]
    ) -> None:
        self._writer = writer
        self._checks = checks
        self._emit = emit

    @property
    def left_open(self) -> tuple[int, str]:
        """The last shot of the run as it was before, and why the others of its point are to be skipped.

        That is "" if they are not. It may have been put down then, or not.
        """
        return self._checks.left_open

    def before(self) -> None:
        """Before a shot.

        Raises:
            StopRequested: The run is asked to end.
        """
        look_for_stop(self._writer.run_dir)

    def after(self, given_up: Sequence[str]) -> str:
        """After a shot.

        Args:
            given_up: Why the shot was given up, if it was.

        Returns:
            Why the other shots of its point shall be skipped, or "".

        Raises:
            CheckFailedError: A value is beyond the limits of a check that stops the run.
        """
        return given_up[0] if given_up else self._checks.after(self._writer.last_row)

    def skip(self, shots: Sequence[int], why: str) -> None:
        """Put down that shots will not be taken.

        Raises:
            RecordingError: The disk is full.
        """
        if shots:
            self._writer.skip(shots, why)
            told = f"shot {shots[0] + 1} is" if len(shots) == 1 else f"{len(shots)} shots are"
            self._emit("warning", {"text": f"{told} skipped: {why}"})
            self._emit("shots_skipped", {"shots": list(shots), "why": why})
