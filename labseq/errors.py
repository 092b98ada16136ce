"""The error tree of labseq.

Every error that labseq raises on purpose is a :class:`LabseqError`. Its attributes hold the values. Its
message says what is wrong, what was expected and what to do. ``exit_code`` is the exit code of the command
line.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any, ClassVar, Literal, TypeAlias

Loc: TypeAlias = tuple[str | int, ...]
"""Location of a value in a document, as keys and list indices from the top, ("shot", 2, "rearrange")."""


class LabseqError(Exception):
    """Base of all errors that labseq raises on purpose. All of them can be pickled."""

    exit_code: ClassVar[int] = 1

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), self.args, vars(self))


def _restored(kind: type[LabseqError], args: tuple[Any, ...], values: dict[str, Any]) -> LabseqError:
    """Restore a pickled error without its constructor, which rarely takes the text as its argument."""
    error = kind.__new__(kind)
    error.args = args
    vars(error).update(values)
    return error


@dataclass(frozen=True, slots=True)
class Problem:
    """One problem in a configuration file.

    Attributes:
        what: Description of the problem, with the key or value that causes it.
        source: File name, or the option it came from (``--set a.b=c``).
        line: Line in ``source``, counted from 1, or 0 for an option.
        column: Column in the line or in the option, counted from 1. 0 if there is none.
        expected: The expected value, or "".
        hint: A remedy, for example "did you mean 'rows'?", or "".
        notes: Other places to look at, such as the value that this one conflicts with, or a default.
    """

    what: str
    source: str = ""
    line: int = 0
    column: int = 0
    expected: str = ""
    hint: str = ""
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        place = self.source
        if self.line:
            place += f":{self.line}:{self.column}"
        text = f"{place}: {self.what}" if place else self.what
        if self.expected:
            text += f"; expected {self.expected}"
        if self.hint:
            text += f"; {self.hint}"
        return text


class ConfigError(LabseqError, ValueError):
    """A sequence, a profile or an option has an error.

    Attributes:
        problems: All problems, each once, in file order.
    """

    exit_code: ClassVar[int] = 2

    def __init__(self, problems: Problem | str | Sequence[Problem]) -> None:
        if isinstance(problems, str):
            problems = Problem(problems)
        if isinstance(problems, Problem):
            problems = (problems,)
        self.problems: tuple[Problem, ...] = tuple(dict.fromkeys(problems))
        super().__init__("\n".join(str(problem) for problem in self.problems))


class ProblemCollector:
    """Collects the problems of several checks, so that the user sees them all at once.

    Example:
        >>> problems = ProblemCollector()
        >>> with problems:
        ...     raise ConfigError("shots is 0")
        >>> with problems:
        ...     raise ConfigError("name is missing")
        >>> problems.raise_any()
        Traceback (most recent call last):
        ...
        labseq.errors.ConfigError: shots is 0
        name is missing
    """

    def __init__(self) -> None:
        self.problems: list[Problem] = []

    def __enter__(self) -> ProblemCollector:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not isinstance(error, ConfigError):
            return False
        self.add(error)
        return True

    def add(self, error: ConfigError) -> None:
        """Collect the problems of an error."""
        self.problems += error.problems

    def stop(self, error: ConfigError) -> ConfigError:
        """Combine a final error, after which nothing else can be checked, with all collected problems."""
        self.add(error)
        return self._joined()

    def raise_any(self) -> None:
        """Raise the collected problems, sorted by their place in each file.

        Raises:
            ConfigError: There is at least one problem.
        """
        if self.problems:
            raise self._joined()

    def _joined(self) -> ConfigError:
        sources = list(dict.fromkeys(problem.source for problem in self.problems))
        different = dict.fromkeys(self.problems)  # points of a scan may share one
        return ConfigError(sorted(different, key=lambda p: (sources.index(p.source), p.line, p.column)))


@contextmanager
def collecting(problems: ProblemCollector | None = None) -> Generator[ProblemCollector]:
    """Collect a block's problems in the caller's collector, or raise them all at its end without one."""
    if problems is not None:
        yield problems
        return
    collector = ProblemCollector()
    try:
        yield collector
    except ConfigError as error:
        raise collector.stop(error) from error
    collector.raise_any()


class PluginLoadError(LabseqError):
    """A required plugin could not be loaded.

    Attributes:
        plugin: Name of the plugin.
        reason: Why it failed to load.
        source: Its file or its distribution. "" if the reason names it, or if it has none.
    """

    exit_code: ClassVar[int] = 2

    def __init__(self, plugin: str, reason: str, source: str = "") -> None:
        self.plugin = plugin
        self.reason = reason
        self.source = "" if source in reason else source
        text = f"plugin '{plugin}' failed to load: {reason}"
        super().__init__(f"{text}; it comes from {self.source}" if self.source else text)


class UnknownPluginError(LabseqError, LookupError):
    """No installed plugin offers the named planner, driver, step or other object.

    Attributes:
        kind: "planner", "camera", "pattern", ...
        name: The unknown name.
        known: The names that exist.
        hint: A remedy, or "".
    """

    exit_code: ClassVar[int] = 2

    def __init__(self, kind: str, name: str, known: Sequence[str] = (), hint: str = "") -> None:
        self.kind = kind
        self.name = name
        self.known = tuple(known)
        self.hint = hint
        text = f"unknown {kind} '{name}'; expected {one_of(self.known)}"
        super().__init__(f"{text}; {hint}" if hint else text)

    def __str__(self) -> str:  # LookupError would print the repr
        return str(self.args[0])


class DeviceError(LabseqError):
    """A device, its driver or a plugin in its role failed.

    Attributes:
        device: Role or device name in the profile, for example "camera".
        message: What failed, without the device.
    """

    exit_code: ClassVar[int] = 3

    def __init__(self, device: str, message: str) -> None:
        self.device = device
        self.message = message
        super().__init__(f"{device}: {message}")


class DeviceTimeoutError(DeviceError, TimeoutError):
    """A device did not answer in time.

    Attributes:
        device: Role or device name in the profile.
        timeout_s: Time that labseq waited, in seconds.
    """

    def __init__(self, device: str, message: str, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        super().__init__(device, message)


class DeviceHungError(DeviceTimeoutError):
    """A call into a device, its driver or a step did not return. Its thread may still run."""


class InterlockError(DeviceError):
    """A value that a device watches exceeds its limit or cannot be read. No policy lets the run continue."""


class LimitError(LabseqError, ValueError):
    """A value lies outside what a device or the profile allows.

    Attributes:
        what: The quantity, for example "row tones in batch 3".
        value: The value.
        limit: The limit that it exceeds.
        setting: Location of the profile's setting that sets the limit. () if unknown.
    """

    exit_code: ClassVar[int] = 2

    def __init__(self, what: str, value: object, limit: object, hint: str = "", *, setting: Loc = ()) -> None:
        self.what = what
        self.value = value
        self.limit = limit
        self.setting = setting
        text = f"{what} is {value}; the limit is {limit}"
        super().__init__(f"{text}; {hint}" if hint else text)


class PlanError(LabseqError):
    """A planner failed, or its result is not a plan.

    Attributes:
        planner: Name of the planner, or "".
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str, planner: str = "") -> None:
        self.planner = planner
        super().__init__(f"planner '{planner}': {message}" if planner else message)


class InvalidPlanError(PlanError):
    """A plan breaks a rule of :func:`labseq.check_plan`.

    Attributes:
        rule: The rule that was broken, one of :data:`labseq.motion.RULES`.
        batch: Index of the batch, from 0. -1 if the plan as a whole is wrong.
        move: Index of the atom move within the batch, from 0, or -1.
        detail: Description of the problem, with the sites.
        site: Row and column of the site where the rule is broken. None if it is no single site.
    """

    def __init__(
        self,
        rule: str,
        detail: str,
        *,
        batch: int = -1,
        move: int = -1,
        planner: str = "",
        site: tuple[int, int] | None = None,
    ) -> None:
        self.rule = rule
        self.batch = batch
        self.move = move
        self.detail = detail
        self.site = site
        place = f"batch {batch}" if batch >= 0 else "plan"
        if move >= 0:
            place += f", atom move {move}"
        super().__init__(f"{place} breaks the rule '{rule}': {detail}", planner)


class RecordingError(LabseqError):
    """Data could not be written or read back.

    Attributes:
        path: The file or folder.
        what: The problem.
        advice: What to do, or "".
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, path: object, what: str, advice: str = "") -> None:
        self.path = str(path)
        self.what = what
        self.advice = advice
        super().__init__(f"{path}: {self.text}")

    @property
    def text(self) -> str:
        """What is wrong and what to do, without the path."""
        return f"{self.what}; {self.advice}" if self.advice else self.what


class TransientError(LabseqError):
    """A rare failure. Repeating the shot may succeed.

    Attributes:
        device: Role or device name, or "".
        message: What failed, without the device.
    """

    exit_code: ClassVar[int] = 3

    def __init__(self, message: str, device: str = "") -> None:
        self.device = device
        self.message = message
        super().__init__(f"{device}: {message}" if device else message)


class ShotAbortedError(TransientError):
    """The external control system aborted the shot. It is repeated at the next `go`, without a limit."""


class StepTimeoutError(TransientError):
    """A step took longer than the ``timeout`` of its policy.

    Attributes:
        timeout_s: Its limit, in seconds.
    """

    def __init__(self, message: str, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        super().__init__(message)


class OverBudgetError(TransientError):
    """A stage took longer than its budget, and the policy of its step does not allow that.

    Attributes:
        then: The reaction set by the policy: "repeat_shot", "skip_point" or "stop".
    """

    def __init__(self, message: str, then: Literal["repeat_shot", "skip_point", "stop"]) -> None:
        self.then: Literal["repeat_shot", "skip_point", "stop"] = then
        super().__init__(message)


class CheckFailedError(LabseqError):
    """A value of the last shots is outside the limits of a check of the sequence.

    Attributes:
        value: Its name, for example "filling_fraction".
    """

    exit_code: ClassVar[int] = 3

    def __init__(self, message: str, value: str) -> None:
        self.value = value
        super().__init__(message)


class AlarmError(LabseqError):
    """An alarm has lasted for several shots in a row, and the run was ended.

    Attributes:
        alarm: Its name in the profile, for example "atoms".
        text: Its message.
        n_shots: Number of shots in a row.
    """

    exit_code: ClassVar[int] = 3

    def __init__(self, alarm: str, text: str, n_shots: int) -> None:
        self.alarm = alarm
        self.text = text
        self.n_shots = n_shots
        hint = "see 'alarms' in the profile for its limit"
        shots = "1 shot" if n_shots == 1 else f"{n_shots} shots in a row"
        super().__init__(f"alarm '{alarm}' in {shots} ({hint}): {text}")


class StopRequested(LabseqError):  # noqa: N818 - a request, not an error
    """The user asked the run to stop. Raised by every wait within 50 ms, or between shots.

    Attributes:
        signal_number: 1 for a terminal that was closed (SIGHUP), 2 for Ctrl-C (SIGINT), 15 for SIGTERM and
            for ``labseq stop``.
        after_shot: Whether ``labseq stop`` asked for it, and the current shot was completed.
    """

    def __init__(self, signal_number: int = 2, *, after_shot: bool = False) -> None:
        self.signal_number = signal_number
        self.after_shot = after_shot
        causes = {1: "because the terminal was closed (SIGHUP)", 2: "by Ctrl-C"}
        cause = "by 'labseq stop'" if after_shot else causes.get(signal_number, "by SIGTERM")
        super().__init__(f"stopped {cause}")


def one_of(names: Sequence[str]) -> str:
    """List the alternatives as text.

    Example:
        >>> one_of(["psca", "lsap"])
        "one of 'psca', 'lsap'"
        >>> one_of([])
        'nothing, because none is installed'
    """
    if not names:
        return "nothing, because none is installed"
    quoted = ", ".join(f"'{name}'" for name in names)
    return quoted if len(names) == 1 else f"one of {quoted}"
