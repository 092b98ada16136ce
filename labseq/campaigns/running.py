"""Takes the runs of a campaign: one after the other, or several at a time by processes or a cluster."""

from __future__ import annotations

import platform
from collections.abc import Callable, Generator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from labseq.campaigns.campaign import CAMPAIGN_FILE, Campaign, PlannedRun, Point, run_folders
from labseq.config.document import Document
from labseq.data import Run, open_run
from labseq.errors import ConfigError, LabseqError, Problem
from labseq.files import explained, write_file
from labseq.guard import StopFlag, stop_on_signals
from labseq.messages import clean, visible
from labseq.processes import Lock
from labseq.recording.folders import LOCK_FILE
from labseq.recording.run_file import read_owner, read_state, sha256_of_text
from labseq.roles import RunObserver
from labseq.session.provenance import plugins_of
from labseq.session.session import Session
from labseq.session.stopping import ask_to_stop, is_running
from labseq.workers import POLL_S, Workers, portable

RunSession: TypeAlias = "Callable[[Callable[[RunObserver | None], Session]], None]"
"""Runs the session that a function opens with an observer."""
Missing: TypeAlias = "list[tuple[PlannedRun, Path | None]]"
"""Runs to take, and the folder of the one that was begun, to be resumed."""


@dataclass(frozen=True, slots=True)
class Checked:
    """What the runs of a campaign are made from, as they would be today.

    Attributes:
        texts: Point -> SHA-256 of sequence and profile.
        plugins: Name, origin and version of each plugin that is used.
    """

    texts: Mapping[Point, tuple[str, str]]
    plugins: frozenset[tuple[str, ...]]


def check_campaign(campaign: Campaign, *, in_turn: bool) -> Checked:
    """Check the sequence at every point, before the first run, and compile its kernels.

    Args:
        in_turn: Whether the runs are taken one after the other: only simulated ones can be taken at once.

    Raises:
        ConfigError: It has an error; at the place of the value in the campaign file, if that is wrong.
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
            chosen = assembly.hardware.chosen.items()
            real = [role for role, one in chosen if one.entry.role.is_hardware and not one.virtual_time]
            what = f"the profile '{assembly.hardware.profile.name}' has real hardware ({', '.join(real)})"
            expected = "simulated hardware, to take several runs at once"
            raise ConfigError(Problem(what, expected=expected, hint="leave out --workers and --scheduler"))
        if not in_turn and not texts:
            session.warm(session.build_lab())  # here, as several processes would each compile the same
        documents = assembly.document, assembly.hardware.document
        sequence, profile = (sha256_of_text(document.text) for document in documents)
        texts[run.point] = sequence, profile
        plugins |= _plugins(assembly)
    return Checked(texts, frozenset(plugins))


def _plugins(assembly: Any) -> set[tuple[str, ...]]:
    return {tuple(plugin.values()) for plugin in plugins_of(assembly)}


@contextmanager
def begun(campaign: Campaign, folder: Path, checked: Checked) -> Generator[Missing]:
    """Use a campaign's folder, alone, and find out which runs it lacks; it is created if need be.

    Raises:
        ConfigError: Another process uses it; or the runs in it are of other files, or not of this campaign.
        RecordingError: A run is damaged, or the folder cannot be written to.
    """
    with explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
    lock = Lock(folder / LOCK_FILE, "labseq campaign run")
    with suppress(OSError):  # some network drives have no locks
        if (holder := lock.take()) is not None:
            what, hint = f"this campaign is in progress: {holder}", "wait for its end, or stop that command"
            raise ConfigError(Problem(what, visible(str(folder)), hint=hint))
    try:
        yield _missing(campaign, folder, checked)
    finally:
        lock.release()


def _missing(campaign: Campaign, folder: Path, checked: Checked) -> Missing:
    wanted = {_key(run): run for run in campaign.runs()}
    found: dict[Any, Run] = {}
    for path in run_folders(folder):
        run = open_run(path)
        key = tuple(run.changes.items())
        if key not in wanted:
            what = "this run belongs to no point of the campaign, which may have been changed since"
            raise ConfigError(Problem(what, visible(str(run.path)), expected="another folder"))
        texts = run.record.get("sequence_sha256"), run.record.get("profile_sha256")
        if texts != checked.texts[wanted[key].point]:
            what = "this run was taken with another text of the sequence or the profile"
            expected, hint = "another folder", "or the files as they were, which are in the run's folder"
            raise ConfigError(Problem(what, visible(str(run.path)), expected=expected, hint=hint))
        if (key not in found or found[key].status != "complete") and not _is_elsewhere(run.path):
            found[key] = run
    _keep(campaign, folder, is_new=not found)
    return [
        (run, found[key].path if key in found else None)
        for key, run in wanted.items()
        if key not in found or found[key].status != "complete"
    ]


def _key(run: PlannedRun) -> tuple[tuple[str, str], ...]:
    return tuple(run.options.changes().items())


def _is_elsewhere(run_dir: Path) -> bool:
    """Whether another computer began a run and has not ended it: it may still write to the folder."""
    owner = read_owner(run_dir)
    return is_running(run_dir) and owner is not None and not owner.is_here


def _keep(campaign: Campaign, folder: Path, *, is_new: bool) -> None:
    """Copy the campaign file to the folder, so that its results can be read without the original."""
    kept, text = folder / CAMPAIGN_FILE, campaign.document.text
    if kept.is_file() and Document.read(kept).text == text:
        return
    if is_new and kept.exists():
        what, hint = "this file is of another campaign", "delete it if that campaign has ended"
        raise ConfigError(Problem(what, visible(str(kept)), expected="another folder", hint=hint))
    write_file(kept, text.encode())


def open_session(
    campaign: Campaign, run: PlannedRun, folder: Path, begun: Path | None, observer: RunObserver | None
) -> Session:
    """Open a run of a campaign, or resume it.

    Args:
        folder: The campaign's folder.
        begun: The folder of the run, if it was begun.
    """
    if begun is not None:
        return Session.resume(begun, observer=observer)
    return Session.open(campaign.sequence, **asdict(replace(run.options, output=folder)), observer=observer)


def run_in_turn(run_session: RunSession, campaign: Campaign, folder: Path) -> None:
    """Take the missing runs of a campaign one after the other.

    Raises:
        ConfigError: The campaign has an error, or the runs in the folder are not its own.
        LabseqError: What ended a run; the campaign is continued by the same command.
    """
    with begun(campaign, folder, check_campaign(campaign, in_turn=True)) as missing:
        for run, earlier in missing:

            def start(observer: RunObserver | None, run: Any = run, earlier: Any = earlier) -> Session:
                return open_session(campaign, run, folder, earlier, observer)

            run_session(start)


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a worker needs to know of a campaign.

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
    """Takes runs of a campaign in a process of its own.

    Raises:
        ConfigError: This computer does not see the campaign's folder.
    """

    def __init__(self, recipe: Recipe) -> None:
        self._campaign = Campaign.read(recipe.file, recipe.text)
        self._recipe = recipe
        self._runs = [*self._campaign.runs()]
        if not (recipe.folder / CAMPAIGN_FILE).is_file():
            what = f"the worker on {platform.node()} does not see this folder"
            expected = "a folder of a drive that all computers see at the same path"
            raise ConfigError(Problem(what, clean(str(recipe.folder)), expected=expected))

    def __call__(self, number: int) -> tuple[str, LabseqError | None]:
        """Take a run, or resume it.

        Returns:
            Its folder, and the error that ended it or None.
        """
        run, folder = self._runs[number], self._recipe.folder
        with open_session(self._campaign, run, folder, self._begun(run), None) as session:
            if other := _plugins(session.assembly) - self._recipe.plugins:
                name, _, version = min(other)
                what = f"the worker on {platform.node()} has plugin '{name}' {version}"
                raise ConfigError(Problem(what, expected="the same plugins as on the first computer"))
            try:
                session.run()
            except LabseqError as error:
                return str(session.run_dir or ""), portable(error)
            return str(session.run_dir), None

    def _begun(self, run: PlannedRun) -> Path | None:
        """The folder of a run that was begun here: by a worker that died, or an earlier command."""
        for path in reversed(run_folders(self._recipe.folder)):
            is_open = read_state(path)[0] != "complete" and not _is_elsewhere(path)
            if is_open and open_run(path).changes == run.options.changes():
                return path
        return None


def run_at_once(
    campaign: Campaign, folder: Path, workers: Workers, report: Callable[[PlannedRun, Run], None]
) -> None:
    """Take the missing runs of a campaign, as many at a time as there are workers.

    If a worker dies, another one resumes its run.

    Args:
        workers: The workers; closed at the end.
        report: Called with each run that is complete.

    Raises:
        ConfigError: The campaign has an error, or the runs in the folder are not its own.
        StopRequested: Ctrl-C or SIGTERM; the runs in progress are stopped, and resumed by the next command.
        LabseqError: What ended a run; the campaign is continued by the same command.
    """
    stop = StopFlag()
    with closing(workers), stop_on_signals(stop):
        checked = check_campaign(campaign, in_turn=False)
        with begun(campaign, folder, checked) as missing, closing(workers):  # before the folder is free
            keys = {_key(run) for run, _ in missing}
            left = {number: run for number, run in enumerate(campaign.runs()) if _key(run) in keys}
            document = campaign.document
            recipe = Recipe(document.path.resolve(), document.text, folder.resolve(), checked.plugins)
            workers.prepare(RunTaker, recipe)
            try:
                _share_out(left, workers, report, stop)
            finally:
                for path in filter(is_running, run_folders(folder) if left else ()):  # perhaps elsewhere
                    ask_to_stop(path)


def _share_out(
    left: dict[int, PlannedRun],
    workers: Workers,
    report: Callable[[PlannedRun, Run], None],
    stop: StopFlag,
) -> None:
    """Give each worker a run at a time; runs that are complete are removed from those that are left."""
    waiting, n_out = iter([*left]), 0
    while left:
        while n_out < workers.n_workers and (number := next(waiting, None)) is not None:
            workers.submit(number, number)
            n_out += 1
        stop.check()
        for number, (run_dir, error) in workers.finished(POLL_S):
            if error is not None:
                stop.check()  # Ctrl-C reaches all processes
                raise error
            report(left.pop(number), open_run(run_dir))
            n_out -= 1
