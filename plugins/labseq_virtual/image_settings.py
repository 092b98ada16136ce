"""Settings of the virtual camera's images; "paper", "derived" and "ours" as in ``settings.py``."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from labseq import Angle, Duration, Length, Settings

PositiveDuration = Annotated[Duration, Field(gt=0)]
PositiveLength = Annotated[Length, Field(gt=0)]


class ImageSettings(Settings):
    """What the virtual EMCCD sees."""

    frame: tuple[PositiveInt, PositiveInt] = Field(
        default=(512, 512), description="[height, width] of a frame in pixels (ours: a common EMCCD)"
    )
    pixel_size: PositiveLength = Field(
        default=0.35e-6,
        description="size of a pixel in the atom plane (ours: 16 um behind a magnification of 46)",
    )
    centre_px: tuple[float, float] = Field(
        default=(255.5, 255.5), description="[y, x] of the grid's centre in pixels (ours: the middle)"
    )
    angle: Angle = Field(default=0.0, description="rotation of the grid on the frame, clockwise (ours)")
    spot: PositiveLength = Field(
        default=0.42e-6,
        description="width (1 sigma of a Gaussian) of an atom's image in the atom plane (derived: 0.33 um is "
        "0.21 wavelengths of 780 nm over the paper's NA of 0.5; ours: 0.26 um of aberrations in quadrature)",
    )
    exposure: PositiveDuration = Field(
        default=45e-3, description="exposure that photoelectrons and background belong to (paper)"
    )
    photoelectrons: PositiveFloat = Field(
        default=60.0,
        description="mean photoelectrons of an atom in that exposure (ours, chosen with the background "
        "so that the detection fidelity is the paper's 99.946 %)",
    )
    background: NonNegativeFloat = Field(
        default=0.37,
        description="mean photoelectrons of stray light per pixel in that exposure (ours, likewise)",
    )
    clock_induced_charge: NonNegativeFloat = Field(
        default=0.005, description="mean spurious electrons per pixel and frame (ours: typical of EMCCDs)"
    )
    em_gain: float = Field(
        default=300.0,
        ge=10,
        description="mean gain of the EM register; the exponential law of its noise needs a high one (ours)",
    )
    read_noise: NonNegativeFloat = Field(
        default=80.0,
        description="read noise behind the EM register, electrons r.m.s. (ours: typical at 10 MHz)",
    )
    electrons_per_adu: PositiveFloat = Field(
        default=5.0, description="electrons behind the EM register per count (ours)"
    )
    offset: NonNegativeFloat = Field(default=500.0, description="counts of a dark pixel (ours)")
