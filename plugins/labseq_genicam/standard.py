"""Settings of a camera, in the order of the GenICam Standard Features Naming Convention (SFNC).

The names of older cameras follow the standard names.
"""

from __future__ import annotations

from typing import Any, Final

from labseq.plugin import DeviceError, LimitError, Trigger, format_quantity
from labseq.plugin.camera import Series, nearest
from labseq.plugin.messages import one_of
from labseq.plugin.units import ZERO_CELSIUS_K
from labseq_genicam.features import Features
from labseq_genicam.settings import BITS, StandardSettings

EXPOSURE_TIME: Final = ("ExposureTime", "ExposureTimeAbs")
FRAME_RATE: Final = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
WIDTH: Final = "TriggerWidth"
"""Exposure mode in which the trigger's width is the exposure."""

SERIES: Final = {
    "FrameBurstStart": "AcquisitionBurstFrameCount",
    "AcquisitionStart": "AcquisitionFrameCount",
}
"""Triggers that start a series, each with the feature for its number of frames. The camera's first one is
used."""

TIMED_BY_CAMERA: Final = frozenset[Trigger]({"internal", "external_start"})
"""Triggers with which the camera starts exposures by itself."""

ROUNDING: Final = 1e-6


def set_up(
    features: Features, settings: StandardSettings, sensor_shape: tuple[int, int] | None
) -> dict[str, Any]:
    """Set everything that stays the same from series to series, whatever state the camera is in.

    Args:
        features: Features of the camera.
        settings: Settings of the driver.
        sensor_shape: (height, width) of the sensor, None for the camera's report.

    Returns:
        The resulting settings, JSON-ready.
    """
    for auto in ("ExposureAuto", "GainAuto", "AcquisitionFrameRateAuto"):
        features.choose_if_offered(auto, "Off")
    features.choose_if_offered("ExposureMode", "Timed")
    _limit_frame_rate(features, is_on=False)
    _check_line_trigger(features, settings)
    reported = _set_image_format(features, settings, sensor_shape)
    if settings.gain is not None:
        gain = features.get("gain in its unit", "Gain", hint="use `gain_raw`, or leave out `gain`")
        features.set_float("gain", gain, settings.gain)
    if settings.gain_raw is not None:
        gain = features.get("gain in steps", "GainRaw", hint="use `gain`")
        features.set_integer("gain_raw", gain, settings.gain_raw)
    exposure = features.get("exposure time", *EXPOSURE_TIME, hint="use a camera whose exposures can be timed")
    return {
        **reported,
        "gain_now": features.read(float, "Gain"),
        "gain_raw_now": features.read(int, "GainRaw"),
        "exposure_bounds_s": [1e-6 * bound for bound in features.float_bounds(exposure)],
        "sensor_readout_s": _seconds(features.read(float, "SensorReadoutTime", "ReadoutTimeAbs")),
    }


# device control


def temperature_k(features: Features) -> float | None:
    """Temperature of camera or sensor, whichever is selected, in kelvins, None without a thermometer."""
    celsius = features.read(float, "DeviceTemperature", "TemperatureAbs")
    return None if celsius is None else round(celsius + ZERO_CELSIUS_K, 2)


# image format control


def _set_image_format(
    features: Features, settings: StandardSettings, sensor_shape: tuple[int, int] | None
) -> dict[str, Any]:
    """Set order of rows and columns, pixel format, binning and region."""
    for feature in ("ReverseX", "ReverseY"):  # images are turned in labseq
        features.switch(feature, is_on=False)
    pixel_format = _set_pixel_format(features, settings)
    _set_binning(features, 1)  # some cameras report the sensor in binned pixels
    if sensor_shape is None:
        rows, columns = (features.read(int, f"Sensor{size}", f"{size}Max") for size in ("Height", "Width"))
        sensor_shape = rows or 0, columns or 0
    y, x, height, width = settings.region_on(sensor_shape, features.name)
    for offset in filter(features.find, ("OffsetY", "OffsetX")):  # they limit the sizes
        features.set_integer("start of the region", offset, 0)
    _set_binning(features, settings.binning)
    n_rows = _set_axis(features, settings, "Y", y, height)
    n_columns = _set_axis(features, settings, "X", x, width)
    shape = settings.orientation.shape((n_rows, n_columns))
    return {"sensor_shape": list(sensor_shape), "frame_shape": list(shape), "pixel_format": pixel_format}


def _set_binning(features: Features, binning: int) -> None:
    for feature in ("BinningVertical", "BinningHorizontal"):
        if binning > 1 or features.find(feature):
            feature = features.get("binning", feature, hint="leave out `binning`")
            features.set_integer("binning", feature, binning)
            features.choose_if_offered(f"{feature}Mode", "Sum")


def _set_axis(features: Features, settings: StandardSettings, axis: str, start: int, extent: int) -> int:
    """Set size and start of the region along an axis. Returns its number of pixels in a frame."""
    binning, size, offset = settings.binning, {"Y": "Height", "X": "Width"}[axis], f"Offset{axis}"
    n_pixels = extent // binning
    if settings.region is None:
        n_pixels = nearest(n_pixels, *features.integer_bounds(size))
    features.set_integer(f"region's {size.lower()}", size, n_pixels * binning, binning)
    if start or features.find(offset):
        hint = f"begin the region at {axis.lower()}: 0"
        offset = features.get("start of the region", offset, hint=hint)
        features.set_integer(f"region's {axis.lower()}", offset, start, binning)
    return n_pixels


def _set_pixel_format(features: Features, settings: StandardSettings) -> str:
    offered = features.options("PixelFormat")
    wanted = settings.pixel_format or next((name for name in BITS if name in offered), one_of(list(BITS)))
    features.choose("pixel format", "PixelFormat", wanted)
    return wanted


# acquisition control


def series_trigger(features: Features) -> str:
    """The trigger of a camera that starts a series, empty if it has none."""
    offered = features.options("TriggerSelector")
    return next((trigger for trigger in SERIES if trigger in offered), "")


def _check_line_trigger(features: Features, settings: StandardSettings) -> None:
    kind, missing = settings.line_trigger, ""
    if kind == "external_start" and not series_trigger(features):
        missing = f"starts no series by a trigger ({one_of(list(SERIES))})"
    elif kind == "bulb" and WIDTH not in features.options("ExposureMode"):
        missing = f"has no exposure mode {WIDTH}"
    if missing:
        raise DeviceError(features.name, f"the camera {missing}; leave out `line_trigger: {kind}`")


def set_trigger(features: Features, settings: StandardSettings, trigger: Trigger, n_frames: int) -> None:
    """Choose the trigger of the exposures of a series."""
    features.choose_if_offered("AcquisitionMode", "Continuous")
    _limit_frame_rate(features, is_on=False)
    features.choose_if_offered("TriggerMode", "Off")  # a camera with one trigger has no selector
    for selector in features.options("TriggerSelector"):  # they act together unless they are off
        features.choose_if_offered("TriggerSelector", selector)
        features.choose_if_offered("TriggerMode", "Off")
    features.choose_if_offered("ExposureMode", WIDTH if trigger == "bulb" else "Timed")
    if trigger == "bulb":
        _shorten_overlap(features)
    if trigger == "external_start":
        _choose_trigger(features, settings, series_trigger(features), settings.trigger_line)
        _set_number_of_frames(features, n_frames)
    elif trigger != "internal":
        source = "Software" if trigger == "software" else settings.trigger_line
        _choose_trigger(features, settings, "FrameStart", source)


def _limit_frame_rate(features: Features, *, is_on: bool) -> None:
    """Switch the frame rate on or off. While it is on, it limits the exposure time."""
    for feature in ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled"):
        features.switch(feature, is_on=is_on)


def _shorten_overlap(features: Features) -> None:
    """Allow short pulses, since Basler cameras need pulses longer than the overlap with the read-out."""
    if feature := features.find("ExposureOverlapTimeMax", "ExposureOverlapTimeMaxAbs"):
        features.set_float("overlap of exposures", feature, features.float_bounds(feature)[0])


def _choose_trigger(features: Features, settings: StandardSettings, selector: str, source: str) -> None:
    features.choose_if_offered("TriggerSelector", selector)
    features.choose("trigger source", "TriggerSource", source)
    if source != "Software":
        edge = {"rising": "RisingEdge", "falling": "FallingEdge"}[settings.trigger_edge]
        features.choose("trigger edge", "TriggerActivation", edge)
    features.choose("trigger mode", "TriggerMode", "On")


def _set_number_of_frames(features: Features, n_frames: int) -> None:
    """Set how many exposures follow the edge that starts a series."""
    selector = series_trigger(features)
    if selector == "AcquisitionStart":
        features.choose_if_offered("AcquisitionMode", "MultiFrame")
    hint = "leave out `line_trigger: external_start`"
    count = features.get("number of frames of a start", SERIES[selector], hint=hint)
    features.set_integer("number of frames", count, n_frames)


def set_exposure(features: Features, exposure_s: float) -> float:
    """Set the exposure time, and return the time that the camera makes, in seconds."""
    feature = features.find(*EXPOSURE_TIME)
    return 1e-6 * features.set_float("exposure", feature, 1e6 * exposure_s, _microseconds)


def read_exposure_s(features: Features) -> float | None:
    """The exposure time that is set, in seconds."""
    return _seconds(features.read(float, *EXPOSURE_TIME))


def frame_period_s(features: Features, settings: StandardSettings, series: Series, trigger: Trigger) -> float:
    """Time from one exposure to the next in a series that the camera times, in seconds.

    The camera is set to it, unless it is triggered in another way, as a simulated camera is.
    """
    setting, wanted_hz = "frame_rate", settings.frame_rate
    if series.trigger == "external_start":
        setting, wanted_hz = "line_trigger: external_start", 1.0 / (settings.cycle_time or 1.0)
    natural_s = series.exposure_s + settings.readout
    _limit_frame_rate(features, is_on=trigger in TIMED_BY_CAMERA)
    if not (feature := features.find(*FRAME_RATE)):
        if wanted_hz is None:
            return natural_s
        text = f"the frame rate of the camera cannot be set; leave out `{setting}`"
        raise DeviceError(features.name, text)
    low_hz, high_hz = features.float_bounds(feature)
    rate_hz = wanted_hz or min(max(1.0 / natural_s, low_hz), high_hz)
    high_hz = min(high_hz, 1.0 / series.exposure_s)
    if not low_hz <= rate_hz <= high_hz * (1.0 + ROUNDING):
        limit = f"{low_hz:g} to {high_hz:g} per second at this exposure"
        raise LimitError(f"{features.name}: frame rate", f"{rate_hz:g}", limit)
    rate_hz = min(rate_hz, high_hz)
    if trigger in TIMED_BY_CAMERA:
        rate_hz = features.set_float("frame rate", feature, rate_hz)
    return 1.0 / rate_hz


def _microseconds(value: float) -> str:
    return format_quantity(1e-6 * value, "time")


def _seconds(microseconds: float | None) -> float | None:
    return None if microseconds is None else 1e-6 * microseconds
