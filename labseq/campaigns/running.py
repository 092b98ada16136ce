"""Takes the runs of a campaign one after the other, or several at a time by processes or a cluster."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Generator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from labseq.campaigns.campaign import CAMPAIGN_FILE, Campaign, PlannedRun, Point, run_folders
from labseq.config.document import Document
from labseq.console.output import say
from labseq.data.reader import Run, open_run
from labseq.errors import AlarmError, ConfigError, LabseqError, Problem
from labseq.files import explained, write_file
from labseq.guard import StopFlag, stop_on_signals
from labseq.messages import clean, visible
from labseq.processes import Lock
from labseq.recording.folders import LOCK_FILE
from labseq.recording.run_file import read_owner, sha256_of_text
from labseq.roles import RunObserver
from labseq.session.resume import is_over
from labseq.session.session import Session
from labseq.session.stopping import ask_to_stop, is_running
from labseq.workers import POLL_S, Workers, portable

RunSession: TypeAlias = "Callable[[Callable[[RunObserver | None], Session]], None]"
"""Runs the session that a function opens with an observer."""
Missing: TypeAlias = "list[tuple[PlannedRun, Path | None]]"
"""Runs to take, each with the folder of an earlier start that is to be resumed."""


@dataclass(frozen=True, slots=True)
class CampaignInputs:
    """The files and plugins from which the runs of a campaign would be made now.

    Attributes:
        texts: Point -> SHA-256 of the texts of sequence and profile.
        plugins: Name, origin and version of each plugin that is used.
    """

    texts: Mapping[Point, tuple[str, str]]
    plugins: frozenset[tuple[str, ...]]


def check_campaign(campaign: Campaign, *, in_turn: bool) -> CampaignInputs:
    """Check the sequence at every point, before the first run, and compile its kernels.

    Args:
        in_turn: Whether the runs are taken one after the other. Otherwise all hardware must be simulated.

    Raises:
        ConfigError: The sequence has an error. The message has its place if the campaign file causes it.
    """
    campaign.find_files()
    plugins, texts = set[tuple[str, ...]](), dict[Point, tuple[str, str]]()
    for run in campaign.runs():
        if run.point in texts:
            continue
        try:
            session = Session.open(campaign.sequence, **asdict(run.options))
        except ConfigError as error:
            raise campaign.placed(error, run) from error
        assembly = session.assembly
        if not (in_turn or assembly.virtual_time):
            real = [role for role, driver in assembly.hardware.drivers.items() if not driver.virtual_time]
            what = f"the profile '{assembly.hardware.profile.name}' has real hardware ({', '.join(real)})"
            expected = "simulated hardware, to take several runs at once"
            raise ConfigError(Problem(what, expected=expected, hint="leave out --workers and --scheduler"))
        if not in_turn and not texts:
            session.warm(session.build_lab())  # here, because each worker would compile the same kernels
        documents = assembly.document, assembly.hardware.document
        sequence, profile = (sha256_of_text(document.text) for document in documents)
        texts[run.point] = sequence, profile
        plugins |= _plugins(assembly)
    return CampaignInputs(texts, frozenset(plugins))


def _plugins(assembly: Any) -> set[tuple[str, ...]]:
    return {(plugin.name, plugin.origin, plugin.version) for plugin in assembly.hardware.host.used()}


@contextmanager
def campaign_folder(campaign: Campaign, folder: Path, inputs: CampaignInputs) -> Generator[Missing]:
    """Lock a campaign's folder, creating it if necessary, and give the runs that it lacks.

    Raises:
        ConfigError: Another process uses it, or its runs belong to other files or another campaign.
        RecordingError: A run is damaged, or the folder cannot be written to.
    """
    lock = Lock(folder / LOCK_FILE, "labseq campaign run")
    with explained(folder):
        holder = lock.take(lambda text: say(f"warning: {text}", stream=sys.stderr))
    if holder is not None:
        what, hint = f"this campaign is in progress: {holder}", "wait until it ends, or stop that command"
        raise ConfigError(Problem(what, visible(str(folder)), hint=hint))
    try:
        yield _missing(campaign, folder, inputs)
    finally:
        lock.release()


def _missing(campaign: Campaign, folder: Path, inputs: CampaignInputs) -> Missing:
    planned = {_key(run): run for run in campaign.runs()}
    best: dict[Any, Run] = {}
    for path in run_folders(folder):
        run = open_run(path)
        key = tuple(run.changes.items())
        if key not in planned:
            what = "this run belongs to no point of the campaign, which may have been changed"
            raise ConfigError(Problem(what, visible(str(run.path)), expected="another folder"))
        texts = run.record.get("sequence_sha256"), run.record.get("profile_sha256")
        if texts != inputs.texts[planned[key].point]:
            what = "this run was taken with a different sequence or profile file"
            expected, hint = "another folder", "or restore these files from the run's folder"
            raise ConfigError(Problem(what, visible(str(run.path)), expected=expected, hint=hint))
        if (key not in best or not is_over(best[key])) and not _is_elsewhere(run.path):
            best[key] = run
    _copy_file(campaign, folder, is_new=not best)
    return [
        (run, best[key].path if key in best else None)
        for key, run in planned.items()
        if key not in best or not is_over(best[key])
    ]


def _key(run: PlannedRun) -> tuple[tuple[str, str], ...]:
    return tuple(run.options.changes().items())


def _is_elsewhere(run_dir: Path) -> bool:
    """Whether a run of another computer has not ended, so that the computer may still write to it."""
    owner = read_owner(run_dir)
    return is_running(run_dir) and owner is not None and not owner.is_here


def _copy_file(campaign: Campaign, folder: Path, *, is_new: bool) -> None:
    """Copy the campaign file to the folder, so that its results can be read without the original."""
    copy, text = folder / CAMPAIGN_FILE, campaign.document.text
    if copy.is_file() and Document.read(copy).text == text:
        return
    if is_new and copy.exists():
        what, hint = "this file belongs to another campaign", "delete it if that campaign has ended"
        raise ConfigError(Problem(what, visible(str(copy)), expected="another folder", hint=hint))
    write_file(copy, text.encode())


def open_session(
    campaign: Campaign, run: PlannedRun, folder: Path, earlier: Path | None, observer: RunObserver | None
) -> Session:
    """Open a run of a campaign, or resume it.

    Args:
        earlier: The folder of the run, if it was started before.
    """
    if earlier is not None:
        return Session.resume(earlier, observer=observer)
    return Session.open(campaign.sequence, **asdict(replace(run.options, output=folder)), observer=observer)


def run_in_turn(run_session: RunSession, campaign: Campaign, folder: Path) -> list[AlarmError]:
    """Take the missing runs of a campaign one after the other.

    Returns:
        The alarms that ended runs. The others may well have atoms.

    Raises:
        ConfigError: The campaign has an error, or the runs in the folder belong to another one.
        LabseqError: A run failed. The same command continues the campaign.
    """
    alarms: list[AlarmError] = []
    with campaign_folder(campaign, folder, check_campaign(campaign, in_turn=True)) as missing:
        for run, earlier in missing:

            def start(observer: RunObserver | None, run: Any = run, earlier: Any = earlier) -> Session:
                return open_session(campaign, run, folder, earlier, observer)

            try:
                run_session(start)
            except AlarmError as alarm:
                alarms.append(alarm)
    return alarms


@dataclass(frozen=True, slots=True)
class WorkerTask:
    """A campaign in the form in which it is sent to a worker.

    Attributes:
        file: The campaign file.
        text: Its text.
        folder: The campaign's folder.
        plugins: Name, origin and version of each plugin that the runs use.
    """

    file: Path
    text: str
    folder: Path
    plugins: frozenset[tuple[str, ...]]


class RunTaker:
    """Takes runs of a campaign in its own process.

    Raises:
        ConfigError: This computer does not see the campaign's folder.
    """

    def __init__(self, task: WorkerTask) -> None:
        self._campaign = Campaign.read(task.file, task.text)
        self._task = task
        self._runs = [*self._campaign.runs()]
        if not (task.folder / CAMPAIGN_FILE).is_file():
            what = f"the worker on {platform.node()} does not see this folder"
            expected = "a folder of a drive that all computers see at the same path"
            raise ConfigError(Problem(what, clean(str(task.folder)), expected=expected))

    def __call__(self, number: int) -> tuple[str, LabseqError | None]:
        """Take a run, or resume it.

        Returns:
            Its folder, and the error that ended it or None.
        """
        run, folder = self._runs[number], self._task.folder
        with open_session(self._campaign, run, folder, self._earlier(run), None) as session:
            if other := _plugins(session.assembly) - self._task.plugins:
                name, _, version = min(other)
                what = f"the worker on {platform.node()} has plugin '{name}' {version}"
                raise ConfigError(Problem(what, expected="the same plugins as on the first computer"))
            try:
                session.run()
            except LabseqError as error:
                return str(session.run_dir or ""), portable(error)
            return str(session.run_dir), None

    def _earlier(self, run: PlannedRun) -> Path | None:
        """The folder of a run that was started here before, by a worker that died or an earlier command."""
        for path in reversed(run_folders(self._task.folder)):
            earlier = open_run(path)
            is_open = not is_over(earlier) and not _is_elsewhere(path)
            if is_open and earlier.changes == run.options.changes():
                return path
        return None


def run_at_once(
    campaign: Campaign, folder: Path, workers: Workers, report: Callable[[PlannedRun, Run], None]
) -> list[AlarmError]:
    """Take the missing runs of a campaign, one per worker at a time.

    If a worker dies, another one resumes its run.

    Args:
        workers: The workers. They are closed at the end.
        report: Called with each run that is complete, or was ended by an alarm.

    Returns:
        The alarms that ended runs. The others may well have atoms.

    Raises:
        ConfigError: The campaign has an error, or the runs in the folder belong to another one.
        StopRequested: Ctrl-C or SIGTERM. Stops the runs in progress, and the same command resumes them.
        LabseqError: A run failed. The same command continues the campaign.
    """
    stop = StopFlag()
    with closing(workers), stop_on_signals(stop):
        inputs = check_campaign(campaign, in_turn=False)
        # workers are closed before the folder's lock is released
        with campaign_folder(campaign, folder, inputs) as missing, closing(workers):
            keys = {_key(run) for run, _ in missing}
            remaining = {number: run for number, run in enumerate(campaign.runs()) if _key(run) in keys}
            document = campaign.document
            task = WorkerTask(document.path.resolve(), document.text, folder.resolve(), inputs.plugins)
            workers.prepare(RunTaker, task)
            try:
                return _share_out(remaining, workers, report, stop)
            finally:
                # also runs on other computers, which no signal reaches
                for path in filter(is_running, run_folders(folder) if remaining else ()):
                    ask_to_stop(path)


def _share_out(
    remaining: dict[int, PlannedRun],
    workers: Workers,
    report: Callable[[PlannedRun, Run], None],
    stop: StopFlag,
) -> list[AlarmError]:
    """Give each worker one run at a time, and remove runs that are over from ``remaining``."""
    waiting, n_out, alarms = iter([*remaining]), 0, list[AlarmError]()
    while remaining:
        while n_out < workers.n_workers and (number := next(waiting, None)) is not None:
            workers.submit(number, number)
            n_out += 1
        stop.check()
        for number, (run_dir, error) in workers.finished(POLL_S):
            if isinstance(error, AlarmError):
                alarms.append(error)
            elif error is not None:
                stop.check()  # Ctrl-C reaches the workers too, and their errors are then not failures
                raise error
            report(remaining.pop(number), open_run(run_dir))
            n_out -= 1
    return alarms
