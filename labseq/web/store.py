"""The queue and the calibrations for the pages."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

from labseq.assembly.calibrations import DRY_RUN_FOLDER, FOLDER
from labseq.calibration.quality import DECIDING, figure_of
from labseq.calibration_store import Damaged, Store, Stored
from labseq.errors import ConfigError, LabseqError, RecordingError
from labseq.files import PROFILES, packaged_profiles_dir, profile_dir, read_file
from labseq.queue.listing import NIGHT, EntryRow, expected_ends, rule_texts
from labseq.queue.queue import Queue
from labseq.web.runs import Catalogue, run_id, text_of
from labseq.web.series import finite


def queue_values(root: Path) -> dict[str, Any]:
    """The queue of a data folder, JSON-ready. If an entry is damaged, "error" says so."""
    queue = Queue(root)
    holder = queue.lock().holder() if queue.folder.is_dir() else None
    is_run = holder is not None and holder.is_running
    values: dict[str, Any] = {
        "run_by": text_of(holder, 200) if is_run else None,
        "is_paused": queue.is_paused,
        "is_ending": is_run and queue.is_asked_to_stop,
        "error": "",
        "entries": [],
    }
    try:
        entries = queue.entries()[:500]
        expected = expected_ends(entries)
        values["entries"] = [_entry(EntryRow.of(entry, expected)) for entry in [*queue.done(NIGHT), *entries]]
    except RecordingError as error:
        values["error"] = text_of(error)
    return values


def _entry(row: EntryRow) -> dict[str, Any]:
    return {
        "id": row.id,
        "state": row.state,
        "sequence": text_of(row.sequence.stem, 200),
        "path": text_of(row.sequence, 400),
        "changed": row.changed,
        "added_utc": text_of(row.added_utc, 40),
        "begun_utc": row.begun_utc,
        "ends_utc": row.ends_utc,
        "options": {text_of(k, 200): text_of(v, 200) for k, v in row.changes.items()},
        "rules": [text_of(text, 200) for text in rule_texts(row.rules)],
        "run": None if row.run_dir is None else text_of(run_id(row.run_dir), 300),
        "error": text_of(row.error or ""),
    }


def calibrations(catalogue: Catalogue) -> dict[str, Any]:
    """The calibrations of the profiles in ./hardware_profiles and of the latest runs."""
    return {"stores": [_store_values(key, *store) for key, store in _stores(catalogue).items()]}


def calibration_picture(catalogue: Catalogue, store: str, file: str) -> bytes | None:
    """The PNG of a calibration. None if it does not exist.

    Raises:
        RecordingError: The file cannot be read.
    """
    entry = _stores(catalogue).get(store)
    if entry is None or Path(file).name != file:
        return None
    path = entry[1] / f"{file}.png"
    return read_file(path, 8 << 20) if path.is_file() else None


def _stores(catalogue: Catalogue) -> dict[str, tuple[str, Path]]:
    """The folders of calibrations that exist: key -> name of the profile, and folder."""
    folders: dict[Path, str] = {}
    for place in (Path(PROFILES).absolute() / FOLDER, packaged_profiles_dir() / FOLDER):
        with suppress(OSError):
            folders |= {folder: folder.name for folder in sorted(place.iterdir()) if folder.is_dir()}
    with suppress(RecordingError, OSError):
        for folder in catalogue.folders()[-30:]:
            with suppress(LabseqError, OSError, KeyError, TypeError, ValueError):
                store = _folder_of(catalogue.open(folder.parent.name, folder.name).record)
                folders.setdefault(store, store.name)
    with_dry_runs = {
        folder: name
        for store, profile in folders.items()
        for folder, name in ((store, profile), (store / DRY_RUN_FOLDER, f"{profile}, dry runs"))
    }
    return {_key(folder): (name, folder) for folder, name in with_dry_runs.items() if folder.is_dir()}


def _folder_of(record: Mapping[str, Any]) -> Path:
    """The folder of calibrations of a run's profile."""
    profile = Path(str(record["profile_path"]))
    folder: Any = record["resolved"]["profile"]["calibrations"]["folder"]
    return Path(folder) if isinstance(folder, str) else profile_dir(profile) / FOLDER / profile.stem


def _key(folder: Path) -> str:
    """A key that replaces a folder in an address, which should not contain a path."""
    return hashlib.sha256(str(folder).encode("utf-8", "replace")).hexdigest()[:12]


def _store_values(key: str, profile: str, folder: Path) -> dict[str, Any]:
    store, error = Store(folder), ""
    used: dict[str, str] = {}
    entries: list[Stored | Damaged] = []
    try:
        entries = store.entries()[-1000:]
        used = {kind: active.file for kind, active in store.active().items()}
    except (ConfigError, OSError) as failure:
        error = text_of(failure)
    kinds: dict[str, list[dict[str, Any]]] = {}
    for stored in entries:
        kind = stored.kind if isinstance(stored, Damaged) else stored.entry.kind
        kinds.setdefault(kind, []).append(_calibration(stored, used.get(kind) == stored.path.name))
    return {
        "key": key,
        "profile": text_of(profile, 200),
        "folder": text_of(folder, 400),
        "error": error,
        "kinds": [
            {
                "kind": kind,
                "figure": DECIDING[cast("Any", kind)].label if kind in DECIDING else "",
                "entries": rows,
            }
            for kind, rows in kinds.items()
        ],
    }


def _calibration(stored: Stored | Damaged, in_use: bool) -> dict[str, Any]:
    head = {"file": stored.path.stem, "in_use": in_use}
    if isinstance(stored, Damaged):
        return {"id": text_of(stored.id, 40), **head, "error": text_of(stored.error), "taken_utc": None}
    entry = stored.entry
    figure = figure_of(entry) if entry.kind in DECIDING else math.nan
    return {
        "id": entry.id,
        **head,
        "error": "",
        "taken_utc": text_of(entry.taken_utc, 40),
        "figure": finite(figure),
        "quality": {text_of(name, 60): finite(value) for name, value in entry.quality.items()},
        "run": text_of(entry.origin.get("run") or entry.origin.get("command") or "", 200),
        "has_picture": stored.picture is not None,
    }
