"""How a contract says which promise was broken."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import wraps
from typing import Any, Final, NoReturn, ParamSpec, TypeVar

import pytest

P = ParamSpec("P")
T = TypeVar("T")
E = TypeVar("E", bound=Exception)

_FAILURES: Final = (Exception, pytest.fail.Exception)


class ContractViolation(AssertionError):  # noqa: N818 - reads as what it is in pytest's summary
    """A plugin does not do what its role promises.

    Attributes:
        promise: The promise, as a sentence.
        detail: What happened instead.
    """

    def __init__(self, promise: str, detail: str) -> None:
        self.promise = promise
        self.detail = detail
        super().__init__(f"promise: {promise}; but {detail}")


class CallHungError(AssertionError):
    """A call has not come back; the thread that made it is left to itself."""


@contextmanager
def promised(promise: str) -> Generator[None]:
    """Whatever fails inside breaks this promise, unless it broke one of its own."""
    __tracebackhide__ = True
    try:
        yield
    except ContractViolation:
        raise
    except _FAILURES as error:
        raise ContractViolation(promise, format_error(error)) from error


def promise(text: str) -> Callable[[Callable[P, None]], Callable[P, None]]:
    """Make a test of a contract say which promise it holds a plugin to.

    The sentence is kept as the test's attribute ``promise``. A test that cannot go on because
    another promise is broken is skipped, if a test of that promise fails: so a fault is told once.
    """

    def decorate(test: Callable[P, None]) -> Callable[P, None]:
        @wraps(test)
        def run(*args: P.args, **kwargs: P.kwargs) -> None:
            __tracebackhide__ = True
            try:
                test(*args, **kwargs)
            except ContractViolation as error:
                if error.promise != text and _is_told_elsewhere(error.promise, *args, *kwargs.values()):
                    pytest.skip(f"cannot go on: {error}")
                raise
            except _FAILURES as error:
                raise ContractViolation(text, format_error(error)) from error

        run.__dict__["promise"] = text
        return run

    return decorate


def _is_told_elsewhere(promise: str, *args: Any) -> bool:
    """Whether a test of that promise fails too; the suite comes first, and then what its tests are given."""
    suite = args[0]
    tests = (getattr(type(suite), name) for name in dir(suite) if name.startswith("test_"))
    for test in tests:
        if getattr(test, "promise", None) == promise:
            try:
                test.__wrapped__(*args)
            except _FAILURES:
                return True
    return False


@contextmanager
def doing(what: str) -> Generator[None]:
    """Say what was being done when something inside fails."""
    __tracebackhide__ = True
    try:
        yield
    except ContractViolation:
        raise
    except _FAILURES as error:
        raise AssertionError(f"{what}: {format_error(error)}") from error


@contextmanager
def as_this_promise() -> Generator[None]:
    """Count a broken promise as one of the promise that is being tested."""
    __tracebackhide__ = True
    try:
        yield
    except ContractViolation as error:
        raise AssertionError(error.detail) from error


def refusal(
    kind: type[E] | tuple[type[E], ...],
    what: str,
    call: Callable[P, object],
    *args: P.args,
    **kwargs: P.kwargs,
) -> E:
    """Make a call that must be refused.

    Returns:
        The error that it was refused with.
    """
    __tracebackhide__ = True
    wanted = " or ".join(k.__name__ for k in (kind if isinstance(kind, tuple) else (kind,)))
    try:
        call(*args, **kwargs)
    except kind as error:
        return error
    except Exception as error:
        raise AssertionError(f"{what} {format_error(error)}; expected {wanted}") from error
    raise AssertionError(f"{what} was accepted; expected {wanted}")


def in_time(limit_s: float, what: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Make a call that must come back.

    Raises:
        CallHungError: It has not come back after ``limit_s`` of real time.
    """
    __tracebackhide__ = True
    results: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(call(*args, **kwargs))
        except BaseException as error:  # noqa: BLE001 - raised again in the test's own thread
            errors.append(error)

    thread = threading.Thread(target=run, name=f"labseq test: {what}", daemon=True)
    thread.start()
    thread.join(limit_s)
    if errors:
        raise errors[0]
    if not results:
        raise CallHungError(f"{what} has not returned after {limit_s:g} s")
    return results[0]


def no_factory(suite: object, signature: str) -> NoReturn:
    """Say what a test class that inherits a contract must provide."""
    name = type(suite).__name__
    pytest.fail(f"{name} needs a fixture 'factory' that returns a callable: {signature}", pytrace=False)


def format_error(error: BaseException) -> str:
    """An error in words, as the end of a sentence."""
    if isinstance(error, AssertionError | pytest.fail.Exception) and str(error):
        return str(error).split("\nassert ")[0]  # without what pytest says of the values
    return f"raised {type(error).__name__}: {error}" if str(error) else f"raised {type(error).__name__}"
