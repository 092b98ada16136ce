"""The commands `labseq calibrate` and `labseq calibration`."""

from pathlib import Path
from typing import Annotated

import typer

from labseq.console.options import (
    DryRun as RunDry,
    DryRunKind,
    Json,
    Output,
    Overrides,
    Plugins,
    Seed,
    Shots,
    dry_run_mode,
    profile_option,
)

calibration = typer.Typer(
    name="calibration",
    help="List, compare and choose the calibrations of a profile.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

ID_HELP = "Id of a calibration, or an unambiguous beginning of it."

USE_EXAMPLES = """\b
Examples:
  labseq calibration use f102b3 --profile lab
  labseq calibration use overlay=off --profile lab
"""

CALIBRATE_EXAMPLES = """\b
Examples:
  labseq calibrate sites --profile lab
  labseq calibrate thresholds --profile lab --shots 400 --set shot.1.image.exposure="30 ms"
  labseq calibrate thresholds --profile lab --from data/2026-11-20/0012_calibrate-thresholds
  labseq calibrate sites --profile lab --from sites.csv
  labseq calibrate sites --profile lab --centre 250,261
"""

Profile = Annotated[str, profile_option("Hardware profile.")]
DryRun = Annotated[
    DryRunKind | None,
    typer.Option(
        "--dry-run",
        help="Use the calibrations of dry runs, which are separate from calibrations of real devices.",
        metavar="[=fast]",
        show_choices=False,
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Use it even if it is worse than the one in use.")]
Id = Annotated[str, typer.Argument(metavar="ID", help=ID_HELP, show_default=False)]


@calibration.command("list", short_help="List the calibrations of a profile.")
def list_all(profile: Profile = "virtual", dry_run: DryRun = None, as_json: Json = False) -> None:
    """List the calibrations of a profile, including damaged ones, and mark the ones in use."""
    from labseq.calibration.terminal import list_calibrations

    list_calibrations(profile, dry_run_mode(dry_run), as_json=as_json)


@calibration.command(short_help="Show one calibration.")
def show(
    calibration_id: Id, profile: Profile = "virtual", dry_run: DryRun = None, as_json: Json = False
) -> None:
    """Show the values of a calibration, its quality, and its origin."""
    from labseq.calibration.terminal import show_calibration

    show_calibration(calibration_id, profile, dry_run_mode(dry_run), as_json=as_json)


@calibration.command(epilog=USE_EXAMPLES, short_help="Use a calibration, or none of its kind.")
def use(
    choice: Annotated[
        str,
        typer.Argument(
            metavar="ID",
            help=f"{ID_HELP} With overlay=off no calibration of that kind is used.",
            show_default=False,
        ),
    ],
    profile: Profile = "virtual",
    dry_run: DryRun = None,
    force: Force = False,
) -> None:
    """Use a calibration from the next run on. Runs in progress keep theirs."""
    from labseq.calibration.terminal import use_calibration

    use_calibration(choice, profile, dry_run_mode(dry_run), force=force)


@calibration.command(short_help="Compare two calibrations of one kind.")
def diff(
    before: Annotated[str, typer.Argument(metavar="ID", help=ID_HELP, show_default=False)],
    after: Annotated[str, typer.Argument(metavar="ID", help=ID_HELP, show_default=False)],
    profile: Profile = "virtual",
    dry_run: DryRun = None,
    as_json: Json = False,
) -> None:
    """Compare values and quality of two calibrations of one kind."""
    from labseq.calibration.terminal import compare_calibrations

    compare_calibrations(before, after, profile, dry_run_mode(dry_run), as_json=as_json)


def calibrate(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="KIND",
            help="What to calibrate: sites, thresholds, tweezers, amplitudes, frequencies, overlay or "
            "timing.",
            show_default=False,
        ),
    ],
    profile: Profile = "virtual",
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="RUN|FILE",
            help="Analyse an earlier run instead of a new one, or read the sites of an irregular array from "
            "a .npy or .csv file.",
        ),
    ] = None,
    centre: Annotated[
        str | None,
        typer.Option(
            "--centre",
            metavar="Y,X",
            help="For sites: the middle of the grid on the frames, in pixels, within half a spacing. "
            "Needed if the frames show more traps than the grid has.",
        ),
    ] = None,
    shots: Shots = None,
    seed: Seed = None,
    overrides: Overrides = None,
    output: Output = None,
    dry_run: RunDry = None,
    force: Force = False,
    as_json: Json = False,
    _plugins: Plugins = None,
) -> None:
    """Calibrate a profile: take a run, analyse it, store the result, and use it unless it is worse."""
    from labseq.calibration.measure import CalibrationRequest
    from labseq.calibration.terminal import calibrate_kind

    changes = tuple(overrides or ())
    request = CalibrationRequest(
        profile, source, shots, seed, changes, output, dry_run_mode(dry_run), force=force, centre=centre
    )
    calibrate_kind(kind, request, as_json=as_json)
