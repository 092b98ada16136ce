"""Kernels for the energy, initial state and motion of an atom in the light of Gaussian beams.

Energies and depths are per mass, in m^2/s^2. Atoms
of a batch are integrated in single precision, several at once, so that the compiler uses the processor's
vector instructions. Each atom is a *lane* of a flat array.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq_virtual.records import ATOM, Atom

Floats = NDArray[np.float64]


class Machine(NamedTuple):
    """The constants of the machine and of a program.

    Attributes:
        static_depth: Nominal depth of a static tweezer.
        static_waist: 1/e^2 radius of a static tweezer's intensity, in metres.
        static_rayleigh: Rayleigh length of a static tweezer.
        mobile_depth: Depth of a mobile tweezer whose tones have their intended power.
        mobile_waist: 1/e^2 radius of a mobile tweezer's intensity, in metres.
        mobile_rayleigh: Rayleigh length of a mobile tweezer.
        temperature: Temperature of cooled atoms, in kelvin.
        cooling_hz: Rate at which the cooling light brings atoms back to ``temperature``. 0 without light.
        noise_hz: Rate at which noise of the intensity heats an atom in a nominal static tweezer.
        loss: Probability that a moved atom is lost, in addition to losses in its flight.
        pair_survival: Probability that a collision leaves one of two atoms in a tweezer.
    """

    static_depth: float
    static_waist: float
    static_rayleigh: float
    mobile_depth: float
    mobile_waist: float
    mobile_rayleigh: float
    temperature: float
    cooling_hz: float
    noise_hz: float
    loss: float
    pair_survival: float


MACHINE: Final = f"UniTuple(float64, {len(Machine._fields)})"


@helper_kernel()
def pull(
    x: float, y: float, z: float, depth: float, waist: float, rayleigh: float
) -> tuple[float, float, float, float]:
    """Acceleration of an atom by a Gaussian beam along z, and its potential energy per mass.

    ``U = -depth / s exp(-2 r^2 / (waist^2 s))`` with ``s = 1 + (z / rayleigh)^2``
    (R. Grimm, M. Weidemueller, Y. Ovchinnikov, Adv. At. Mol. Opt. Phys. 42, 95, 2000).

    Args:
        x: Distance from the beam's axis, in metres.
        y: Distance in the other direction, in metres.
        z: Position along the axis, from the focus.
        depth: Depth per mass.
        waist: 1/e^2 radius of the intensity.
        rayleigh: Rayleigh length.
    """
    s = 1.0 + (z / rayleigh) ** 2
    q = 2.0 * (x * x + y * y) / (waist * waist * s)
    energy = depth / s * math.exp(-q)
    radial = -4.0 * energy / (waist * waist * s)
    axial = -2.0 * energy * (1.0 - q) / (s * rayleigh * rayleigh)
    return radial * x, radial * y, axial * z, -energy


@helper_kernel()
def energy_in(atom: Atom, x: float, y: float, depth: float, waist: float, rayleigh: float) -> float:
    """Energy of an atom in one tweezer at a place. Negative if the tweezer binds it."""
    kinetic = 0.5 * (atom.vx * atom.vx + atom.vy * atom.vy + atom.vz * atom.vz)
    return kinetic + pull(atom.x - x, atom.y - y, atom.z, depth, waist, rayleigh)[3]


LANES: Final = 8
"""Number of atoms that are moved together in a vector of 256 bits."""
N_NUMBERS: Final = 15
X, Y, Z, VX, VY, VZ, STATIC, AWAY_X, AWAY_Y, WAY_X, WAY_Y, ROW, ROW_CHANGE, COL, COL_CHANGE = (
    LANES * n for n in range(N_NUMBERS)
)
"""Start of each quantity of the lanes. Position relative to the static tweezer, velocity, static depth,
position of the mobile tweezer relative to the static one, its displacement until the next frame, the factors
of its depth, and their changes."""
ZERO, HALF_, ONE, TWO, FARTHEST = (np.float32(x) for x in (0.0, 0.5, 1.0, 2.0, 40.0))
SHORTER = np.float32(-1.0 / 32.0)
C2, C3, C4, C5 = (np.float32(1.0 / math.factorial(n)) for n in range(2, 6))


@helper_kernel()
def fall(q: np.float32) -> np.float32:
    """exp(-q) for q of at least 0, as (exp(-q / 32))^32 with a series, to 1e-5 at 8, without branches."""
    u = min(q, FARTHEST) * SHORTER
    e = ONE + u * (ONE + u * (C2 + u * (C3 + u * (C4 + u * C5))))
    e *= e
    e *= e
    e *= e
    e *= e
    return e * e


@helper_kernel()
def pull_fast(
    x: np.float32, y: np.float32, z: np.float32, depth: np.float32, width: np.float32, length: np.float32
) -> tuple[np.float32, np.float32]:
    """As ``pull``, in single precision. Returns the factors of x and y, and of z, for the acceleration.

    ``width`` is 2 / waist^2, ``length`` 1 / rayleigh^2.
    """
    g = ONE / (ONE + z * z * length)
    q = (x * x + y * y) * width * g
    energy = depth * g * fall(q)
    return -TWO * width * g * energy, -TWO * energy * (ONE - q) * g * length


@helper_kernel()
def move(lanes: NDArray[np.float32], machine: Machine, duration_s: float, n_steps: int) -> None:
    """Move the atoms of all lanes from one frame to the next, with light that changes evenly, by leapfrog."""
    width_s, length_s = np.float32(2 / machine.static_waist**2), np.float32(1 / machine.static_rayleigh**2)
    width_m, length_m = np.float32(2 / machine.mobile_waist**2), np.float32(1 / machine.mobile_rayleigh**2)
    depth, dt = np.float32(machine.mobile_depth), np.float32(duration_s / n_steps)
    half = HALF_ * dt
    for step in range(n_steps):
        part = np.float32((step + 0.5) / n_steps)
        for i in range(LANES):
            x = lanes[X + i] + half * lanes[VX + i]
            y = lanes[Y + i] + half * lanes[VY + i]
            z = lanes[Z + i] + half * lanes[VZ + i]
            radial_s, axial_s = pull_fast(x, y, z, lanes[STATIC + i], width_s, length_s)
            right = x - lanes[AWAY_X + i] - part * lanes[WAY_X + i]
            up = y - lanes[AWAY_Y + i] - part * lanes[WAY_Y + i]
            row = lanes[ROW + i] + part * lanes[ROW_CHANGE + i]
            col = lanes[COL + i] + part * lanes[COL_CHANGE + i]
            radial_m, axial_m = pull_fast(right, up, z, depth * row * col, width_m, length_m)
            vx = lanes[VX + i] + dt * (radial_s * x + radial_m * right)
            vy = lanes[VY + i] + dt * (radial_s * y + radial_m * up)
            vz = lanes[VZ + i] + dt * (axial_s + axial_m) * z
            lanes[VX + i], lanes[VY + i], lanes[VZ + i] = vx, vy, vz
            lanes[X + i] = x + half * vx
            lanes[Y + i] = y + half * vy
            lanes[Z + i] = z + half * vz


WIDER = 2.2
"""Width of the proposed positions relative to a harmonic well, to cover a beam's weaker flanks."""
LONGER = 4.0
"""Length of the proposed positions along the beam, relative to a harmonic well."""


@helper_kernel()
def draw_place(most: float, atom: Atom, rng: np.random.Generator) -> float:
    """Draw a position in units of waist and Rayleigh length, and return -U / kT there. See ``draw_atoms``."""
    across, along = WIDER / math.sqrt(4.0 * most), LONGER / math.sqrt(2.0 * most)
    while True:
        nx, ny, nz = rng.standard_normal(), rng.standard_normal(), rng.standard_normal()
        x, y, z = across * nx, across * ny, along * nz
        s = 1.0 + z * z
        a = most / s * math.exp(-2.0 * (x * x + y * y) / s)
        part = rng.random() / math.exp(a - most + 0.5 * (nx * nx + ny * ny + nz * nz))
        if part < 1.0 and part < math.erf(math.sqrt(a)) - 2.0 * math.sqrt(a / math.pi) * math.exp(-a):
            atom.x, atom.y, atom.z = x, y, z
            return a


@helper_kernel()
def draw_atom(
    atom: Atom, depth: float, kt: float, waist: float, rayleigh: float, rng: np.random.Generator
) -> None:
    """Draw one atom at the origin like :func:`draw_atoms`. ``kt`` is per mass."""
    kt = min(kt, 0.5 * depth)
    bound = draw_place(depth / kt, atom, rng)
    atom.x, atom.y, atom.z = waist * atom.x, waist * atom.y, rayleigh * atom.z
    while True:
        vx, vy, vz = rng.standard_normal(), rng.standard_normal(), rng.standard_normal()
        if 0.5 * (vx * vx + vy * vy + vz * vz) < bound:
            fast = math.sqrt(kt)
            atom.vx, atom.vy, atom.vz = fast * vx, fast * vy, fast * vz
            return


@kernel(f"float64[:, ::1]({const('float64', 1)}, {const('float64', 1)}, float64, float64, npy_rng)")
def draw_atoms(depth: Floats, kt: Floats, waist: float, rayleigh: float, rng: np.random.Generator) -> Floats:
    """Draw atoms from the Boltzmann distribution in a Gaussian beam, restricted to bound atoms.

    Positions have the density ``exp(a) P(a)``, where ``a = -U / kT`` and
    ``P(a) = erf(sqrt(a)) - 2 sqrt(a / pi) exp(-a)`` is the fraction of the Maxwell distribution slow enough
    to be bound there. They are drawn by rejection from a wider Gaussian. This distribution is stationary,
    while a harmonic one would breathe. In tweezers too shallow for the temperature, the temperature is half
    the depth, because hotter atoms have evaporated.

    Args:
        depth: Depth of each atom's tweezer per mass, (n_atoms,), above 0.
        kt: kT per mass of each atom.
        waist: 1/e^2 radius of the intensity.
        rayleigh: Rayleigh length.
        rng: Random numbers.

    Returns:
        Positions relative to the tweezers' foci, and velocities, (n_atoms, 6).
    """
    atoms, drawn = np.empty((len(depth), 6)), np.empty(1, ATOM)
    atom: Any = drawn[0]
    for i in range(len(depth)):
        draw_atom(atom, depth[i], kt[i], waist, rayleigh, rng)
        atoms[i] = np.array([atom.x, atom.y, atom.z, atom.vx, atom.vy, atom.vz])
    return atoms


@kernel(f"float64[::1](float64[:, ::1], {const('float64', 1)}, float64, float64, float64, float64)")
def ramp_atoms(
    state: Floats, depth: Floats, end: float, duration_s: float, waist: float, rayleigh: float
) -> Floats:
    """Move atoms while the depth of their static tweezers changes evenly.

    Args:
        state: The atoms, each relative to its tweezer (n_atoms, 6). Changed in place.
        depth: Depth of each tweezer at the start (n_atoms,).
        end: Final depth divided by initial depth.
        duration_s: Duration of the ramp.
        waist: 1/e^2 radius of the intensity.
        rayleigh: Rayleigh length.

    Returns:
        Energies in the tweezers at the end (n_atoms,).
    """
    energy = np.empty(len(state))
    for i in range(len(state)):
        x, y, z, vx, vy, vz = state[i]
        period_s = math.pi * waist / math.sqrt(depth[i] * max(1.0, end))
        n_steps = math.ceil(16.0 * duration_s / period_s)
        dt = duration_s / max(n_steps, 1)
        for step in range(n_steps):
            x, y, z = x + 0.5 * dt * vx, y + 0.5 * dt * vy, z + 0.5 * dt * vz
            now = depth[i] * (1.0 + (end - 1.0) * (step + 0.5) / n_steps)
            ax, ay, az, _ = pull(x, y, z, now, waist, rayleigh)
            vx, vy, vz = vx + dt * ax, vy + dt * ay, vz + dt * az
            x, y, z = x + 0.5 * dt * vx, y + 0.5 * dt * vy, z + 0.5 * dt * vz
        state[i] = np.array([x, y, z, vx, vy, vz])
        kinetic = 0.5 * (vx * vx + vy * vy + vz * vz)
        energy[i] = kinetic + pull(x, y, z, end * depth[i], waist, rayleigh)[3]
    return energy
