"""`labseq campaign run`: the runs, and the table of their means."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from labseq.console.output import check_writable, say
from labseq.console.text import columns, plural
from labseq.recording.tables import check_installed
from labseq.session.campaign import Campaign, run_campaign
from labseq.session.options import Options


def run_file(
    run_session: Callable[..., None], file: Path, folder: Path, netcdf: Path | None, workers: Options
) -> None:
    """Run a campaign file; print a table; check first that the combined file can be written."""
    if netcdf is not None:
        check_installed("xarray", "h5netcdf")
        check_writable(netcdf)
    campaign = Campaign.read(file)
    runs = run_campaign(partial(run_session, as_json=False), campaign, folder.expanduser(), workers)
    rows: list[tuple[Any, ...]] = [(*campaign.axes, "shots", "filling", "run")]
    for point, run in zip(campaign.points(), runs, strict=True):
        values = [campaign.axes[address][i] for address, i in zip(campaign.axes, point, strict=True)]
        known = [one for shot in run.shots if not math.isnan(one := shot.filling_fraction)]
        filling = f"{100 * sum(known) / len(known):.2f} %" if known else "-"
        rows.append((*values, str(len(run.shots)), filling, f"{run.path.parent.name}/{run.path.name}"))
    say("", *columns(rows), f"{plural(len(runs), 'run')} in {folder}")
