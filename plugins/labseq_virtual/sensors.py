"""EMCCD and qCMOS sensors, which convert photoelectrons to counts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from labseq.plugin import LimitError, SensorMode
from labseq.plugin.simulation import WHOLE_SENSOR
from labseq_virtual.settings import ImageSettings

NEVER: Final = 1e-13
"""Tails of a distribution with less than this probability are cut off."""


@dataclass(frozen=True, slots=True, eq=False)
class CountDistribution:
    """A distribution of integers, as a table of its cumulative probability, inverted with 32 random bits.

    Probabilities are rounded to whole multiples of 2^-32.

    Attributes:
        first: The smallest number.
        edges: uint32 (n_numbers,), the last random word of each number.
        starts: int32, index in ``edges`` where the search starts, by the leading bits of the word.
    """

    first: int
    edges: NDArray[np.uint32]
    starts: NDArray[np.int32]

    @classmethod
    def of(cls, probability: NDArray[np.float64], first: int = 0) -> CountDistribution:
        """Tabulate the probabilities (n,) of ``first``, ``first`` + 1, ..., which need not add up to 1."""
        from labseq_virtual import image_kernels as kernels

        below = np.cumsum(np.maximum(probability, 0.0))
        below /= below[-1]
        low, high = np.searchsorted(below, [NEVER, 1 - NEVER])
        part = below[low : high + 1] / below[high]
        edges = np.maximum(np.ceil(part * 2.0**32) - 1, 0).astype(np.uint32)
        words = np.arange(1 << kernels.START_BITS, dtype=np.uint32) << np.uint32(32 - kernels.START_BITS)
        return cls(first + int(low), edges, np.searchsorted(edges, words).astype(np.int32))

    def draw(self, drawn: NDArray[np.uint16] | NDArray[np.int32], rng: np.random.Generator) -> None:
        """Fill an array (n,) with numbers."""
        from labseq_virtual import image_kernels as kernels

        kernels.draw(_words(len(drawn), rng), self.edges, self.starts, self.first, drawn)

    def draw_sums(self, n_each: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
        """Draw sums of ``n_each`` numbers, int64 (n_sums,)."""
        from labseq_virtual import image_kernels as kernels

        sums = np.empty(len(n_each), np.int64)
        words = _words(int(n_each.sum()), rng)
        kernels.draw_sums(words, self.edges, self.starts, self.first, n_each, sums)
        return sums


def _words(n: int, rng: np.random.Generator) -> NDArray[np.uint32]:
    """Random words of 32 bits. Two are drawn at once, which is twice as fast."""
    return rng.integers(0, 2**64 - 1, (n + 1) // 2, np.uint64, endpoint=True).view(np.uint32)[:n]


Complex = NDArray[np.complex128]

N_ONE_BY_ONE: Final = 32
"""Up to this number of input electrons, the output of each is drawn separately."""


@dataclass(frozen=True)
class Register:
    """A register of equal stages.

    In a stage, each electron frees another with the probability p, where (1 + p)^n_stages is
    the gain. With the generating function of a stage, f(s) = (1 - p) s + p s^2, the function of the
    whole register is f applied n_stages times. Its Fourier transform gives the exact distribution of
    the output.

    Attributes:
        n_stages: Number of stages.
        gain: Mean electrons out for one in. 1 is a plain CCD.
    """

    n_stages: int
    gain: float

    @property
    def p(self) -> float:
        """Probability that an electron frees another in a stage."""
        return math.expm1(math.log(self.gain) / self.n_stages)

    @property
    def excess_noise(self) -> float:
        """F^2, the variance of the output over gain^2 times the variance of a Poisson input.

        M. Robbins, B. Hadwen, IEEE Trans. Electron Devices 50, 1227 (2003).

        Example:
            >>> round(Register(536, 300.0).excess_noise, 3), Register(536, 1.0).excess_noise
            (1.976, 1.0)
        """
        return 2 * (self.gain - 1) * self.gain ** (-(self.n_stages + 1) / self.n_stages) + 1 / self.gain

    @cached_property
    def one(self) -> CountDistribution:
        """Distribution of the output for one electron in."""
        n_values = power_of_two(45 * self.gain + 64)
        return CountDistribution.of(np.fft.irfft(_transform(self.n_stages, self.gain, n_values), n_values))

    def output(self, mean_electrons: float, n_values: int) -> NDArray[np.float64]:
        """Distribution of the output for a Poisson number of electrons in.

        Args:
            mean_electrons: Mean number of electrons in.
            n_values: A power of two. Larger outputs must be practically impossible.

        Returns:
            float64 (n_values,), probability of 0, 1, ... electrons out.
        """
        one = _transform(self.n_stages, self.gain, n_values)
        return np.fft.irfft(np.exp(mean_electrons * (one - 1)), n_values)

    def multiply(self, n_electrons: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
        """Draw the output for each number of electrons in.

        Exact up to N_ONE_BY_ONE electrons. For more, the electrons added by the stages are drawn from a
        negative binomial distribution with the exact mean and variance, which is exact in the limit of
        many stages.

        Returns:
            int64 (n,), electrons out.
        """
        out = n_electrons.copy()
        if self.p > 0:
            few = n_electrons <= N_ONE_BY_ONE
            out[few] = self.one.draw_sums(n_electrons[few], rng)
            many = n_electrons[~few]
            odds = math.expm1(math.log(self.gain) - 2 * math.atanh(self.p))
            out[~few] += rng.negative_binomial(many * ((self.gain - 1) / odds), 1 / (1 + odds))
        return out


def power_of_two(least: float) -> int:
    """The smallest power of two that is not below a number."""
    return 1 << max(0, int(np.ceil(np.log2(least))))


@lru_cache(maxsize=16)
def _transform(n_stages: int, gain: float, n_values: int) -> Complex:
    """Fourier transform of a register's output for one electron."""
    p = Register(n_stages, gain).p
    s: Complex = np.exp(-2j * np.pi * np.fft.rfftfreq(n_values))
    for _ in range(n_stages):
        s *= 1 - p + p * s
    return s


class View(ImageSettings):
    """Image settings of one sensor mode, with the part that is read, its binning, gain and stray light."""

    region: tuple[int, int, int, int] = Field(description="[y, x, height, width] of the part that is read")
    binning: int = Field(
        description="pixels of the sensor per pixel of a frame along each axis, added up before the register "
        "of an EMCCD, and after the read-out of a qCMOS camera"
    )

    @classmethod
    def of(cls, settings: ImageSettings, mode: SensorMode = WHOLE_SENSOR) -> Self:
        """The settings in a mode. A closed shutter also keeps stray light out.

        Raises:
            LimitError: The sensor has no such part, binning or EM register.
        """
        region = mode.region or (0, 0, *settings.frame)
        _check(settings, mode, region)
        made: dict[str, object] = {"region": region, "binning": mode.binning}
        if mode.em_gain is not None:
            made["em_gain"] = mode.em_gain
        if not mode.shutter_open:
            made["background"] = 0.0
        return cls.model_validate(settings.model_dump() | made)

    @property
    def readout_fraction(self) -> float:
        """Time to read a frame, relative to the whole sensor without binning.

        An EMCCD reads pixel by pixel, a qCMOS camera row by row.
        """
        height, width = self.frame
        rows, cols = self.region[2:]
        if self.sensor == "qcmos":
            return rows / height
        return rows * cols / (height * width * self.binning**2)


def _check(settings: ImageSettings, mode: SensorMode, region: tuple[int, int, int, int]) -> None:
    y, x, height, width = region
    rows, cols = settings.frame
    if min(y, x) < 0 or min(height, width) < 1 or y + height > rows or x + width > cols:
        text = f"[y, x, height, width] = {list(region)}"
        raise LimitError("the region of the sensor", text, f"its {rows} x {cols} pixels")
    if mode.binning < 1 or height % mode.binning or width % mode.binning:
        raise LimitError(
            "the binning", mode.binning, f"a divisor of the {height} x {width} pixels of the region"
        )
    if settings.sensor == "qcmos" and mode.em_gain not in (None, 1.0):
        hint = "leave the camera's `em_gain` out, or set the simulation's `image.sensor: emccd`"
        raise LimitError("the EM gain", f"{mode.em_gain:g}", "1 (a qCMOS sensor has no EM register)", hint)


FULL_SCALE: Final = 65535
"""Largest count of the 16 bit converter."""

MAX_WORK: Final = 2**23
"""Size of a table (outputs of the register times counts within the read noise) above which none is made."""

MAX_ELECTRONS: Final = 300
"""Mean electrons of a dark pixel above which no table is made. Fewer never fill a well."""


@dataclass(frozen=True)
class Output:
    """The output stage behind the register.

    Attributes:
        well: Maximum number of electrons in the register.
        read_noise: Electrons r.m.s.
        electrons_per_adu: Electrons per count.
        offset: Counts of a dark pixel.
    """

    well: float
    read_noise: float
    electrons_per_adu: float
    offset: float

    def counts(self, electrons: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Counts of electrons behind the register, not yet rounded."""
        counts = np.minimum(electrons, self.well) + self.read_noise * rng.standard_normal(len(electrons))
        return counts / self.electrons_per_adu + self.offset


STAGES: Final = 536
"""Stages of the EM register (ours, as in Hirsch et al., PLoS ONE 8, e53671, 2013)."""


class Emccd:
    """An EMCCD camera.

    The electrons of a pixel (photoelectrons, and the clock-induced charge of the sensor) pass the EM
    register. Then follow read noise, offset and an analogue-to-digital converter of 16 bit. Pixels
    without an atom's light share one distribution, which is computed once per exposure time and
    drawn from a table. For the other pixels each step is drawn.
    """

    quantum_efficiency: Final = 1.0
    """1, because the settings give the photoelectrons of this camera."""

    def __init__(self, settings: View) -> None:
        self.binning = settings.binning
        self._settings = settings
        self.register = Register(STAGES, settings.em_gain)
        self._output = Output(
            settings.register_well, settings.read_noise, settings.electrons_per_adu, settings.offset
        )

    def warm(self) -> None:
        """Compute the tables for the exposure of the settings."""
        _ = self.register.one
        _dark_counts(self.register, self._output, self._dark_electrons(self._settings.exposure))

    def read(
        self, light: NDArray[np.int32], exposure_s: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Counts, uint16, from the photoelectrons of atoms on each pixel, int32 (height, width)."""
        dark_electrons = self._dark_electrons(exposure_s)
        dark = _dark_counts(self.register, self._output, dark_electrons)
        image = np.empty(light.size, np.uint16)
        if dark is None:
            lit = slice(None)
        else:
            dark.draw(image, rng)
            lit = np.flatnonzero(light > 0)
        n_electrons = light.ravel()[lit].astype(np.int64)
        n_electrons += rng.poisson(dark_electrons, len(n_electrons))
        n_electrons = np.minimum(n_electrons, round(self._settings.full_well))
        counts = self._output.counts(self.register.multiply(n_electrons, rng), rng)
        image[lit] = np.clip(np.rint(counts), 0, FULL_SCALE)
        return image.reshape(light.shape)

    def _dark_electrons(self, exposure_s: float) -> float:
        """Mean electrons of a pixel without an atom's light."""
        settings = self._settings
        per_pixel = settings.background * exposure_s / settings.exposure + settings.clock_induced_charge
        return per_pixel * settings.binning**2


@lru_cache(maxsize=64)
def _dark_counts(register: Register, output: Output, mean_electrons: float) -> CountDistribution | None:
    """Distribution of the counts of a pixel without an atom's light. None if the table would be too long."""
    n_values = power_of_two((mean_electrons + 9 * (2 * mean_electrons) ** 0.5 + 45) * register.gain)
    spread = output.read_noise / output.electrons_per_adu
    reach = int(np.ceil(6.5 * spread)) + 1
    if n_values * reach > MAX_WORK or mean_electrons > MAX_ELECTRONS:
        return None
    p = np.maximum(register.output(mean_electrons, n_values), 0.0)
    p = p[: np.flatnonzero(p > 1e-15)[-1] + 1]
    value = np.minimum(np.arange(len(p)), output.well) / output.electrons_per_adu + output.offset
    nearest = np.rint(value).astype(np.int64)
    probability = np.zeros(FULL_SCALE + 1)
    n_counts = min(FULL_SCALE, int(nearest[-1]) + reach) + 1  # larger counts are impossible
    below = normal_below(nearest - reach - value - 0.5, spread)
    for distance in range(-reach, reach + 1):
        count = nearest + distance
        below_next = normal_below(count - value + 0.5, spread)
        share = (below_next - below) * p
        probability[:n_counts] += np.bincount(np.clip(count, 0, n_counts - 1), share, n_counts)
        below = below_next
    return CountDistribution.of(probability)


def normal_below(distance: NDArray[np.float64], spread: float) -> NDArray[np.float64]:
    """Probability that Gaussian noise of s.d. ``spread`` is below a distance from its mean."""
    return (distance > 0).astype(float) if spread == 0 else np.interp(distance / spread, *_normal())


@cache
def _normal() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and values of the normal distribution function. Linear interpolation is exact to 1e-7.

    Importing ``scipy.special`` for it would take 0.2 s of every start.
    """
    points = np.arange(-8.0, 8.0, 1e-3)
    return points, np.array([math.erfc(-point / math.sqrt(2)) / 2 for point in points.tolist()])


Floats = NDArray[np.float32]


class Qcmos:
    """A qCMOS camera.

    Photoelectrons and dark current fill the pixel's well. Its own gain, read noise and offset follow,
    then an analogue-to-digital converter of 16 bit. Pixels are binned after that.
    """

    binning: Final = 1
    """Binning before the read-out."""

    def __init__(self, settings: View, rng: np.random.Generator) -> None:
        self.quantum_efficiency = settings.qcmos.quantum_efficiency
        self._settings = settings
        self._rng = rng

    def warm(self) -> None:
        """Draw the differences from pixel to pixel."""
        _ = self._pixels

    def read(
        self, light: NDArray[np.int32], exposure_s: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Counts, uint16, binned, from the photoelectrons of atoms on each pixel, int32 (height, width)."""
        adu_per_electron, read_noise, offset = self._pixels
        electrons = np.empty(light.shape, np.int32)
        _poisson(self._dark_electrons(exposure_s)).draw(electrons.ravel(), rng)
        electrons += light
        counts = np.minimum(electrons, round(self._settings.qcmos.full_well)).astype(np.float32)
        counts *= adu_per_electron
        counts += offset
        noise = rng.standard_normal(light.shape, np.float32)
        noise *= read_noise
        counts += noise
        np.clip(np.rint(counts, out=counts), 0, FULL_SCALE, out=counts)
        b = self._settings.binning
        if b > 1:
            height, width = light.shape
            summed = counts.reshape(height // b, b, width // b, b).sum(axis=(1, 3))
            counts = np.minimum(summed, FULL_SCALE)
        return counts.astype(np.uint16)

    @cached_property
    def _pixels(self) -> tuple[Floats, Floats, Floats]:
        """Counts per electron, read noise and offset in counts of each pixel that is read."""
        settings, frame = self._settings.qcmos, self._settings.frame
        normal = self._rng.standard_normal((3, *frame), np.float32)
        top, left, height, width = self._settings.region
        normal = normal[:, top : top + height, left : left + width]
        adu_per_electron = np.maximum(0, 1 + settings.gain_spread * normal[0]) / settings.electrons_per_adu
        spread = settings.read_noise_spread  # the mean square of exp(spread * normal) is exp(2 * spread^2)
        read_noise = settings.read_noise * np.exp(spread * normal[1] - spread**2) * adu_per_electron
        offset = settings.offset + settings.offset_spread * normal[2]
        return adu_per_electron, read_noise, offset

    def _dark_electrons(self, exposure_s: float) -> float:
        """Mean electrons of a pixel without an atom's light."""
        settings = self._settings
        stray = settings.background * settings.qcmos.quantum_efficiency * exposure_s / settings.exposure
        return stray + settings.qcmos.dark_current * exposure_s


@lru_cache(maxsize=16)
def _poisson(mean: float) -> CountDistribution:
    from scipy.special import gammaln, xlogy

    k = np.arange(int(mean + 9 * mean**0.5) + 45)
    return CountDistribution.of(np.exp(xlogy(k, mean) - mean - gammaln(k + 1)))
