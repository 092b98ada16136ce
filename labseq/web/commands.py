"""The command `labseq web`."""

from pathlib import Path
from typing import Annotated

import typer

WEB_EXAMPLES = """\b
Examples:
  labseq web
  labseq web /data/lab --host 0.0.0.0 --cert lab.pem --key lab.key
  labseq web --control
"""


def web(
    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="DATA", help="A data folder. Default: LABSEQ_DATA or ./data.", show_default=False
        ),
    ] = None,
    host: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS", help="Address to listen on. Any but this computer's own needs a token."
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(metavar="N", min=0, max=65535, help="Port. 0 for any free port.")
    ] = 8642,
    name: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A further name of the server, such as the name of a proxy in front of it. May be repeated.",
            show_default=False,
        ),
    ] = None,
    cert: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Certificate for TLS, PEM.", show_default=False)
    ] = None,
    key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Key of the certificate, PEM.", show_default=False)
    ] = None,
    control: Annotated[
        bool,
        typer.Option("--control", help="Let visitors stop runs, change the queue, and comment on runs."),
    ] = False,
    calibration_days: Annotated[
        float,
        typer.Option(metavar="DAYS", min=0, help="Age of a calibration in use at which an alarm is raised."),
    ] = 7.0,
    ends_with: Annotated[
        int | None, typer.Option(hidden=True, help="Process with which the server ends.")
    ] = None,
) -> None:
    """Show runs, scans, queue and calibrations in a browser.

    The server only reads the data folder, so runs do not depend on it. It prints the address to open,
    which contains a token if other computers can reach it or visitors may make changes.
    """
    from labseq.web.serve import Serving, serve

    serve(
        data,
        Serving(host, port, tuple(name or ()), cert, key, control, calibration_days * 86_400.0, ends_with),
    )
