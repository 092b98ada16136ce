"""The most that losses and detection leave of an array, however well it is rearranged."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class AtomLosses:
    """What atoms are lost to although nobody moves them, and how often one is missed.

    Attributes:
        lifetime_s: Lifetime of an atom in a tweezer, exposures included.
        imaging_loss: Loss in one exposure beside the lifetime's.
        imaging_loss_exposure_s: The exposure that the imaging loss belongs to.
        false_negative: Probability that an atom is not seen; None if it is not known.
    """

    lifetime_s: float
    imaging_loss: float
    imaging_loss_exposure_s: float
    false_negative: float | None = None

    @classmethod
    def of(cls, devices: Mapping[str, Any]) -> AtomLosses | None:
        """What a run's simulation says of itself; None without one, or if it does not tell.

        Args:
            devices: ``describe()`` of each device, as run.json has them.
        """
        told: Any = devices.get("simulation")
        if not isinstance(told, Mapping):
            return None
        names = ("lifetime", "imaging_loss", "imaging_loss_exposure", "false_negative")
        lifetime_s, loss, exposure_s, missed = (_number(told.get(name)) for name in names)  # pyright: ignore[reportUnknownMemberType]
        if lifetime_s is None or loss is None or exposure_s is None:
            return None
        makes_sense = lifetime_s > 0 and exposure_s > 0 and 0 <= loss < 1
        return cls(lifetime_s, loss, exposure_s, missed) if makes_sense else None


def max_defect_free(n_atoms: int, period_s: float, exposure_s: float, losses: AtomLosses) -> float:
    """The highest probability that an array is seen defect-free on the image that ends a cycle.

    Between the moment in which an atom is seen on one image and that on the next one,
    it lives through the loss of one exposure, whatever part of it comes before that moment, and
    through the vacuum for a whole period. What was lost is not missed before the next
    image, even if every plan is perfect and nothing is lost on the way. An atom that is not
    seen counts as a defect on this image; and one that was not seen on the image before was
    sent another one, and both are lost. So each of N atoms is seen where it should be with::

        p = exp(-T / lifetime) (1 - loss) ^ (exposure / 45 ms) (1 - false negative)^2

    and the array with p^N. Empty sites that are taken for full ones change that by about a part in
    a thousand: few sites are empty.

    Args:
        n_atoms: Atoms of the target, N.
        period_s: From the start of an exposure to the start of the next one, T.
        exposure_s: Exposure time.
        losses: See :class:`AtomLosses`.

    Example:
        >>> paper = Losses(lifetime_s=33.0, imaging_loss=0.00314, imaging_loss_exposure_s=0.045)
        >>> round(ceiling(225, 0.058, 0.045, paper), 3)
        0.332
    """
    exposures = exposure_s / losses.imaging_loss_exposure_s
    log_stays = -period_s / losses.lifetime_s + exposures * math.log1p(-losses.imaging_loss)
    log_seen = 2 * math.log1p(-losses.false_negative) if losses.false_negative else 0.0
    return math.exp(n_atoms * (log_stays + log_seen))


def after_moves(most: float, n_atom_moves: float, loss: float) -> float:
    """What is left of the ceiling when the moved atoms may be lost as well.

    An atom that is lost on the way is not missed before the next image, so each of the m moved atoms counts
    with ``1 - loss``. Moves come with the defects, so m is not the same in every shot; with its mean this
    is an estimate, good as long as ``m loss`` is small.

    Args:
        most: The ceiling.
        n_atom_moves: Mean number of atom moves of a cycle, m.
        loss: Loss of a moved atom.

    Example:
        >>> round(after_moves(0.336, 6.0, 0.02), 3)
        0.298
    """
    return most * (1.0 - loss) ** n_atom_moves


def survival(window_s: float, lifetime_s: float) -> float:
    """Probability that an atom outlives a window (paper, figure 4).

    Example:
        >>> round(survival(0.2, 33.0), 4)
        0.994
    """
    return math.exp(-window_s / lifetime_s)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, float | int) and math.isfinite(value) else None
