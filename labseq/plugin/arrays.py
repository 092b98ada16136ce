"""Reading arrays that other programs saved: ``.npy``, ``.npz``, and datasets of HDF5 files."""

from __future__ import annotations

from labseq.array_files import ARRAY_FILES, opened_array, split_name

__all__ = [
    "ARRAY_FILES",
    "opened_array",
    "split_name",
]
