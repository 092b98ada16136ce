"""What stands where in a shot's file: names, tables, units.

The tree, with n images, a grid of (row, col) sites and frames of (y, x) pixels::

    /entry                      what came of the shot, as attributes
      camera/<name>             images (n, y, x) and, per frame, t_s, exposure_s, number, step, cycle, ...
      images_view               NXdata: what viewers open by default
      detection                 occupancy (n, row, col), confidence, and the table of all images
      target                    fill, clear (row, col)
      rearrangement             tables moves, batches, cycles; predicted (cycle, row, col)
      timing                    table of the stages
      calibrations              id of each one in use, by kind, as attributes
      story                     tables of what a simulation did to the atoms, where it tells
      parameters, readings      JSON
      devices/<name>            JSON
      provenance                attributes, texts and JSON

Tables are compound datasets: one dataset costs 0.1 ms, whatever it holds.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

FORMAT: Final = "labseq-shot"
FORMAT_VERSION: Final = "1.4"
"""major.minor; a newer minor version only adds things, a newer major version cannot be read."""

RUN_FORMAT: Final = "labseq-run"
RUN_FORMAT_VERSION: Final = "1.3"

LIBRARY_VERSIONS: Final = ("earliest", "v110")
"""File features that HDF5 may use: the widest reader support."""

MOVE_SITES: Final = ("from_row", "from_col", "to_row", "to_col")
"""Columns of ``MOVES`` in the order of ``Plan.moves``."""

_PLACE: Final = [("step", "i4"), ("cycle", "i4")]

MOVES: Final = np.dtype(
    [
        *_PLACE,
        ("batch", "i4"),
        *((name, "i2") for name in MOVE_SITES),
        ("linked", "?"),
        ("played", "?"),
    ]
)
"""One row per atom move, over all cycles; ``batch`` counts from 0 in each cycle."""

BATCHES: Final = np.dtype(
    [
        *_PLACE,
        ("batch", "i4"),
        ("n_atom_moves", "i4"),
        ("n_tweezers", "i4"),
        ("end_s", "f8"),
        ("linked", "?"),
        ("played", "?"),
    ]
)
"""One row per batch, over all cycles; ``end_s`` counts from the start of the cycle."""

CYCLES: Final = np.dtype(
    [
        *_PLACE,
        ("n_batches", "i4"),
        ("n_batches_played", "i4"),
        ("n_atom_moves", "i4"),
        ("n_defects_predicted", "i4"),
        ("n_surplus_predicted", "i4"),
        ("t_start_s", "f8"),
        ("window_s", "f8"),
        ("planned_duration_s", "f8"),
        ("moves_s", "f8"),
    ]
)
"""One row per rearrangement cycle."""

EVENT: Final = "S16"
"""What an image is: "image", or "cycle_3" for the one that ended cycle 3."""

IMAGES: Final = np.dtype([*_PLACE, ("t_start_s", "f8"), ("exposure_s", "f8"), ("event", EVENT)])
"""One row per image, whether its frame was kept or not."""


def timing_dtype(stage: Any) -> np.dtype[Any]:
    """The table of stages; ``stage`` is the text dtype of its first column."""
    return np.dtype(
        [
            ("stage", stage),
            *_PLACE,
            ("t_start_s", "f8"),
            ("duration_s", "f8"),
            ("host_s", "f8"),
            ("budget_s", "f8"),
            ("over_budget", "?"),
        ]
    )


def units_of(table: np.dtype[Any]) -> list[str]:
    """Unit of each column of a table, as its name ends, "" where there is none.

    Example:
        >>> units_of(IMAGES)
        ['', '', 's', 's', '']
    """
    return [unit_of(name) for name in table.names or ()]


def unit_of(name: str) -> str:
    """Unit of a value, as its name ends, "" where that tells none.

    Example:
        >>> unit_of("laser.power_w"), unit_of("spacing_m"), unit_of("seen"), unit_of("beat_hz")
        ('W', 'm', '', 'Hz')
    """
    return _UNITS.get(name.rpartition("_")[2], "") if "_" in name else ""


_UNITS: Final = {
    **{unit: unit for unit in ("s", "m", "K", "Hz", "rad", "V", "W", "A", "px")},
    **{unit.lower(): unit for unit in ("K", "Hz", "V", "W", "A")},
}
"""What names end in -> unit."""
