"""Settings of the simulation and of every virtual device.

"Paper" is Tian et al., "Parallel assembly of arbitrary defect-free atom arrays
with a multi-tweezer algorithm". "derived" is computed from its numbers. "ours" is our
choice where the paper gives no value.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from labseq.plugin import (
    Angle,
    Duration,
    Fraction,
    Frequency,
    Length,
    PositiveDuration,
    Settings,
    Temperature,
    camera,
    format_quantity,
)
from labseq.plugin.camera import Cooling

PositiveLength = Annotated[Length, Field(gt=0)]


class QcmosSettings(Settings):
    """A qCMOS camera, with little read noise, an amplifier for each pixel and no EM register.

    "Hamamatsu" marks values quoted for the ORCA-Quest C15550-20UP and its successor.
    """

    quantum_efficiency: PositiveFloat = Field(
        default=0.6,
        description="quantum efficiency relative to the EMCCD, for which the photoelectrons of atoms and "
        "background are given (ours: about a half against four fifths at 780 nm)",
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
        default=7000.0, description="maximum electrons in a pixel (ours: Hamamatsu)"
    )


class ImageSettings(Settings):
    """The image that the virtual camera takes."""

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
        description="ratio of magnifications along and across an axis, minus 1, at equal area (ours)",
    )
    stretch_angle: Angle = Field(
        default=0.0, description="direction of this axis, clockwise from the frame's horizontal (ours)"
    )
    barrel: float = Field(
        default=0.0,
        ge=-0.3,
        le=0.3,
        description="radial distortion about the middle of the sensor, as inward shift of its corner "
        "relative to its distance. The shift grows with the third power of the distance (ours)",
    )
    vignetting: Fraction = Field(
        default=0.0,
        description="loss of an atom's light at the corner of the sensor. It grows with the square of the "
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
        description="fraction of an atom's light in wide wings around its spot, whose density falls as the "
        "third power of the distance, like the mean of an Airy pattern (ours)",
    )
    halo_width: PositiveLength = Field(
        default=1e-6,
        description="width w of the wings. Beyond a large distance r from the spot is w / r of their light "
        "(ours, an ideal lens of NA 0.5 has a halo times its width of 0.16 um)",
    )
    exposure: PositiveDuration = Field(
        default=45e-3, description="exposure for which the photoelectrons are given (paper)"
    )
    tweezer_light: NonNegativeFloat = Field(
        default=0.0,
        description="mean photoelectrons of the light of a static tweezer of nominal power in that exposure, "
        "which the camera's filter lets through (ours: none). Its spot is as wide as an atom's",
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
        description="kind of camera, `emccd` (paper) with the settings below or `qcmos` with its own",
    )
    clock_induced_charge: NonNegativeFloat = Field(
        default=0.005, description="mean spurious electrons per pixel and frame (ours: typical of EMCCDs)"
    )
    em_gain: float = Field(
        default=300.0,
        ge=1,
        le=2000,
        description="mean gain of the EM register if the camera sets none, or 1 for a plain CCD (ours)",
    )
    full_well: float = Field(
        default=180e3, ge=1000, description="maximum electrons in a pixel (ours: typical)"
    )
    register_well: float = Field(
        default=800e3, ge=1000, description="maximum electrons in a stage of the EM register (ours: typical)"
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
        default=QcmosSettings(), description="the camera if `sensor` is qcmos, otherwise ignored"
    )


TWEEZER_EXPOSURE_S = 1e-3
"""Exposure for which the photoelectrons of ``tweezer_image`` are given (ours)."""


class TweezerImageSettings(Settings):
    """The image of a further camera, with the light of the tweezers and no light of atoms.

    An industrial camera with a read noise of 2 electrons, 0.1 electrons per count, wells of 7000 (ours).
    """

    frame: tuple[PositiveInt, PositiveInt] = Field(
        default=(512, 512), description="[height, width] of the sensor in pixels (ours)"
    )
    pixel_size: PositiveLength = Field(
        default=0.35e-6, description="size of a pixel in the atom plane (ours)"
    )
    centre_px: tuple[float, float] = Field(
        default=(255.5, 255.5), description="[y, x] of the grid's centre in pixels (ours: the middle)"
    )
    angle: Angle = Field(default=0.0, description="rotation of the grid on the frame, clockwise (ours)")
    tweezer_light: NonNegativeFloat = Field(
        default=20e3,
        description="mean photoelectrons of the light of a static tweezer of nominal power in 1 ms (ours: in "
        "three times this exposure its pixels are saturated). A mobile tweezer gives seven times as many",
    )

    def image(self) -> ImageSettings:
        """The same sensor and optics as settings of a camera for atoms."""
        sensor = QcmosSettings(
            quantum_efficiency=1.0, read_noise=2.0, electrons_per_adu=0.1, full_well=7000.0
        )
        light = {"exposure": TWEEZER_EXPOSURE_S, "background": 5.0}  # electrons per pixel (ours)
        return ImageSettings.model_validate(
            {**self.model_dump(), **light, "sensor": "qcmos", "qcmos": sensor}
        )


PositiveTemperature = Annotated[Temperature, Field(gt=0)]
NonNegativeLength = Annotated[Length, Field(ge=0)]


class ToneComb(Settings):
    """True frequencies of the tones that put tweezers onto the rows or columns."""

    centre: Annotated[Frequency, Field(gt=0)] = Field(
        default=100e6, description="frequency of the grid's centre (ours)"
    )
    step: Frequency = Field(
        default=1.6e6, description="step from one row or column to the next, negative if falling (ours)"
    )

    @model_validator(mode="after")
    def _has_step(self) -> Self:
        if self.step == 0:
            raise ValueError("step is 0; expected a frequency other than 0")
        return self


class MobileLightSettings(Settings):
    """The light of the mobile tweezers."""

    depth: PositiveTemperature = Field(
        default=2.1e-3, description="depth of a tweezer whose two tones have their intended amplitude (paper)"
    )
    waist: PositiveLength = Field(default=0.98e-6, description="1/e^2 radius of the intensity (paper)")
    wavelength: PositiveLength = Field(default=852e-9, description="wavelength (paper)")
    transit_time: Annotated[Duration, Field(ge=1e-6, le=50e-6)] = Field(
        default=10e-6,
        description="time for the sound to cross the beam in an AOD (1/e^2 of the intensity at both "
        "ends), which smooths every jump of a tone (ours: 6 mm of slow TeO2)",
    )
    tone_response: Fraction = Field(
        default=0.0,
        lt=0.5,
        description="relative s.d. of the depth that each row's and each column's tone gives at the "
        "profile's amplitude, fixed for a seed. A calibration of amplitudes can equalise it (ours)",
    )
    row_tones: ToneComb | None = Field(
        default=None,
        description="tones that the machine really needs for its rows, whatever the profile says. Default "
        "the tones of the profile's grid (ours)",
    )
    column_tones: ToneComb | None = Field(default=None, description="the same for the columns (ours)")
    offset: tuple[Length, Length] = Field(
        default=(0.0, 0.0),
        description="[along a row, from row to row], displacement of the mobile tweezers from their intended "
        "sites, an error for a calibration to find (ours)",
    )
    magnification_error: float = Field(
        default=0.0,
        ge=-0.1,
        le=0.1,
        description="relative excess distance between mobile tweezers, as a fraction (ours)",
    )
    tone_error: NonNegativeLength = Field(
        default=0.0,
        description="s.d. of the position error of each row's and each column's tone, fixed for a seed, "
        "for a calibration to find (ours)",
    )


class LightSettings(Settings):
    """The lines of the profile that each kind of light needs, all of them at once."""

    loading: tuple[str, ...] = Field(default=(), description="lines without which no atoms load (ours)")
    cooling: tuple[str, ...] = Field(
        default=(), description="lines without which atoms heat up while they are moved (ours)"
    )
    imaging: tuple[str, ...] = Field(
        default=(), description="lines without which atoms do not fluoresce (ours)"
    )


TRANSITION_HZ = 6.83468261e9
"""The clock transition of rubidium 87 (Steck, Rubidium 87 D Line Data: 6.834 682 610 9 GHz)."""


class QubitSettings(Settings):
    """The two levels of each atom, with their drive, their decay, and the light that removes atoms."""

    drive: str = Field(default="microwave", description="line that switches the drive on")
    quadrature: str = Field(
        default="quadrature", description="line that adds the `shift` of the source to the phase of the drive"
    )
    push_out: str = Field(
        default="push_out",
        description="line that switches on the light that removes atoms in the upper level",
    )
    source: str = Field(
        default="synthesizer",
        description="device with the frequency and phase of the drive, a `virtual_synthesizer`. Without "
        "one the drive is on resonance",
    )
    transition: Annotated[Frequency, Field(gt=0)] = Field(
        default=TRANSITION_HZ,
        description="frequency of the transition (ours: the clock transition of rubidium 87, without shifts)",
    )
    rabi_frequency: Annotated[Frequency, Field(ge=0)] = Field(
        default=20e3, description="resonant Rabi frequency. A pi pulse takes half of its inverse (ours)"
    )
    relaxation_time: PositiveDuration = Field(
        default=20e-3, description="time constant T1 with which the populations become equal (ours)"
    )
    coherence_time: PositiveDuration = Field(
        default=1e-3, description="time constant T2 with which a superposition loses its phase (ours)"
    )
    detuning_spread: Annotated[Frequency, Field(ge=0)] = Field(
        default=0.0,
        description="s.d. of the transition's frequency from atom to atom and shot to shot, which an echo "
        "undoes (ours)",
    )
    preparation: Fraction = Field(
        default=0.99, description="probability of the lower level after loading, imaging and cooling (ours)"
    )
    push_out_time: PositiveDuration = Field(
        default=5e-6, description="time constant with which push-out light removes atoms (ours)"
    )
    push_out_time_other: PositiveDuration = Field(
        default=5e-3, description="time constant with which it also removes atoms in the lower level (ours)"
    )

    @property
    def lines(self) -> tuple[str, ...]:
        """The lines that act on the atoms, if the profile has them."""
        return self.drive, self.quadrature, self.push_out

    @property
    def required_lines(self) -> tuple[str, ...]:
        """The lines that the profile names and must have."""
        return tuple(getattr(self, key) for key in ("drive", "quadrature", "push_out") if self.is_given(key))

    def is_given(self, key: str) -> bool:
        """Whether the profile itself contains a setting."""
        return key in self.model_fields_set


class SimulationSettings(Settings):
    """Atoms and light of the simulation."""

    loading: Fraction = Field(
        default=0.75,
        description="probability that a site holds an atom after a long loading (paper: 75 to 78 %)",
    )
    loading_time: PositiveDuration = Field(
        default=50e-3,
        description="time constant of the loading (ours: a tenth of the paper's 500 ms)",
    )
    lifetime: PositiveDuration = Field(
        default=33.0, description="lifetime of an atom in a tweezer, cooled, exposures included (paper)"
    )
    imaging_loss: Fraction = Field(
        default=0.00314,
        lt=1,
        description="loss in one exposure of 45 ms besides the lifetime. Longer exposures have the same "
        "rate (derived: with the lifetime it gives the paper's survival of 99.55 %)",
    )
    imaging_loss_exposure: PositiveDuration = Field(
        default=45e-3, description="exposure for which the imaging loss is given (paper)"
    )
    transport_loss: Fraction = Field(
        default=0.0188,
        description="mean loss of a moved atom, in addition to losses from its motion in the light (derived: "
        "gives about the paper's filling of 97.66 % after one cycle at a degree of parallelism of 7)",
    )
    transport_loss_spread: NonNegativeFloat = Field(
        default=0.5,
        description="spread of the transport loss from shot to shot, s.d. of the logarithm of a log-normal "
        "factor with mean 1 (ours: independent losses would leave a third of the paper's defect-free shots "
        "after one cycle)",
    )
    machine_seed: Annotated[int, Field(ge=0, lt=2**63)] | None = Field(
        default=None,
        description="seed of the machine's properties, such as depths, errors of tones and the camera's "
        "patterns. Default the seed of the run. Calibrations are valid for one machine only (ours)",
    )
    record_truth: bool = Field(
        default=False,
        description="record the true atoms in each exposure, as the table `atom_events/atoms` "
        "of each shot (ours)",
    )
    depth_disorder: Fraction = Field(
        default=0.04,
        description="relative s.d. of the static tweezers' own depths, fixed for a seed (paper)",
    )
    tone_response: Fraction = Field(
        default=0.0,
        lt=0.5,
        description="relative s.d. of the depth that each row's and each column's tone of the static "
        "tweezers gives at equal amplitude, fixed for a seed. A calibration can equalise it (ours)",
    )
    static_depth: PositiveTemperature = Field(
        default=300e-6, description="mean depth of the static tweezers (paper)"
    )
    static_waist: PositiveLength = Field(
        default=0.98e-6, description="1/e^2 radius of the static tweezers' intensity (paper)"
    )
    static_wavelength: PositiveLength = Field(default=808e-9, description="static wavelength (paper)")
    temperature: PositiveTemperature = Field(
        default=15e-6,
        description="temperature of the atoms in the static tweezers, at most half of `static_depth` (ours: "
        "typical of gray molasses)",
    )
    scattering_rate: NonNegativeFloat = Field(
        default=33e3,
        description="photons that an atom scatters per second of an exposure. Their recoil heats it, while "
        "the light also cools (derived from 60 photoelectrons in 45 ms: an NA of 0.5 collects 6.7 %, of "
        "which optics and sensor count 60 %, ours)",
    )
    cooling_time: PositiveDuration = Field(
        default=1e-3,
        description="time constant with which the cooling light brings atoms back to `temperature` (ours)",
    )
    pair_survival: Fraction | None = Field(
        default=None,
        description="probability that collisions in the cooling light leave one of two atoms that come into "
        "one tweezer. Default 2 - 1 / `loading`, at least 0 (derived: loading ends with such collisions). "
        "Without cooling light both are lost in the next exposure",
    )
    intensity_noise: NonNegativeFloat = Field(
        default=0.0,
        description="power spectral density of the relative noise of the tweezers' intensity at twice the "
        "trap frequency, in 1/Hz, which heats atoms that are not cooled (ours)",
    )
    mobile_light: MobileLightSettings = Field(
        default=MobileLightSettings(), description="the mobile tweezers' light"
    )
    lights: LightSettings = Field(
        default=LightSettings(), description="lines that each kind of light needs (default: always on)"
    )
    qubit: QubitSettings = Field(
        default=QubitSettings(), description="the two levels of the atoms, and their drive and decay"
    )
    image: ImageSettings = Field(default=ImageSettings(), description="the images of the atoms' camera")
    tweezer_image: TweezerImageSettings = Field(
        default=TweezerImageSettings(),
        description="the images of a device with `role: camera`, which sees the light of the tweezers",
    )

    @model_validator(mode="after")
    def _holds_atoms(self) -> Self:
        if self.temperature > self.static_depth / 2:
            hot, depth = (format_quantity(k, "temperature") for k in (self.temperature, self.static_depth))
            text = f"temperature is {hot}, too hot for tweezers with a static_depth of {depth}"
            raise ValueError(f"{text}; expected at most half of it, because hotter atoms evaporate")
        return self


class CameraFaults(Settings):
    """Simulated failures. None by default."""

    transient: Fraction = Field(
        default=0.0,
        description="probability that a frame is lost with an error after which the shot is repeated",
    )
    missed_trigger: Fraction = Field(
        default=0.0, description="probability that a trigger is missed, so that no frame comes"
    )
    lost_in_series: Fraction = Field(
        default=0.0,
        description="probability that a frame never comes, which the number of the next frame shows",
    )
    late: Fraction = Field(default=0.0, description="probability that a frame comes late")
    late_by: Duration = Field(default=2.0, description="delay of a late frame")


class CameraSettings(camera.CameraSettings):
    """The virtual camera. The simulation has the settings of its images."""

    readout: Duration = Field(
        default=5e-3,
        description="time from the end of an exposure until its frame can be read, for the whole sensor "
        "without binning (ours)",
    )
    em_gain: float | None = Field(
        default=None,
        ge=1,
        le=1000,
        description="mean gain of the EM register in a series, 1 between series. Default the simulation's "
        "`image.em_gain` at all times",
    )
    cooling: Cooling | None = Field(
        default=None, description="target temperature before the first shot (default: no cooling)"
    )
    faults: CameraFaults = Field(default=CameraFaults(), description="simulated failures")


class StaticTweezersSettings(Settings):
    """The virtual static tweezers have no settings. The simulation sets their depth and light."""


class MobileTweezersSettings(Settings):
    """The virtual mobile tweezers."""

    band_centre: Frequency = Field(default=100e6, description="middle of the AOD's band (ours)")
    band_half_width: Annotated[Frequency, Field(gt=0)] = Field(
        default=18e6, description="half width of the AOD's band (ours: about 36 MHz in all)"
    )


class DeviceSettings(Settings):
    """A virtual instrument. In a dry run it replaces an instrument whose driver has no simulator."""

    commands: tuple[str, ...] = Field(default=(), description="names of its commands (default: any)")
    values: dict[str, bool | int | float | str] = Field(
        default={}, description="values that can be read, as name -> initial value"
    )


class LinesSettings(Settings):
    """A virtual timing box."""

    n_channels: PositiveInt = Field(default=32, description="number of outputs, counted from 0 (ours)")
    resolution: Duration = Field(default=0.0, description="step of its clock, or 0 for any time (ours)")
    shortest: Duration = Field(default=1e-6, description="shortest time between two edges (ours)")
    max_edges: PositiveInt = Field(default=1000, description="maximum number of edges of a program (ours)")


class SynthesizerSettings(Settings):
    """A virtual synthesizer, which drives the two levels of the virtual atoms."""

    frequency: Annotated[Frequency, Field(gt=0)] = Field(
        default=TRANSITION_HZ,
        description="frequency until it is set (ours: the clock transition of rubidium 87)",
    )
    phase: Angle = Field(default=0.0, description="phase until it is set")
    shift: Angle = Field(
        default=math.pi / 2,
        description="phase that a line adds, until it is set, see `qubit.quadrature` of the "
        "simulation (ours)",
    )


class SpotMeterSettings(Settings):
    """A virtual camera on the static tweezers' own light."""

    noise: Fraction = Field(
        default=0.02,
        description="relative s.d. of one measurement of one spot (ours)",
    )
