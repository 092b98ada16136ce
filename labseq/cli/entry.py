"""The entry point of the command line, with arguments, usage errors and the exit code."""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NoReturn

from labseq.console.output import discard_unwritten, replace_unencodable, say
from labseq.errors import ConfigError, RecordingError


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line; the console entry point.

    Raises:
        SystemExit: Always, with the exit code.
    """
    # imports leave hardly any garbage, and looking for it every 700 objects would take 50 ms
    gc.set_threshold(20_000, *gc.get_threshold()[1:])
    import typer

    from labseq.cli.app import app
    from labseq.console.errors import EXIT_INTERRUPTED, report

    arranged = arrange(sys.argv[1:] if arguments is None else arguments)
    usage_error: type[Exception] = typer.BadParameter.__mro__[1]  # this class has no public name
    replace_unencodable()
    try:
        code = app(args=arranged, prog_name="labseq", standalone_mode=False) or 0
        if code == EXIT_INTERRUPTED:  # typer has caught the exception
            report(KeyboardInterrupt())
    except SystemExit as leaving:
        code = leaving.code
    except usage_error as error:
        code = _report_usage(error, arranged)
    except BaseException as error:  # noqa: BLE001 - the one place where an error becomes an exit code
        code = report(_of_current_folder(error), debug="--debug" in arranged[:1])
    discard_unwritten()
    if arguments is None:
        _end_process(code)
    sys.exit(code)


def _of_current_folder(error: BaseException) -> BaseException:
    """The error, or a clearer one if the current folder was deleted, because any relative path needs it."""
    if isinstance(error, FileNotFoundError):
        try:
            os.getcwd()  # noqa: PTH109 - nothing but whether it exists
        except FileNotFoundError:
            return ConfigError("the current folder no longer exists; change to another one with 'cd'")
    return error


def arrange(arguments: Sequence[str]) -> list[str]:
    """Give ``--dry-run``, ``--scan`` and ``--map`` their values and move ``--debug`` to the front.

    typer has no options with an optional value, and accepts global options only before
    the command. Arguments after ``--`` are unchanged.

    Example:
        >>> arrange(["run", "--dry-run", "a.yaml", "--debug"])
        ['--debug', 'run', '--dry-run=full', 'a.yaml']
        >>> arrange(["show", "--scan", "--json"]), arrange(["show", "--scan", "filling"])
        (['show', '--scan=', '--json'], ['show', '--scan', 'filling'])
    """
    end = arguments.index("--") if "--" in arguments else len(arguments)
    options, rest = arguments[:end], arguments[end:]
    debug = ["--debug"] if "--debug" in options else []
    command = next((option for option in options if not option.startswith("-")), "")
    # the --dry-run of doctor takes no value
    values = {} if command == "doctor" else {"--dry-run": "--dry-run=full"}
    follows = [*options[1:], "-"][: len(options)]
    values_of = (
        f"{option}="
        if option in ("--scan", "--map") and _is_no_quantity(following)
        else values.get(option, option)
        for option, following in zip(options, follows, strict=True)
        if option != "--debug"
    )
    return [*debug, *values_of, *rest]


def _is_no_quantity(argument: str) -> bool:
    """True if an argument after ``--scan`` or ``--map`` is another option, or a run's number or path."""
    if argument.startswith("-") or argument.isdecimal() or {"/", os.sep}.intersection(argument):
        return True
    from labseq.recording.folders import RUN_FILE  # takes 0.3 s with numpy, which the command needs anyway

    return argument == RUN_FILE or os.path.exists(os.path.join(argument, RUN_FILE))  # noqa: PTH110, PTH118 - of any text


def _report_usage(error: Any, arguments: Sequence[str]) -> int:
    """Print a usage error on stderr, and as the command's JSON if ``--json`` is among the arguments.

    Returns:
        The exit code.
    """
    error = _in_own_words(error)
    with suppress(OSError, RecordingError):  # the exit code reports it, too
        error.show()
        options = arguments[: arguments.index("--")] if "--" in arguments else arguments
        line = _usage_json(error) if "--json" in options else ""
        if line:
            say(line)
    return int(error.exit_code)


def _in_own_words(error: Any) -> Any:
    """The error of a value of the wrong type or beyond a limit, worded like errors of settings in files."""
    parameter, errors = getattr(error, "param", None), getattr(error.__cause__, "errors", None)
    if parameter is None or errors is None:
        return error
    from labseq.config.validation_errors import explain

    first = errors(include_url=False)[0]
    value = first["input"]
    is_whole = isinstance(value, str) and value.lstrip("+-").isdecimal()
    name = max(parameter.opts, key=len) if parameter.param_type_name == "option" else parameter.metavar
    problem = explain(first, name, int(value) if is_whole else value, "")
    return type(error).__mro__[1](str(problem), ctx=error.ctx)


def _usage_json(error: Any) -> str:
    """A usage error as the command's JSON, or "" for commands whose ``--json`` names a file."""
    problem = ConfigError(" ".join(str(error.format_message()).split()))
    command = error.ctx.info_name if error.ctx is not None else ""
    if command == "check":
        from labseq.console.errors import json_errors
        from labseq.console.output import as_line

        return as_line(json_errors(problem))
    if command in ("run", "show"):
        from labseq.cli.summary import Summary
        from labseq.console.output import as_line

        return as_line(Summary().ended_by(problem))
    return ""


def _end_process(code: Any) -> NoReturn:
    """End the process with an exit code, even if a plugin left a thread that Python would wait for.

    At this point all data are on disk and every device is safe, so such a thread can be ended.
    """
    deadline = time.monotonic() + 1.0  # seconds
    with suppress(KeyboardInterrupt):  # on Ctrl-C, stop waiting
        for thread in _plugin_threads():
            thread.join(max(0.0, deadline - time.monotonic()))
    names = sorted(thread.name for thread in _plugin_threads())
    if not names:
        sys.exit(code)
    with suppress(RecordingError):
        threads = "a thread" if len(names) == 1 else f"{len(names)} threads"
        text = f"warning: {threads} of a plugin did not end and stopped with the process: {', '.join(names)}"
        say(text, stream=sys.stderr)
    discard_unwritten()
    os._exit(code if isinstance(code, int) else int(code is not None))


def _plugin_threads() -> list[threading.Thread]:
    """The threads that keep the process from ending."""
    this = threading.current_thread()
    return [thread for thread in threading.enumerate() if thread is not this and not thread.daemon]
