"""Gathering the problems of several checks into one error."""

from __future__ import annotations

from types import TracebackType

from labseq.errors import ConfigError, Problem


class ProblemCollector:
    """Problems of several checks, so that the user sees them all at once.

    Example:
        >>> found = Collected()
        >>> with found:
        ...     raise ConfigError("shots is 0")
        >>> with found:
        ...     raise ConfigError("name is missing")
        >>> found.raise_any()
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
        """Gather what an error says."""
        self.problems += error.problems

    def stop(self, error: ConfigError) -> ConfigError:
        """An error after which nothing else can be checked, together with what was gathered."""
        self.add(error)
        return self._joined()

    def raise_any(self) -> None:
        """Raise what was gathered, each file's problems in its order.

        Raises:
            ConfigError: Anything was gathered.
        """
        if self.problems:
            raise self._joined()

    def _joined(self) -> ConfigError:
        sources = list(dict.fromkeys(problem.source for problem in self.problems))
        return ConfigError(sorted(self.problems, key=lambda p: (sources.index(p.source), p.line, p.column)))
