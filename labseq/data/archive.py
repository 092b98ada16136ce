"""Exports a run to one HDF5 file.

The tree::

    /                        values that hold for the whole run, as attributes
      table                  NXdata: a column for each value of the shots, as in ``Run.to_dataframe``
      run/<file>             the files of the run's folder: run.json, sequence.yaml, calibrations, ...
      shots/shot_000000      the content of /entry in the shot's file, also for failed attempts

Settings, devices and target are the same in all shots. The file holds them once, and the shots have hard
links to them. Axes have dimension scales, from which xarray and netCDF take their names. The shots' own files
have no scales because these would double the time to write a shot.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

import labseq
from labseq.data.columns import columns_of
from labseq.data.reader import Run
from labseq.data.shot import Shot
from labseq.data.tables import facts_of
from labseq.errors import RecordingError
from labseq.files import read_file, whole_file
from labseq.plain import plain_text
from labseq.recording import folders, schema
from labseq.recording.read_hdf5 import check_attributes, load_filter, read_attribute, read_attributes
from labseq.recording.shot_file import content_of, open_finished, opened
from labseq.recording.write_hdf5 import add_attribute, link_name, set_attributes, text_array

FORMAT: Final = "labseq-archive"
FORMAT_VERSION: Final = "4.0"

_ROWS: Final = {table.path.rpartition("/")[2]: table.row for table in schema.TABLES}
"""Name of a table -> what one row describes, which is also the name of its axis."""


def write_archive(run: Run, path: Path, *, frames: bool) -> list[str]:
    """Write the archive of a run. The file appears only when it is complete.

    Returns:
        Why shots were left out, because their files are missing or damaged. Empty if all are in it.

    Raises:
        OSError: The file cannot be written.
        RuntimeError: The file cannot be written. HDF5 raises either error.
    """
    left_out: list[str] = []
    with whole_file(path) as part, h5py.File(Path(part.name), "w", libver=schema.LIBRARY_VERSIONS) as file:
        formats = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "archived_by": f"labseq {labseq.__version__}",
        }
        set_attributes(file, {**facts_of(run), **formats, "NX_class": "NXroot", "default": "table"})
        _write_table(file.create_group("table"), run)
        left_out += _write_files(file.create_group("run"), run.path)
        shots = _Shots(file.create_group("shots"), frames=frames)
        for shot in {shot.file: shot for shot in (*run.attempts, *run.shots)}.values():
            try:
                shot.verify()
                shots.add(shot)
            except RecordingError as error:
                left_out.append(str(error))
    return left_out


def _write_table(group: h5py.Group, run: Run) -> None:
    set_attributes(group, {"NX_class": "NXdata", "signal": "filling_fraction", "axes": ["shot"]})
    names: list[str] = []
    for column in columns_of(run):
        names.append(link_name(column.name, names))
        values = text_array(column.values.tolist()) if column.values.dtype.kind == "O" else column.values
        dataset = group.create_dataset(names[-1], data=values)
        set_attributes(dataset, {"units": column.units, "description": column.description})
        _attach(dataset, ["shot"])


def _write_files(group: h5py.Group, run_dir: Path) -> list[str]:
    """Copy the files of the run's folder, text as text and others as bytes. Return a list of omissions."""
    left_out: list[str] = []
    results = group.create_group(folders.RESULTS_FOLDER)
    for goal, folder in ((group, run_dir), (results, run_dir / folders.RESULTS_FOLDER)):
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if path.is_file() and path.suffix != ".part" and not path.name.startswith("."):
                if not path.resolve().is_relative_to(run_dir.resolve()):
                    left_out.append(f"{path}: is a link to a file outside this run; it was not copied")
                    continue
                # no text or picture is that large, and a larger file would fill the memory
                _write_file(goal, plain_text(path.name), read_file(path, 1 << 30))
    return left_out


def _write_file(group: h5py.Group, name: str, data: bytes) -> None:
    try:
        # a text has no zero bytes, but other files may be valid UTF-8 by chance
        text = data.decode() if b"\0" not in data else None
    except ValueError:
        text = None
    if text is None:
        dataset = group.create_dataset(name, data=np.frombuffer(data, np.uint8))
    else:
        dataset = group.create_dataset(name, data=text_array(text))
    set_attributes(dataset, {"units": "", "description": "this file of the run's folder"})


class _Shots:
    """Copies shots into a group, which share equal groups ``run`` and ``target``."""

    def __init__(self, group: h5py.Group, *, frames: bool) -> None:
        self._group = group
        self._frames = frames
        self._shared: dict[str, tuple[Any, Any]] = {}  # name -> content, group

    def add(self, shot: Shot) -> None:
        """Copy a shot whose file is undamaged.

        Raises:
            RecordingError: Its frames are compressed and the package to read them is missing.
        """
        with opened(shot.file) as entry:  # refuses links that lead out of the file
            content_of(entry)
            check_attributes(entry.file)
        with open_finished(shot.file) as source:
            entry: Any = source["entry"]
            for camera in entry.get("camera", {}).values() if self._frames else ():
                load_filter(shot.file, camera["frames"])
            copy = self._group.create_group(shot.file.stem)
            _copy_attributes(entry, copy)
            for name in entry:
                if name in ("target", "run"):
                    self._share(entry[name], copy, name)
                elif self._frames or name != "images_view":
                    _copy(entry, copy, name, frames=self._frames)
                    _name_axes(copy[name])
            if "images_view" in copy:
                _link_scales(copy["images_view"])
            else:
                del copy.attrs["default"]
                set_attributes(copy, {"default": "detection"})

    def _share(self, source: Any, copy: Any, name: str) -> None:
        # compared by content, because each shot's file has its own copy
        content = {
            key: str(value[()]) if value.ndim == 0 else value[()].tobytes() for key, value in source.items()
        }
        content |= {f"@{key}": repr(value) for key, value in read_attributes(source).items()}
        if self._shared.get(name, (None,))[0] != content:
            source.file.copy(source, copy, name)
            _name_axes(copy[name])
            self._shared[name] = content, copy[name]
        else:
            copy[name] = self._shared[name][1]


def _name_axes(node: Any) -> None:
    """Attach named scales to the axes of a dataset, or of all datasets in a group."""
    if isinstance(node, h5py.Dataset):
        axes = str(read_attribute(node, "dimensions", ""))
        if node.dtype.names:
            table = str(node.name).rpartition("/")[2]
            axes = _ROWS.get(table, f"{table}_row").replace(" ", "_")
        if axes:
            _attach(node, axes.split(", "))
        return
    for name in list(node):
        if not isinstance(node.get(name, getlink=True), h5py.SoftLink):
            _name_axes(node[name])


def _link_scales(view: Any) -> None:
    """Link the scales of the frames that a view shows into the view, where netCDF looks for them."""
    folder = view.get("frames", getlink=True).path.rpartition("/")[0]
    for name, node in view.file[folder].items():
        if node.is_scale and name not in view:
            view[name] = h5py.SoftLink(f"{folder}/{name}")


def _attach(dataset: Any, axes: Sequence[str]) -> None:
    """Attach the scale of each axis. It is created next to the first array that needs it."""
    for axis, (name, length) in enumerate(zip(axes, dataset.shape, strict=True)):
        if name not in dataset.parent:
            indices = dataset.parent.create_dataset(name, data=np.arange(length))
            set_attributes(indices, {"units": "", "description": f"index along the axis {name}"})
        scale = dataset.parent[name]
        if not scale.is_scale:
            scale.make_scale(name)
        if scale != dataset:
            dataset.dims[axis].attach_scale(scale)


def _copy(source: Any, copy: Any, name: str, *, frames: bool) -> None:
    """Copy one item of a group. Large arrays are compressed, and frames are copied only if requested."""
    link = source.get(name, getlink=True)
    if isinstance(link, h5py.SoftLink):  # leads to the frames of the same shot
        shot = "/".join(copy.name.split("/")[:3])
        copy[name] = h5py.SoftLink(link.path.replace("/entry", shot, 1))
        return
    node = source[name]
    if isinstance(node, h5py.Group):
        group = copy.create_group(name)
        _copy_attributes(node, group)
        for inner in node.keys():  # noqa: SIM118 - the names in this group, all text
            _copy(node, group, inner, frames=frames)
        return
    is_image = name == "frames" and node.ndim == 3
    if is_image and not frames:
        return
    is_compressed = node.id.get_create_plist().get_nfilters() > 0
    # smaller arrays would grow, because compression needs chunks, and each chunk an entry in their index
    if node.dtype.kind != "O" and (node.nbytes >= 1024 or is_compressed):
        chunks = (1, *node.shape[1:]) if is_image else True  # one frame is read without its neighbours
        packing = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
        _copy_attributes(node, copy.create_dataset(name, data=node[()], chunks=chunks, **packing))
    else:
        source.file.copy(node, copy, name)


def _copy_attributes(source: Any, goal: Any) -> None:
    """Copy the attributes of a group or dataset."""
    for name, array in read_attributes(source).items():
        add_attribute(goal, name, array)
