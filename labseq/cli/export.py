"""``labseq export``: a run in one file that other programs read."""

from __future__ import annotations

import sys
from pathlib import Path

from labseq.cli.output import say
from labseq.cli.show import chosen_run
from labseq.cli.words import plural
from labseq.errors import RecordingError
from labseq.recording import Run
from labseq.recording.export import ENDINGS, check_export, export_run, files_of


def export_to(run: Path | None, kind: str, output: Path | None, *, frames: bool, replace: bool) -> int:
    """Export a run, and say what was written.

    Args:
        run: The run's folder or any file in it; None for the newest run.
        kind: One of :data:`labseq.recording.export.ENDINGS`.
        output: The file; None for one named after the run, in the current folder.
        frames: Whether an archive holds the frames.
        replace: Whether files that are there may be replaced.

    Returns:
        The exit code: 1 if shots had to be left out.

    Raises:
        ConfigError: There is no such run, or the file cannot be written.
        RecordingError: The run is damaged.
    """
    if output is not None:
        check_export(kind, output, frames=frames, replace=replace)
    opened = chosen_run(run)
    path = output or Path(f"{opened.path.parent.name}_{opened.path.name}{ENDINGS.get(kind, '')}")
    check_export(kind, path, frames=frames, replace=replace)
    left_out = export_run(opened, kind, path, frames=frames)
    for line in (*state_lines(opened), *(f"left out: {text}" for text in left_out)):
        say(f"warning: {line}", stream=sys.stderr)
    for file in files_of(kind, path):
        say(f"written: {file}")
    return RecordingError.exit_code if left_out else 0


def state_lines(run: Run) -> list[str]:
    """What is to be known of a run that did not complete."""
    shots = f"{plural(len(run.shots), 'shot')} of {run.n_shots}"
    if run.status == "running":
        return [f"the run still goes on; exported are the {shots} that it had"]
    lines = (
        [] if run.status == "complete" else [f"the run did not complete ({run.status}); exported are {shots}"]
    )
    if run.n_damaged_lines:
        damaged = plural(run.n_damaged_lines, "line")
        lines.append(f"{damaged} of the index cannot be read; see labseq doctor")
    return lines
