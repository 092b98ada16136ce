"""Settings of the virtual camera's images; "paper", "derived" and "ours" as in ``settings.py``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from labseq.plugin import Angle, Duration, Fraction, Length, Settings

PositiveDuration = Annotated[Duration, Field(gt=0)]
PositiveLength = Annotated[Length, Field(gt=0)]


class QcmosSettings(Settings):
    """A qCMOS camera: no EM register, little read noise, every pixel with an amplifier of its own.

    "Hamamatsu" is what is quoted of the ORCA-Quest C15550-20UP and its successor.
    """

    quantum_efficiency: PositiveFloat = Field(
        default=0.6,
        description="quantum efficiency relative to the EMCCD's, which the photoelectrons of atoms and "
        "background belong to (ours: about a half against four fifths at 780 nm)",
    )
    read_noise: NonNegativeFloat = Field(
        default=0.27,
        description="read noise, electrons r.m.s. over all pixels (ours: Hamamatsu, ultra-quiet scan; "
        "0.43 in the standard scan)",
    )
    read_noise_spread: NonNegativeFloat = Field(
        default=0.2,
        le=1,
        description="s.d. of the read noise's logarithm from pixel to pixel, fixed for a seed (ours)",
    )
    electrons_per_adu: PositiveFloat = Field(
        default=0.11, description="electrons per count (ours: Hamamatsu)"
    )
    offset: NonNegativeFloat = Field(default=200.0, description="mean counts of a dark pixel (ours)")
    offset_spread: NonNegativeFloat = Field(
        default=0.5, description="s.d. of the offset from pixel to pixel in counts, fixed for a seed (ours)"
    )
    gain_spread: Fraction = Field(
        default=0.01, description="relative s.d. of the gain from pixel to pixel, fixed for a seed (ours)"
    )
    dark_current: NonNegativeFloat = Field(
        default=0.006, description="mean dark electrons per pixel and second (ours: Hamamatsu)"
    )
    full_well: PositiveFloat = Field(
        default=7000.0, description="electrons that a pixel holds (ours: Hamamatsu)"
    )


class ImageSettings(Settings):
    """What the virtual camera sees."""

    frame: tuple[PositiveInt, PositiveInt] = Field(
        default=(512, 512), description="[height, width] of the sensor in pixels (ours: a common EMCCD)"
    )
    pixel_size: PositiveLength = Field(
        default=0.35e-6,
        description="size of a pixel in the atom plane (ours: 16 um behind a magnification of 46)",
    )
    centre_px: tuple[float, float] = Field(
        default=(255.5, 255.5), description="[y, x] of the grid's centre in pixels (ours: the middle)"
    )
    angle: Angle = Field(default=0.0, description="rotation of the grid on the frame, clockwise (ours)")
    stretch: float = Field(
        default=0.0,
        gt=-0.5,
        lt=1,
        description="magnification along an axis of the frame over that across, less 1; areas stay (ours)",
    )
    stretch_angle: Angle = Field(
        default=0.0, description="direction of that axis, clockwise from the frame's horizontal (ours)"
    )
    barrel: float = Field(
        default=0.0,
        ge=-0.3,
        le=0.3,
        description="radial distortion about the middle of the sensor: how far its corner moves inwards, "
        "relative to its distance; it grows with the third power of the distance (ours)",
    )
    vignetting: Fraction = Field(
        default=0.0,
        description="loss of an atom's light at the corner of the sensor; it grows with the square of the "
        "distance from the middle (ours)",
    )
    brightness_spread: Fraction = Field(
        default=0.0,
        description="relative s.d. of the atoms' light from site to site, fixed for a seed (ours)",
    )
    spot: PositiveLength = Field(
        default=0.42e-6,
        description="width (1 sigma of a Gaussian) of an atom's image in the atom plane (derived: 0.33 um is "
        "0.21 wavelengths of 780 nm over the paper's NA of 0.5; ours: 0.26 um of aberrations in quadrature)",
    )
    halo: Fraction = Field(
        default=0.0,
        description="fraction of an atom's light in wide wings around its spot: density falling as the third "
        "power of the distance, like the mean of an Airy pattern (ours)",
    )
    halo_width: PositiveLength = Field(
        default=1e-6,
        description="width w of the wings: beyond a distance r far from the spot lies w / r of their light "
        "(ours; an ideal lens of NA 0.5 has a halo times its width of 0.16 um)",
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
    sensor: Literal["emccd", "qcmos"] = Field(
        default="emccd",
        description="emccd (paper): a camera with the settings below; qcmos: one with those of `qcmos`",
    )
    clock_induced_charge: NonNegativeFloat = Field(
        default=0.005, description="mean spurious electrons per pixel and frame (ours: typical of EMCCDs)"
    )
    register_clock_induced_charge: NonNegativeFloat = Field(
        default=0.0,
        le=10,
        description="mean spurious electrons that the stages of the EM register add to each pixel read, each "
        "multiplied only by the stages after it (ours)",
    )
    em_gain: float = Field(
        default=300.0,
        ge=1,
        le=2000,
        description="mean gain of the EM register where the camera sets none; 1: a plain CCD (ours)",
    )
    register_stages: int = Field(
        default=536,
        ge=100,
        le=2000,
        description="stages of the EM register (ours: as many as in Hirsch et al., PLoS ONE 8, e53671, 2013)",
    )
    full_well: float = Field(
        default=180e3, ge=1000, description="electrons that a pixel holds (ours: typical)"
    )
    register_well: float = Field(
        default=800e3, ge=1000, description="electrons that a stage of the EM register holds (ours: typical)"
    )
    read_noise: NonNegativeFloat = Field(
        default=80.0,
        description="read noise behind the EM register, electrons r.m.s. (ours: typical at 10 MHz)",
    )
    electrons_per_adu: PositiveFloat = Field(
        default=5.0, description="electrons behind the EM register per count (ours)"
    )
    offset: NonNegativeFloat = Field(default=500.0, description="counts of a dark pixel (ours)")
    qcmos: QcmosSettings = Field(
        default=QcmosSettings(), description="the camera where `sensor` is qcmos; else it plays no part"
    )
