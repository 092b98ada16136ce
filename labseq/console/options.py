"""Options that several commands share, and their completion.

A shell runs the completion whenever the tab key is pressed. So nothing heavy is imported here, no plugin is
loaded, and errors are ignored.
"""

from __future__ import annotations

import os
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import typer

from labseq.files import PLUGIN_PATH, PROFILES, data_root, packaged_profiles_dir, packaged_sequences_dir

_FILES: Final = ("sequence", "profile")
MAX_RUNS: Final = 20
"""Maximum number of runs that completion offers, the newest first."""


def new_kinds(incomplete: str) -> list[str]:
    """The kinds that ``labseq new`` can create.

    Example:
        >>> new_kinds("st")
        ['static_tweezers', 'step']
    """
    # the names of the templates, not the table of roles, which imports numpy
    templates = Path(__file__).parents[1] / "scaffold" / "templates"
    roles = sorted(path.stem for path in templates.glob("*.txt") if path.stem != "pyproject")
    return [kind for kind in (*_FILES, *roles) if kind.startswith(incomplete)]


def file_kinds(incomplete: str) -> list[str]:
    """Kinds of file."""
    return [kind for kind in _FILES if kind.startswith(incomplete)]


def profile_names(incomplete: str) -> list[str]:
    """Names of the profiles in ./hardware_profiles and of the profiles that come with labseq."""
    names: set[str] = set()
    for folder in (Path(PROFILES), packaged_profiles_dir()):
        with suppress(OSError):
            names |= {path.stem for path in folder.iterdir() if path.suffix.lower() in (".yaml", ".yml")}
    return sorted(name for name in names if name.startswith(incomplete))


def measurements(incomplete: str) -> list[str]:
    """Names of the sequences that come with labseq and fit their results."""
    names = {
        path.stem
        for path in packaged_sequences_dir().glob("*.yaml")
        if "    fit: " in path.read_text("utf-8")
    }
    return sorted(name for name in names if name.startswith(incomplete))


def run_folders(incomplete: str) -> list[str]:
    """Folders of runs, the newest first."""
    with suppress(OSError):
        runs = sorted(data_root().glob("????-??-??/[0-9]*/run.json"), reverse=True)
        folders = (str(path.parent) for path in runs)
        return [run for run in folders if run.startswith(incomplete)][:MAX_RUNS]
    return []


class DryRunKind(StrEnum):
    """The values of ``--dry-run``."""

    FULL = "full"
    FAST = "fast"


def whole_number(text: str) -> int:
    """The value of an option, read as in a file, where ``1e3`` is 1000.

    Raises:
        PydanticCustomError: It is not a whole number. typer reports this.
    """
    from pydantic_core import PydanticCustomError

    from labseq.config.yaml_nodes import resolve

    with suppress(ValueError):  # too many digits
        number = resolve(text)
        if type(number) is int:
            return number
    raise PydanticCustomError("int_parsing", "not a whole number")


def whole_number_option(text: str, **settings: Any) -> Any:
    """An option that takes a whole number, with its help text."""
    return typer.Option(metavar="N", parser=whole_number, help=text, **settings)


def profile_option(text: str) -> Any:
    """The option ``--profile`` with another help text."""
    return typer.Option("--profile", "-p", metavar="NAME|FILE", help=text, autocompletion=profile_names)


def run_argument(text: str) -> Any:
    """The argument ``RUN`` with another help text."""
    return typer.Argument(metavar="RUN", help=text, show_default=False, autocompletion=run_folders)


def dry_run_mode(kind: DryRunKind | None) -> Literal["off", "full", "fast"]:
    """The mode of a dry run. "off" without ``--dry-run``."""
    return "off" if kind is None else kind.value  # pyright: ignore[reportReturnType]


def _load_plugins_of(context: typer.Context, folders: list[Path]) -> None:
    """Add folders to LABSEQ_PLUGIN_PATH until the command ends. Its worker processes inherit them."""
    if not folders:
        return
    before = os.environ.get(PLUGIN_PATH)
    os.environ[PLUGIN_PATH] = os.pathsep.join([*map(str, folders), *([before] if before else [])])

    def restore() -> None:
        os.environ.pop(PLUGIN_PATH)
        if before is not None:
            os.environ[PLUGIN_PATH] = before

    context.call_on_close(restore)


Plugins = Annotated[
    list[Path] | None,
    typer.Option(
        "--plugins",
        metavar="DIR",
        exists=True,
        file_okay=False,
        help="Also load the plugins in this folder. May be given several times.",
        callback=_load_plugins_of,
        expose_value=False,
    ),
]
Profile = Annotated[str | None, profile_option("Hardware profile, instead of the sequence's own.")]
ProfileArgument = Annotated[
    str,
    typer.Argument(
        metavar="PROFILE",
        help="Name or file of the hardware profile.",
        show_default=False,
        autocompletion=profile_names,
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="ADDRESS=VALUE",
        help="Change one value, for example planner.degree_of_parallelism=2 or profile.mobile_tweezers.speed="
        '"100 um/ms". May be given several times. Steps count from 0, so shot.2.rearrange.window is the '
        "window of the third step.",
    ),
]
DryRun = Annotated[
    DryRunKind | None,
    typer.Option(
        "--dry-run",
        metavar="[=fast]",
        help="Use no hardware. Every device is replaced by its driver's own simulator if it has one, "
        "or else by its virtual twin. With =fast, the virtual twin is always used.",
        show_choices=False,
    ),
]
Json = Annotated[
    bool,
    typer.Option("--json", help="Print the result as one line of JSON on stdout, everything else on stderr."),
]
JsonFile = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|-",
        help="Write the result as JSON. With '-', to stdout, and everything else to stderr.",
    ),
]
SequenceFile = Annotated[
    Path,
    typer.Argument(
        metavar="SEQUENCE",
        help="The sequence file, or the name of a sequence in ./sequences or that comes with labseq.",
        show_default=False,
    ),
]
Shots = Annotated[int | None, whole_number_option("Number of shots, instead of the sequence's own.")]
Seed = Annotated[
    int | None, whole_number_option("Seed of all random numbers. The same seed gives the same run.")
]
Output = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder for the data, instead of LABSEQ_DATA or ./data.")
]
Note = Annotated[
    str, typer.Option(metavar="TEXT", help="A note about the run, which labseq runs and the web page show.")
]
Tags = Annotated[
    list[str] | None,
    typer.Option("--tag", metavar="TAG", help="A word by which to find the run. May be given several times."),
]
Realtime = Annotated[bool, typer.Option("--realtime", help="Let a simulated run take as long as a real one.")]
Workers = Annotated[
    int,
    typer.Option(
        metavar="N",
        min=1,
        help="Number of simultaneous simulated runs, each in its own process.",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Scheduler of a dask cluster that does the work instead, tls://HOST:PORT "
        "(extra labseq[campaign]).",
    ),
]
Keys = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        envvar="LABSEQ_CAMPAIGN_KEYS",
        help="Certificates of the cluster, as labseq campaign keys makes them.",
        show_default=False,
    ),
]
RunFolder = Annotated[
    Path | None,
    run_argument("The run's folder, or its name or number as in labseq runs. Default: the newest run."),
]
ScanQuantities = Annotated[
    list[str] | None,
    typer.Option(
        "--scan",
        metavar="[QUANTITY]",
        help="A quantity at each point of the scan: survival:before,after between two images, filling, "
        "defect_free or loading (also of one image: filling:before), any column of labseq export, or "
        "analysis.NAME.KEY. For some sites, add @target, @reservoir or @ROWS,COLUMNS. Default: what the run "
        "measures. May be given several times.",
    ),
]
Where = Annotated[
    list[str] | None,
    typer.Option(
        metavar="CONDITION",
        help="Only shots in which a quantity, a scanned value or any column of labseq export meets a "
        "condition: 'filling:before == 1', 'shot.hold.duration > 5 ms'. May be given several times.",
    ),
]
FitName = Annotated[
    str | None,
    typer.Option(
        "--fit",
        metavar="MODEL",
        help="Fit the quantity (default: the first that the run measures) against the scanned value: "
        "exponential, double_exponential, damped_cosine, gaussian, lorentzian, linear, polynomial, "
        "saturation, step, plateau, lowering, release_recapture or a plugin's model.",
    ),
]
Along = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="In a scan of several values, the one along which to fit, at each of the others. Default: "
        "the first.",
    ),
]
FitSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--fit-set",
        metavar="NAME=VALUE",
        help="Fix a parameter of the fit (waist='0.98 um'), or free one (offset=free). May be repeated.",
    ),
]
DataFolder = Annotated[
    Path | None,
    typer.Argument(metavar="DATA", help="A data folder. Default: LABSEQ_DATA or ./data.", show_default=False),
]
Search = Annotated[
    str,
    typer.Option(
        metavar="TEXT",
        help="Only runs whose name, date, note, tags, state, profile, scanned or changed settings or results "
        "contain all these words.",
    ),
]
Since = Annotated[str, typer.Option(metavar="DATE", help="Only runs of this day, 2026-11-20, or later.")]
Until = Annotated[str, typer.Option(metavar="DATE", help="Only runs of this day or earlier.")]
OfSequence = Annotated[str, typer.Option("--sequence", metavar="NAME", help="Only runs of this sequence.")]
WithTag = Annotated[str, typer.Option("--tag", metavar="TAG", help="Only runs with this tag.")]
WithStatus = Annotated[
    str,
    typer.Option(
        "--status",
        metavar="STATE",
        help="Only runs that are running, complete, stopped, failed or damaged.",
    ),
]
WhereRuns = Annotated[
    list[str] | None,
    typer.Option(
        "--where",
        metavar="CONDITION",
        help="Only runs with a result, a changed setting or a number of shots that meets a condition: "
        "'decay > 2 s', 'shots >= 100'. May be given several times.",
    ),
]
