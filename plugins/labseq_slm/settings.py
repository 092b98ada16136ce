"""Settings of the SLM."""

from __future__ import annotations

from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from labseq.plugin import Angle, Duration, FilePath, Fraction, Length, Settings, setting_error

PositiveLength: TypeAlias = Annotated[Length, Field(gt=0)]
PixelCount: TypeAlias = Annotated[int, Field(ge=64, le=4320)]


class ZernikeSettings(Settings):
    """Phases that correct aberrations, as r.m.s. of each Zernike mode over the circle within the pixels."""

    defocus: Angle = Field(default=0.0, description="term Z(2, 0)")
    oblique_astigmatism: Angle = Field(default=0.0, description="term Z(2, -2), axes at 45 degrees")
    vertical_astigmatism: Angle = Field(default=0.0, description="term Z(2, 2), axes along rows and columns")
    vertical_coma: Angle = Field(default=0.0, description="term Z(3, -1)")
    horizontal_coma: Angle = Field(default=0.0, description="term Z(3, 1)")
    vertical_trefoil: Angle = Field(default=0.0, description="term Z(3, -3)")
    oblique_trefoil: Angle = Field(default=0.0, description="term Z(3, 3)")
    spherical: Angle = Field(default=0.0, description="term Z(4, 0)")


class SimulatedErrors(Settings):
    """Errors of the simulated SLM that its driver does not know (ours)."""

    phase_range: Fraction = Field(
        default=0.08, description="fraction by which the largest phase exceeds that of the look-up table"
    )
    phase_curve: Angle = Field(
        default=0.25, description="amplitude of a further error of the phase, one period over all levels"
    )
    beam_waist: Fraction = Field(default=0.05, description="by how much the beam is wider than `beam_waist`")
    beam_shift: Length = Field(default=0.3e-3, description="how far the beam is to the right of the middle")
    aberration: ZernikeSettings = Field(
        default=ZernikeSettings(vertical_astigmatism=0.2, horizontal_coma=-0.15),
        description="phases that the optics add",
    )


class SlmSettings(Settings):
    """Static tweezers by a phase-only SLM in the back focal plane of a lens."""

    output: Literal["display", "file", "simulated"] = Field(
        default="display",
        description="where the grey levels go, either to a display of this computer, through the package "
        "`slmsuite`, to a PNG file that another program shows, or to a simulated SLM",
    )
    display: int = Field(default=1, ge=0, description="number of the display. 0 is usually the main screen")
    image: FilePath | None = Field(
        default=None, description="picture (PNG) for `output: file`, replaced at each change"
    )
    pixels: tuple[PixelCount, PixelCount] = Field(
        default=(1024, 1272), description="rows and columns of pixels"
    )
    pixel_pitch: PositiveLength = Field(default=12.5e-6, description="distance between neighbouring pixels")
    wavelength: PositiveLength = Field(default=808e-9, description="wavelength of the light")
    focal_length: PositiveLength = Field(
        default=15e-3,
        description="effective focal length from the SLM to the atoms, the objective's over the "
        "magnification of the telescope before it",
    )
    beam_waist: PositiveLength = Field(default=4.5e-3, description="1/e^2 radius of the light on the SLM")
    offset: tuple[Length, Length] = Field(
        default=(120e-6, 0.0),
        description="vector (x, y) from the zeroth order, which receives the light that is not diffracted, "
        "to the middle of the grid, in the atom plane",
    )
    rotation: Angle = Field(default=0.0, description="rotation of the pixels against the grid, clockwise")
    mirrored: bool = Field(default=False, description="whether the optics mirror left and right")
    look_up_table: FilePath | None = Field(
        default=None,
        description="file (.npy) of the phases of the grey levels 0 to 255, in rad. With none, they rise "
        "linearly by 2 pi / 256 from level to level",
    )
    correction: FilePath | None = Field(
        default=None,
        description="the manufacturer's correction of the surface, grey levels of all pixels, 256 for 2 pi, "
        "in a picture of 8 bits (PNG, BMP) or a .npy file, or none for a flat surface",
    )
    zernike: ZernikeSettings = Field(
        default=ZernikeSettings(), description="phases that are added to correct aberrations"
    )
    settle: Duration = Field(
        default=60e-3, description="time from new grey levels until the liquid crystal has followed"
    )
    errors: SimulatedErrors = Field(
        default=SimulatedErrors(), description="errors of the simulated SLM, see `output: simulated`"
    )

    @property
    def is_simulated(self) -> bool:
        """Whether the SLM exists only in software."""
        return self.output == "simulated"

    def identities(self) -> tuple[str, ...]:
        """Names of the SLM, which only one process can use."""
        places = {"display": f"display {self.display}", "file": f"image {self.image}"}
        return (places[self.output],) if self.output in places else ()

    @model_validator(mode="after")
    def _has_image(self) -> Self:
        if self.output == "file" and self.image is None:
            raise setting_error("`output: file` without a file", "`image: FILE.png`", at=("image",), key=True)
        return self
