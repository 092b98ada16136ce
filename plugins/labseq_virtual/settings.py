"""Settings of the virtual lab; each field says where its default comes from.

"Paper" is Tian et al., "Parallel assembly of arbitrary defect-free atom arrays
with a multi-tweezer algorithm"; "derived" is worked out from it; "ours" is a
choice where it is silent.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

import labseq
from labseq.plugin import (
    CoolingSettings,
    Duration,
    Fraction,
    Frequency,
    Length,
    Settings,
    Temperature,
    Voltage,
    format_quantity,
)
from labseq_virtual.image_settings import ImageSettings

PositiveDuration = Annotated[Duration, Field(gt=0)]
PositiveLength = Annotated[Length, Field(gt=0)]
PositiveTemperature = Annotated[Temperature, Field(gt=0)]
NonNegativeLength = Annotated[Length, Field(ge=0)]
NonNegativeTemperature = Annotated[Temperature, Field(ge=0)]


class MobileLightSettings(Settings):
    """The light of the mobile tweezers."""

    depth: PositiveTemperature = Field(
        default=2.1e-3, description="depth of a tweezer whose two tones have the amplitude meant (paper)"
    )
    waist: PositiveLength = Field(default=0.98e-6, description="1/e^2 radius of the intensity (paper)")
    wavelength: PositiveLength = Field(default=852e-9, description="wavelength (paper)")
    transit_time: Annotated[Duration, Field(ge=1e-6, le=50e-6)] = Field(
        default=10e-6,
        description="time that the sound takes across the beam in an AOD (1/e^2 of the intensity at both "
        "ends): every jump of a tone is as soft as this (ours: 6 mm of slow TeO2)",
    )
    tone_voltage: Annotated[Voltage, Field(gt=0)] | None = Field(
        default=None,
        description="peak voltage of a tone at the driver's output that gives the depth (ours; none: that "
        "of the profile, `rf.full_scale` times the site's preassigned amplitude or over its axis' tones)",
    )
    offset: tuple[Length, Length] = Field(
        default=(0.0, 0.0),
        description="[along a row, from row to row]: how far the mobile tweezers stand beside the sites that "
        "they are meant for, an error for a calibration to find (ours)",
    )
    magnification_error: float = Field(
        default=0.0,
        ge=-0.1,
        le=0.1,
        description="how much further apart than meant the mobile tweezers stand, as a fraction; likewise "
        "(ours)",
    )
    tone_error: NonNegativeLength = Field(
        default=0.0,
        description="s.d. of the place of each row's and each column's tone about the one meant, fixed for a "
        "seed; likewise (ours)",
    )
    depth_drop_per_tone: Fraction = Field(
        default=0.0,
        description="the depth is divided by 1 plus this for each tone on beyond one per axis (ours; the "
        "paper sees a drop and gives no number). Drivers whose outputs are heard make their own",
    )
    intermodulation: Fraction = Field(
        default=0.02,
        description="relative s.d. of the depths of 20 tweezers in a line; that of n goes as the root of "
        "n - 1 (paper: 2 %; the law is ours)",
    )
    adiabatic_depth: NonNegativeTemperature = Field(
        default=0.0,
        description="least depth of a tweezer that carries its atom at 130 um/ms; it goes as the speed "
        "squared (ours; the paper suspects such a depth, passed at 13 tweezers; 0: there is none). For "
        "drivers that are taken at their word; where outputs are heard, the atoms fly",
    )
    shallow_loss: Fraction = Field(
        default=0.0, description="loss in tweezers that are shallower than that (ours)"
    )


class LightSettings(Settings):
    """Which lines of the profile each kind of light needs, all of them at once."""

    loading: tuple[str, ...] = Field(default=(), description="lines without which no atoms load (ours)")
    cooling: tuple[str, ...] = Field(
        default=(), description="lines without which atoms heat up while they are moved (ours)"
    )
    imaging: tuple[str, ...] = Field(default=(), description="lines without which atoms do not shine (ours)")


class WorldSettings(Settings):
    """The virtual lab's atoms and light."""

    loading: Fraction = Field(
        default=0.75,
        description="probability that a site holds an atom after a long loading (paper: 75 to 78 %)",
    )
    loading_time: PositiveDuration = Field(
        default=50e-3,
        description="time constant of the loading (ours: the paper's 500 ms are ten of them)",
    )
    lifetime: PositiveDuration = Field(
        default=33.0, description="lifetime of an atom in a tweezer, cooled, exposures included (paper)"
    )
    imaging_loss: Fraction = Field(
        default=0.00314,
        lt=1,
        description="loss in one exposure of 45 ms beside the lifetime's; longer ones lose at the same rate "
        "(derived: with the lifetime it gives the paper's survival of 99.55 %)",
    )
    imaging_loss_exposure: PositiveDuration = Field(
        default=45e-3, description="exposure that the imaging loss belongs to (paper)"
    )
    transport_loss: Fraction = Field(
        default=0.0188,
        description="mean loss of an atom that is picked up, moved and dropped, at the nominal depths; it "
        "goes as the mobile depth over the static one (derived: gives about the paper's filling of 97.66 % "
        "after one cycle at a degree of parallelism of 7; the law is ours)",
    )
    transport_loss_per_tone: Fraction = Field(
        default=0.0,
        description="added to it for each tone on beyond one per axis (ours; the paper sees more loss with "
        "more tones and gives no number)",
    )
    transport_loss_spread: NonNegativeFloat = Field(
        default=0.5,
        description="spread of the transport loss from shot to shot: s.d. of the logarithm of a log-normal "
        "factor with mean 1 (ours: independent losses would leave a third of the paper's defect-free shots "
        "after one cycle)",
    )
    uncooled_transport: Annotated[float, Field(ge=1)] = Field(
        default=3.0,
        description="transport loss without cooling light, relative to that with it (ours; where lines "
        "switch the light)",
    )
    machine_seed: Annotated[int, Field(ge=0, lt=2**63)] | None = Field(
        default=None,
        description="seed of what does not change from run to run: depths, errors of tones, the camera's own "
        "patterns; none: the seed of the run. Calibrations hold for one machine only (ours)",
    )
    depth_disorder: Fraction = Field(
        default=0.04,
        description="relative s.d. of the static tweezers' own depths, fixed for a seed (paper)",
    )
    tone_response: Fraction = Field(
        default=0.0,
        lt=0.5,
        description="relative s.d. of the depth that each row's and each column's tone of the static "
        "tweezers gives at equal amplitude, fixed for a seed: what a calibration can equalise (ours)",
    )
    static_depth: PositiveTemperature = Field(
        default=300e-6, description="mean depth of the static tweezers (paper)"
    )
    static_waist: PositiveLength = Field(
        default=0.98e-6, description="1/e^2 radius of their intensity (paper)"
    )
    static_wavelength: PositiveLength = Field(default=808e-9, description="their wavelength (paper)")
    temperature: PositiveTemperature = Field(
        default=15e-6,
        description="temperature of the atoms in the static tweezers, at most half of `static_depth` (ours: "
        "typical of gray molasses)",
    )
    mobile_light: MobileLightSettings = Field(
        default=MobileLightSettings(), description="the mobile tweezers' light"
    )
    lost_below_depth: Fraction = Field(
        default=0.1,
        description="fraction of the nominal depth below which a static tweezer loses its atom and loads "
        "none (ours)",
    )
    site_tolerance: float = Field(
        default=0.25,
        gt=0,
        lt=0.5,
        description="distance, in sites along each axis, within which a mobile tweezer that passes hits an "
        "atom, and is the same tweezer in the next segment (ours: the waist is 0.22 sites)",
    )
    on_amplitude: float = Field(
        default=1e-3,
        gt=0,
        lt=1,
        description="amplitude, as a fraction of full scale, above which a tone makes light (ours)",
    )
    lights: LightSettings = Field(
        default=LightSettings(), description="which lines each kind of light needs; none: it is always on"
    )
    image: ImageSettings = Field(default=ImageSettings(), description="what the camera sees")

    @model_validator(mode="after")
    def _holds_atoms(self) -> Self:
        if self.temperature > self.static_depth / 2:
            hot, depth = (format_quantity(k, "temperature") for k in (self.temperature, self.static_depth))
            text = f"temperature is {hot}, too hot for tweezers with a static_depth of {depth}"
            raise ValueError(f"{text}; expected at most half of it: hotter atoms evaporate")
        return self


class CameraFaults(Settings):
    """Failures to rehearse; none by default."""

    transient: Fraction = Field(
        default=0.0,
        description="probability that a frame is lost with an error that a repeated shot may mend",
    )
    missed_trigger: Fraction = Field(
        default=0.0, description="probability that a trigger is not seen, so that no frame comes"
    )
    lost_in_series: Fraction = Field(
        default=0.0,
        description="probability that a frame never comes, which the number of the next one tells",
    )
    late: Fraction = Field(default=0.0, description="probability that a frame comes late")
    late_by: Duration = Field(default=2.0, description="how late it comes then")


class CameraSettings(labseq.CameraSettings):
    """The virtual camera; what it sees is set in the simulation."""

    readout: Duration = Field(
        default=5e-3,
        description="time from the end of an exposure until its frame can be read, for the whole sensor "
        "without binning (ours)",
    )
    em_gain: float | None = Field(
        default=None,
        ge=1,
        le=1000,
        description="mean gain of the EM register in a series, 1 between them; none: the simulation's "
        "`image.em_gain` at all times",
    )
    cooling: CoolingSettings | None = Field(
        default=None, description="how cold the sensor is before the first shot; none: it is not cooled"
    )
    faults: CameraFaults = Field(default=CameraFaults(), description="failures to rehearse")


class StaticTweezersSettings(Settings):
    """The virtual static tweezers."""

    max_depth: PositiveFloat = Field(
        default=1.5, description="greatest depth, as a fraction of the nominal depth (ours)"
    )
    max_amplitude_sum: PositiveFloat = Field(
        default=1.0,
        description="greatest sum of the tones' amplitudes on an axis, as a fraction of full scale",
    )


class MobileTweezersSettings(Settings):
    """The virtual mobile tweezers."""

    band_centre: Frequency = Field(default=100e6, description="middle of the AOD's band (ours)")
    band_half_width: Annotated[Frequency, Field(gt=0)] = Field(
        default=18e6, description="reach of the AOD's band to each side (ours: about 36 MHz in all)"
    )
    max_amplitude_sum: PositiveFloat = Field(
        default=1.0,
        description="greatest sum of the tones' amplitudes on an axis, as a fraction of full scale: above "
        "it the output clips",
    )


class DeviceSettings(Settings):
    """A virtual instrument; also the stand-in for one whose driver is missing."""

    commands: tuple[str, ...] = Field(
        default=(), description="names of the commands that it knows; none: it accepts every command"
    )
    values: dict[str, bool | int | float | str] = Field(
        default={}, description="values that it can be asked for: name -> value at the start"
    )


class LinesSettings(Settings):
    """A virtual timing box."""

    n_channels: PositiveInt = Field(default=32, description="number of outputs, counted from 0 (ours)")
    resolution: Duration = Field(default=0.0, description="step of its clock; 0 for any time (ours)")
    shortest: Duration = Field(default=1e-6, description="least time between two edges (ours)")
    max_edges: PositiveInt = Field(default=1000, description="most edges of a program (ours)")


class SpotMeterSettings(Settings):
    """A virtual camera on the static tweezers' own light."""

    noise: Fraction = Field(
        default=0.02,
        description="relative s.d. of one measurement of one spot (ours)",
    )
    duration: Duration = Field(default=20e-3, description="time of a measurement (ours)")
