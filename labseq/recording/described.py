"""What every dataset, column and attribute of a shot's file is: for the file, and for the reference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from labseq.recording import layout

_JSON: Final = "JSON text"
_GRID: Final = "row, col"


@dataclass(frozen=True, slots=True)
class DatasetDescription:
    """A dataset of a shot's file.

    Attributes:
        dtype: As h5py names it; "table" for one of :data:`COLUMNS`.
        shape: Its axes; "" for a single value.
        meaning: What it is, one sentence without a full stop.
        units: SI unit of its numbers; "" where there is none.
        since: Format version that first had it.
    """

    dtype: str
    shape: str
    meaning: str
    units: str = ""
    since_version: str = "1.0"


DATASETS: Final[Mapping[str, DatasetDescription]] = {
    "target/fill": DatasetDescription("uint8", _GRID, "1 where the target must hold an atom"),
    "target/clear": DatasetDescription("uint8", _GRID, "1 where the target must be empty"),
    "camera/<name>/images": DatasetDescription("uint16", "frame, y, x", "frames as the camera delivered them", "adu"),
    "camera/<name>/t_s": DatasetDescription(
        "float64", "frame", "start of the exposure, from the start of the shot", "s"
    ),
    "camera/<name>/t_clock_s": DatasetDescription(
        "float64", "frame", "start of the exposure on the session's clock", "s"
    ),
    "camera/<name>/t_device_s": DatasetDescription(
        "float64",
        "frame",
        "the camera's own time stamp, from a zero of its own; nan if it gives none",
        "s",
        "1.3",
    ),
    "camera/<name>/number": DatasetDescription(
        "int32", "frame", "place in the camera's series as the camera counted it, from 0", "", "1.3"
    ),
    "camera/<name>/exposure_s": DatasetDescription("float64", "frame", "exposure time that the camera reports", "s"),
    "camera/<name>/image": DatasetDescription(
        "int32", "frame", "index of the image in detection that the frame belongs to"
    ),
    "camera/<name>/step": DatasetDescription("int32", "frame", "index of the step that took it, from 0"),
    "camera/<name>/cycle": DatasetDescription(
        "int32", "frame", "rearrangement cycle that it ended, from 1; 0 for that of an image step"
    ),
    "camera/<name>/event": DatasetDescription(
        "ascii, 16 bytes", "frame", "what it is: image, or cycle_3 for the one that ended cycle 3"
    ),
    "detection/occupancy": DatasetDescription("uint8", "image, row, col", "1 where the detector saw an atom"),
    "detection/confidence": DatasetDescription("float32", "image, row, col", "the detector's confidence in each site"),
    "detection/t_s": DatasetDescription("float64", "image", "start of the exposure, from the start of the shot", "s"),
    "detection/images": DatasetDescription("table", "image", "all images, whether their frames were kept or not"),
    "rearrangement/moves": DatasetDescription("table", "atom move", "the atom moves of all plans"),
    "rearrangement/batches": DatasetDescription(
        "table", "batch", "the batches of all plans: moves made at the same time"
    ),
    "rearrangement/cycles": DatasetDescription("table", "cycle", "the rearrangement cycles: plan, check, move, image"),
    "rearrangement/predicted": DatasetDescription(
        "uint8", "cycle, row, col", "1 where the whole plan leaves an atom if none is lost"
    ),
    "timing": DatasetDescription("table", "stage", "how long each stage took, against its budget"),
    "story/<name>": DatasetDescription(
        "table", "row", "what a simulation tells of the atoms; see its plugin", "", "1.1"
    ),
    "parameters": DatasetDescription(_JSON, "", "what differs from the files in this shot: address -> value, SI"),
    "readings": DatasetDescription(_JSON, "", "values read from devices during the shot, SI: name -> value"),
    "devices/<name>": DatasetDescription(_JSON, "", "what the device says of itself, SI"),
    "provenance/sequence": DatasetDescription("text", "", "the sequence file"),
    "provenance/profile": DatasetDescription("text", "", "the hardware profile"),
    "provenance/resolved": DatasetDescription(_JSON, "", "every setting after defaults and overrides, SI"),
    "provenance/overrides": DatasetDescription(_JSON, "", "what --set and other options changed: address -> value"),
    "provenance/plugins": DatasetDescription(_JSON, "", "name, version and origin of each plugin that was used"),
    "provenance/<name>": DatasetDescription(
        "JSON or plain text", "", "where the run comes from: versions, host, user"
    ),
}
"""Path below ``/entry`` -> the dataset. Short values of devices and provenance are attributes instead."""

_STEP: Final = "index of the step in the shot, from 0"
_CYCLE: Final = "rearrangement cycle, from 1"
_BATCH: Final = "index of the batch in its cycle, from 0"
_LINKED: Final = "whether the batch goes on with the tweezers of the one before still on"
_PLAYED: Final = "whether it fitted into the window and was played"

COLUMNS: Final[Mapping[str, Mapping[str, str]]] = {
    "detection/images": {
        "step": _STEP,
        "cycle": "rearrangement cycle that it ended, from 1; 0 for that of an image step",
        "t_start_s": "start of the exposure, from the start of the shot",
        "exposure_s": "exposure time",
        "event": "what it is: image, or cycle_3 for the one that ended cycle 3",
    },
    "rearrangement/moves": {
        "step": _STEP,
        "cycle": _CYCLE,
        "batch": _BATCH,
        "from_row": "row that the atom is taken from",
        "from_col": "column that the atom is taken from",
        "to_row": "row that it is brought to; beyond the grid where it is ejected",
        "to_col": "column that it is brought to; beyond the grid where it is ejected",
        "linked": _LINKED,
        "played": _PLAYED,
    },
    "rearrangement/batches": {
        "step": _STEP,
        "cycle": _CYCLE,
        "batch": _BATCH,
        "n_atom_moves": "atom moves in it",
        "n_tweezers": "mobile tweezers on in it, crossings without an atom included",
        "end_s": "when it ends, from the start of the cycle, overheads included",
        "linked": _LINKED,
        "played": _PLAYED,
    },
    "rearrangement/cycles": {
        "step": _STEP,
        "cycle": _CYCLE,
        "n_batches": "batches of the plan",
        "n_batches_played": "batches that fitted into the window and were played",
        "n_atom_moves": "atom moves of the plan",
        "n_defects_predicted": "empty target sites after the whole plan if no atom is lost",
        "n_surplus_predicted": "atoms after the whole plan on sites that must be empty",
        "t_start_s": "start of the cycle, from the start of the shot",
        "window_s": "time that the cycle had for its moves",
        "planned_duration_s": "from the start of the cycle to the end of the plan's last batch",
        "moves_s": "modelled duration of what was played, overheads included",
    },
    "timing": {
        "stage": "name of the stage: load, expose, detect, plan, check, prepare, play, ...",
        "step": _STEP,
        "cycle": "rearrangement cycle, from 1; 0 outside of one",
        "t_start_s": "start on the session's clock, from the start of the shot",
        "duration_s": "duration on the session's clock; in a dry run the modelled time",
        "host_s": "duration on the computer's clock",
        "budget_s": "what it may take; nan without a budget",
        "over_budget": "whether it took longer than its budget",
    },
}
"""Path of a table below ``/entry`` -> its columns."""

TABLES: Final[Mapping[str, np.dtype[Any]]] = {
    "detection/images": layout.IMAGES,
    "rearrangement/moves": layout.MOVES,
    "rearrangement/batches": layout.BATCHES,
    "rearrangement/cycles": layout.CYCLES,
    "timing": layout.timing_dtype("O"),
}
"""Path of a table below ``/entry`` -> its dtype; the stage of ``timing`` is UTF-8 text as long as needed."""

_NEXUS: Final = "for viewers: class, signal, axes or default plot after NeXus"

ATTRIBUTES: Final[Mapping[str, Mapping[str, tuple[str, str]]]] = {
    "/": {
        "format": ("text", layout.FORMAT),
        "format_version": ("text", "major.minor; a newer minor version only adds things"),
        "creator": ("text", "labseq and its version"),
        "NX_class": ("text", _NEXUS),
        "default": ("text", _NEXUS),
    },
    "/entry": {
        "NX_class": ("text", _NEXUS),
        "default": ("text", _NEXUS),
        "run_id": ("text", "the run's folder below the data root: date/counter_name"),
        "simulated": ("bool", "whether all hardware was simulated"),
        "record_frames": ("text", "which frames are kept: all, last or none"),
        "shot_index": ("int64", "index of the shot in the run, from 0"),
        "attempt": ("int64", "0 for the first try"),
        "status": ("text", "complete, interrupted or failed"),
        "error": ("text", "why it did not complete, or empty"),
        "t_start_utc": ("text", "wall time of its start, ISO 8601, UTC"),
        "t_end_utc": ("text", "wall time of its end"),
        "success": ("bool", "whether the last image step met the target"),
        "filling_fraction": ("float64", "filling of the target on the last image step; nan without one"),
        "seen_defect_free_cycle": ("int64", "first cycle whose image met the target; 0 if none"),
        "n_missing_atoms": ("int64", "atoms that the loading fell short of the target"),
        "n_images": ("int64", "number of images"),
        "n_cycles": ("int64", "number of rearrangement cycles"),
        "seed": ("int64 or text", "seed of the run; text where it does not fit into 64 bits"),
    },
    "/entry/target": {
        "name": ("text", "name of the target pattern"),
        "lattice": ("text", "lattice of the grid"),
        "grid_spacing_m": ("float64", "spacing of the sites, in m"),
    },
    "/entry/camera/<name>": {
        "NX_class": ("text", _NEXUS),
        "name": ("text", "name of the camera"),
    },
    "/entry/camera/<name>/images": {
        "interpretation": ("text", _NEXUS),
        "long_name": ("text", "title for viewers"),
    },
    "/entry/images_view": {
        "NX_class": ("text", _NEXUS),
        "signal": ("text", _NEXUS),
        "axes": ("text list", _NEXUS),
    },
    "/entry/detection": {
        "NX_class": ("text", _NEXUS),
        "signal": ("text", _NEXUS),
        "auxiliary_signals": ("text list", _NEXUS),
        "axes": ("text list", _NEXUS),
    },
    "/entry/detection/occupancy": {"interpretation": ("text", _NEXUS)},
    "/entry/detection/confidence": {"interpretation": ("text", _NEXUS)},
    "/entry/calibrations": {"<kind>": ("text", "id of the calibration of this kind in use, since 1.2")},
    "/entry/provenance": {
        "seed": ("int64", "seed of the run"),
        "sequence_sha256": ("text", "SHA-256 of the sequence file"),
        "profile_sha256": ("text", "SHA-256 of the profile"),
        "<name>": ("any", "short values: versions, host, user"),
    },
    "/entry/devices": {"<name>": ("any", "short values that a device says of itself")},
}
"""Path -> its attributes: type and meaning. Those that every dataset has are left out."""

EVERYWHERE: Final[Mapping[str, str]] = {
    "units": "unit of the numbers, SI or adu, empty where there is none; of a table that of each column",
    "description": "what the dataset is, since 1.4",
    "descriptions": "tables only: what each column is, since 1.4",
    "content_type": "texts only: application/json or text/plain",
}
"""Attributes of every dataset."""

UNDOCUMENTED: Final = "as the simulation that told it means it"
"""What a column of a story is whose simulation does not describe it."""


def column_meanings(path: str, table: np.dtype[Any]) -> list[str]:
    """What each column of a table is.

    Args:
        path: A key of :data:`COLUMNS`, or "story/<name>".
        table: Its dtype. That of a story may carry ``metadata={"descriptions": {column: text}}``.

    Example:
        >>> described = np.dtype([("t_s", "f8")], metadata={"descriptions": {"t_s": "when"}})
        >>> column_meanings("story/<name>", described)
        ['when']
    """
    known = COLUMNS.get(path)
    if known is None:
        known = (table.metadata or {}).get("descriptions") or {}
    return [str(known.get(name, UNDOCUMENTED)) for name in table.names or ()]
