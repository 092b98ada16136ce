"""A whole run in one HDF5 file that plain HDF5 reads: no links to other files, no filters but gzip.

The tree::

    /                        what is true of the whole run, as attributes
      table                  NXdata: a column for each value of the shots, as in ``Run.to_dataframe``
      run/<file>             the files of the run's folder: run.json, sequence.yaml, calibrations, ...
      shots/shot_000000      what the shot's file has under /entry; attempts that failed, likewise

Settings, devices and target are the same in all shots and stand in the file once: the shots have hard
links to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

import labseq
from labseq.errors import RecordingError
from labseq.files import whole_file
from labseq.recording import folders, layout
from labseq.recording.columns import columns_of
from labseq.recording.nodes import link_name, set_attributes
from labseq.recording.plain import plain_text
from labseq.recording.reader import Run
from labseq.recording.shot import Shot
from labseq.recording.shot_reader import allow_filter
from labseq.recording.tabular import facts_of

FORMAT: Final = "labseq-archive"
FORMAT_VERSION: Final = "1.0"

_COMMON: Final = ("target", "devices", "provenance")
_WORTH_PACKING: Final = 1024
"""Bytes from which compressing an array makes it smaller."""
_PACKED: Final = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


def write_archive(run: Run, path: Path, *, frames: bool) -> list[str]:
    """Write the archive of a run, whole or not at all.

    Args:
        run: The run.
        path: The file; an older one is replaced.
        frames: Whether it holds the frames.

    Returns:
        Why shots were left out: files that are missing or damaged. Empty if all are in it.

    Raises:
        OSError: It cannot be written.
        RuntimeError: Likewise, as HDF5 tells it.
    """
    left_out: list[str] = []
    with whole_file(path) as part, h5py.File(Path(part.name), "w", libver=layout.LIBRARY_VERSIONS) as file:
        set_attributes(
            file,
            **facts_of(run),
            format=FORMAT,
            format_version=FORMAT_VERSION,
            NX_class="NXroot",
            default="table",
        )
        file.attrs["archived_by"] = f"labseq {labseq.__version__}"
        _write_table(file.create_group("table"), run)
        _write_files(file.create_group("run"), run.path)
        shots = _Shots(file.create_group("shots"), frames=frames)
        for shot in (*run.shots, *run.attempts):
            try:
                shot.verify()
                shots.add(shot)
            except RecordingError as error:
                left_out.append(str(error))
    return left_out


def _write_table(group: h5py.Group, run: Run) -> None:
    set_attributes(group, NX_class="NXdata", signal="filling_fraction")
    group.attrs["axes"] = ["shot"]
    names: list[str] = []
    for column in columns_of(run):
        names.append(link_name(column.name, names))
        values, dtype = column.values, column.values.dtype
        if dtype.kind == "O":
            values, dtype = list(map(plain_text, values)), h5py.string_dtype()
        dataset = group.create_dataset(names[-1], data=values, dtype=dtype)
        set_attributes(dataset, units=column.units, description=column.description)


def _write_files(group: h5py.Group, run_dir: Path) -> None:
    """The files of the run's folder as they are: texts as text, others as bytes."""
    results = group.create_group(folders.RESULTS_FOLDER)
    for goal, folder in ((group, run_dir), (results, run_dir / folders.RESULTS_FOLDER)):
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if path.is_file() and path.suffix != ".part" and not path.name.startswith("."):
                _write_file(goal, plain_text(path.name), path.read_bytes())


def _write_file(group: h5py.Group, name: str, data: bytes) -> None:
    if _is_text(data):
        dataset = group.create_dataset(name, data=data.decode(), dtype=h5py.string_dtype())
    else:
        dataset = group.create_dataset(name, data=np.frombuffer(data, np.uint8))
    set_attributes(dataset, units="", description="this file of the run's folder")


def _is_text(data: bytes) -> bool:
    try:
        return "\0" not in data.decode()
    except ValueError:
        return False


class _Shots:
    """Copies shots into a group."""

    def __init__(self, group: h5py.Group, *, frames: bool) -> None:
        self._group = group
        self._frames = frames
        self._common: dict[str, tuple[Any, Any]] = {}  # name -> content, group

    def add(self, shot: Shot) -> None:
        """Copy a shot whose file is whole.

        Raises:
            RecordingError: Its frames are compressed and the package for it is missing.
        """
        with h5py.File(shot.file, "r", locking=False) as source:
            entry: Any = source["entry"]
            if self._frames:
                for camera in entry["camera"].values() if "camera" in entry else ():
                    allow_filter(shot.file, camera["images"])
            made = self._group.create_group(shot.file.stem)
            _copy_attributes(entry, made)
            for name in entry:
                if name in _COMMON:
                    self._link(entry[name], made, name)
                elif self._frames or name != "images_view":
                    _copy(entry, made, name, () if self._frames else ("images",) if name == "camera" else ())
            if "images_view" not in made:
                made.attrs["default"] = "detection"

    def _link(self, source: Any, made: Any, name: str) -> None:
        """What a shot before had, too, is linked to."""
        content = _content(source)
        if self._common.get(name, (None,))[0] != content:
            source.file.copy(source, made, name)
            self._common[name] = content, made[name]
        else:
            made[name] = self._common[name][1]


def _copy(source: Any, made: Any, name: str, left_out: Sequence[str]) -> None:
    """Copy what a group has under a name, without the datasets that are left out."""
    link = source.get(name, getlink=True)
    if isinstance(link, h5py.SoftLink):
        made[name] = h5py.SoftLink(link.path.replace("/entry", _shot_of(made), 1))
        return
    node = source[name]
    if isinstance(node, h5py.Group):
        group = made.create_group(name)
        _copy_attributes(node, group)
        for inner in node.keys():  # noqa: SIM118 - names of the group's own, all text
            _copy(node, group, inner, left_out)
    elif name in left_out:
        return
    elif node.dtype.kind != "O" and (node.nbytes >= _WORTH_PACKING or _is_packed(node)):
        chunks = (1, *node.shape[1:]) if name == "images" and node.ndim == 3 else True
        _copy_attributes(node, made.create_dataset(name, data=node[()], chunks=chunks, **_PACKED))
    else:
        source.file.copy(node, made, name)


def _is_packed(dataset: Any) -> bool:
    return dataset.id.get_create_plist().get_nfilters() > 0


def _shot_of(node: Any) -> str:
    """Path of the group of the shot that a node belongs to."""
    return "/".join(node.name.split("/")[:3])


def _copy_attributes(source: Any, made: Any) -> None:
    for name, value in source.attrs.items():
        made.attrs[name] = value


def _content(group: Any) -> Any:
    """Everything in a group without groups, to be compared."""
    datasets = {name: dataset[()] for name, dataset in group.items()}
    plain = {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in datasets.items()
    }
    return plain, {name: str(value) for name, value in group.attrs.items()}
