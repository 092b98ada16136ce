"""The processes that analyse a run's shots while it goes on."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from labseq.errors import LabseqError
from labseq.recording import open_run
from labseq.recording.results import ERROR, done, read_results, results_file
from labseq.session.analysing import FAILED, FINISH_WITHIN, USE
from labseq.units import format_quantity

GRACE_S: Final = 2.0
"""How much longer than its time a process may take to end by itself."""
MAX_READ: Final = 1 << 16
"""Bytes of a log that are looked at, from its end."""
_MODULE: Final = "labseq.session.analysis_process"

Tell = Callable[[str], None]


class AnalysisProcesses:
    """A process for each analysis of a run; nothing that they do stops or slows the run.

    Args:
        run_dir: The run's folder.
        analyses: "use" and "finish_within" of each.
        tell: Told what went wrong.
    """

    def __init__(self, run_dir: Path, analyses: Sequence[Mapping[str, Any]], tell: Tell) -> None:
        self._run_dir = run_dir
        self._report = tell
        self._analysts: list[_AnalysisProcess] = []
        for analysis in analyses:
            name = str(analysis[USE])
            try:
                self._analysts.append(_AnalysisProcess(run_dir, name, float(analysis[FINISH_WITHIN])))
            except OSError as error:
                tell(f"the process of analysis '{name}' could not be started: {error.strerror}")

    def look(self) -> None:
        """Tell of each analysis, once, that it has failed; quick, for use between shots."""
        for one in self._analysts:
            one.look(self._report)

    def finish(self) -> None:
        """The run is over: give each its time for the shots that are left, then tell what is missing."""
        for one in self._analysts:
            one.end_of_run()
        end_s = time.monotonic()
        for one in self._analysts:
            one.wait(end_s, self._report)
            self._report_missing(one.name)
        self._analysts = []

    def _report_missing(self, name: str) -> None:
        with suppress(LabseqError):
            rows = read_results(results_file(self._run_dir, name))[0]
            shots = {shot.index for shot in open_run(self._run_dir).shots}
            n_missing, n_failed = len(shots - done(rows)), sum(ERROR in row for row in rows)
            if n_missing:
                failed = f" ({n_failed} failed)" if n_failed else ""
                text = f"analysis '{name}' has no result of {n_missing} of {len(shots)} shots{failed}"
                self._report(f"{text}; 'labseq analyse {self._run_dir}' makes up what is missing")


class _AnalysisProcess:
    """The process of one analysis."""

    def __init__(self, run_dir: Path, name: str, finish_within_s: float) -> None:
        self.name = name
        self._finish_within_s = finish_within_s
        self._told = False
        self._log = results_file(run_dir, name).with_suffix(".log")
        self._log.parent.mkdir(exist_ok=True)
        with self._log.open("ab") as log:
            self._seen = log.tell()
            self._process = subprocess.Popen(  # noqa: S603 - our own module, no shell
                [sys.executable, "-P", "-m", _MODULE, str(run_dir), name, str(finish_within_s)],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,  # Ctrl-C and a lost terminal are the run's matter
                creationflags=_flags(),
            )

    def look(self, tell: Tell) -> None:
        """Tell the first failure; all of them stand in its log."""
        if self._told:
            return
        code = self._process.poll()
        with suppress(OSError):
            lines = self._new_lines()
            failed = [line.removeprefix(FAILED) for line in lines if line.startswith(FAILED)]
            if code and not failed:
                failed = [": ".join([f"its process ended with exit code {code}", *lines[-1:]])]
            if failed:
                tell(f"analysis '{self.name}' failed: {failed[0]}; see {self._log}")
                self._told = True

    def end_of_run(self) -> None:
        """Tell it that no more shots come."""
        assert self._process.stdin is not None
        with suppress(OSError):  # it is gone
            self._process.stdin.close()

    def wait(self, end_s: float, tell: Tell) -> None:
        """Wait until it has ended, and end it if its time is up.

        Args:
            end_s: When the run ended, on this computer's monotonic clock.
            tell: Told what went wrong.
        """
        left_s = end_s + self._finish_within_s + GRACE_S - time.monotonic()
        try:
            self._process.wait(max(0.0, left_s))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            within = format_quantity(self._finish_within_s, "time")
            tell(f"analysis '{self.name}' did not finish within {within} after the run, and was ended")
            self._told = True
        self.look(tell)
        with suppress(OSError):
            if not self._log.stat().st_size:
                self._log.unlink()

    def _new_lines(self) -> list[str]:
        """What its log has got since the last look, the end of it."""
        if self._log.stat().st_size == self._seen:
            return []
        with self._log.open("rb") as log:
            log.seek(max(self._seen, self._log.stat().st_size - MAX_READ))
            text = log.read(MAX_READ)
            self._seen = log.tell()
        return text.decode(errors="replace").splitlines()


def _flags() -> int:
    if sys.platform == "win32":
        return subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.BELOW_NORMAL_PRIORITY_CLASS
    return 0
