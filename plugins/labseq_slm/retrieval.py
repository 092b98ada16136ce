"""Phase retrieval, which finds the light on the pixels that makes spots of given powers at the sites.

Weighted Gerchberg-Saxton iterations (Di Leonardo, Ianni, Ruocco, Opt. Express 15, 1913, 2007), in two parts.
First the phases of the spots are found, with equal weights. Then they are kept, and only the amplitudes of
the spots are adapted to the weights (Kim et al., Opt. Lett. 44, 3178, 2019), so that the pattern changes
little with the weights and a calibration of the weights remains valid.

The far field is summed over all pixels exactly at each site, as two products of matrices, because the sites
are not on the grid of frequencies of a fast Fourier transform. Most iterations use only each fourth pixel of
rows and columns (as Pozzi et al., Opt. Express 26, 32176, 2018, who draw them at random). The module does not
use the retrieval of ``slmsuite``, because that is made for graphics cards and its fast method rounds sites to
the grid of the transform.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin.system import cache_root
from labseq_slm.optics import Optics, beam

Coefficients = NDArray[np.complex64]
"""complex64 (n_sites,), amplitude and phase of the wave to each site."""

SEARCH: Final = 25
"""Iterations that find the phases of the spots (ours)."""
ADAPT: Final = 10
"""Iterations that adapt the amplitudes on few pixels. 400 sites then differ by 0.3 % there, measured."""
FINISH: Final = 3
"""Iterations on all pixels. The spread there was 1.1 % in the first, and 0.2 % in the third."""


class FarField:
    """The light of pixels at the sites.

    Args:
        optics: Where the sites are.
        amplitude: float32 (rows, columns), amplitude of the light on the pixels.
        step: 4 takes each fourth pixel of rows and columns.
    """

    def __init__(self, optics: Optics, amplitude: NDArray[np.float32], step: int = 1) -> None:
        every = slice(step // 2, None, step)
        self._amplitude = amplitude[every, every] / amplitude[every, every].sum()
        rows, columns = (np.linspace((1 - n) / 2, (n - 1) / 2, n)[every] for n in optics.pixels)
        self._rows = _waves(optics.row_rad, rows)
        self._columns = _waves(optics.column_rad, columns)
        self._columns_back = np.ascontiguousarray(self._columns.conj().T)

    def light(self, coefficients: Coefficients) -> NDArray[np.complex64]:
        """The sum of the waves to all sites, complex64 (rows, columns)."""
        return np.matmul((self._rows * coefficients[:, None]).T, self._columns, dtype=np.complex64)

    def at_sites(self, phasors: NDArray[np.complex64]) -> Coefficients:
        """Amplitude at each site, complex64 (n_sites,), of a phase pattern, 1 if all light went there.

        Args:
            phasors: complex64 (rows, columns) of modulus 1.
        """
        across = (phasors * self._amplitude) @ self._columns_back
        return np.einsum("sy,ys->s", self._rows.conj(), across)

    def reached(self, coefficients: Coefficients) -> Coefficients:
        """Amplitude at each site if the pixels have the phases of the sum of the waves."""
        return self.at_sites(phasors_of(self.light(coefficients)))


def phasors_of(light: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
    """Waves of the same phases and modulus 1, 0 where there is no light."""
    modulus = np.maximum(np.abs(light), np.float32(1e-12))
    return (light / modulus).astype(np.complex64, copy=False)


def _waves(rad: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.complex64]:
    return np.exp(1j * np.outer(rad, pixels)).astype(np.complex64)


def retrieve(optics: Optics, weights: NDArray[np.float64]) -> Coefficients:
    """The waves whose sum has the phases to display, from the cache if they were found before.

    Args:
        optics: Where the sites are, and the beam.
        weights: float64 (n_sites,), wanted powers in any unit.
    """
    amplitude = beam(optics.pixels, optics.beam_px)
    few = FarField(optics, amplitude, _step(optics))
    equal = np.ones(len(weights))

    def search() -> Coefficients:
        phases = np.random.default_rng(1).uniform(0, 2 * np.pi, len(equal))
        start = np.exp(1j * phases).astype(np.complex64)
        return _iterated(few, start, equal, SEARCH, keep_phases=False)

    def adapt() -> Coefficients:
        phasors = phasors_of(_cached(optics, equal, "phases", search))
        start = (phasors * np.sqrt(weights)).astype(np.complex64)
        adapted = _iterated(few, start, weights, ADAPT)
        return _iterated(FarField(optics, amplitude), adapted, weights, FINISH)

    return _cached(optics, weights / weights.mean(), "weights", adapt)


def _iterated(
    field: FarField,
    coefficients: Coefficients,
    weights: NDArray[np.float64],
    n: int,
    *,
    keep_phases: bool = True,
) -> Coefficients:
    wanted = np.sqrt(weights).astype(np.float32)
    for _ in range(n):
        reached = field.reached(coefficients)
        ratio = np.abs(reached) / wanted
        phasors = phasors_of(coefficients if keep_phases else reached)
        coefficients = (np.abs(coefficients) * (ratio.mean() / ratio) * phasors).astype(np.complex64)
    return coefficients


def _step(optics: Optics) -> int:
    """The coarsest sufficient step between pixels, at which orders of the coarse grid do not overlap."""
    widths = np.ptp(optics.row_rad), np.ptp(optics.column_rad)
    n_enough = 40 * len(optics.row_rad)  # pixels for each site
    steps = [
        step
        for step in (4, 3, 2)
        if step * max(widths) < 0.9 * 2 * np.pi and np.prod(optics.pixels) > n_enough * step**2
    ]
    return steps[0] if steps else 1


def _cached(
    optics: Optics, weights: NDArray[np.float64], what: str, find: Callable[[], Coefficients]
) -> Coefficients:
    """The result of ``find``, kept in labseq's cache under a digest of all that it depends on."""
    n_iterations = (SEARCH, ADAPT, FINISH)
    head = f"{what} {n_iterations} {optics.pixels} {optics.beam_px!r}"
    parts = (np.round(each, 12) for each in (optics.row_rad, optics.column_rad, weights))
    digest = hashlib.sha256(b"".join([head.encode(), *(part.tobytes() for part in parts)])).hexdigest()
    path: Path | None = None
    with suppress(OSError, ValueError, RuntimeError, EOFError):  # not there, damaged, or no home
        path = cache_root() / "slm" / f"{digest[:32]}.npy"
        kept = np.load(path)
        if kept.shape == weights.shape and kept.dtype == np.complex64:
            return kept
    found = find()
    with suppress(OSError):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            whole = path.with_suffix(f".{os.getpid()}.npy")
            np.save(whole, found)
            whole.replace(path)
    return found
