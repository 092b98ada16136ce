"""What is set once, when a camera is opened: amplifier and speeds, cooler, region, EM gain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from labseq.plugin import ConfigError, DeviceError, format_quantity
from labseq.plugin.messages import one_of
from labseq.plugin.units import ZERO_CELSIUS_K
from labseq_andor.codes import EM_GAIN_REAL, FULL_IMAGE, REAL_GAIN_MODE, AcqModes, Features, SetFunctions
from labseq_andor.sdk import Sdk
from labseq_andor.settings import HIGH_GAIN, AndorSettings

NEAR: Final = 0.02
"""Largest relative difference between a speed and the setting for it: the SDK gives speeds as float32."""


def set_up(sdk: Sdk, settings: AndorSettings, name: str) -> dict[str, Any]:
    """Set what stays the same in all series, with the shutter closed and without EM gain.

    Returns:
        What the camera reports about itself: JSON-ready values.

    Raises:
        DeviceError: Another model than the settings say, or a setting that the camera does not have.
        ConfigError: The region does not fit the sensor.
    """
    info = sdk.camera.device_info
    model = str(info.head_model)
    if not model.upper().startswith(settings.model.upper()):
        text = f"the connected camera is a {model}; expected a model that begins with {settings.model}"
        raise DeviceError(name, f"{text}; change `model`, or connect the other one")
    with sdk.selected() as lib:
        width, height = sdk.camera.get_detector_size()
        *_, version, build = lib.GetHardwareVersion()
    if conflict := settings.sensor_conflict((height, width)):
        raise ConfigError(f"{name}: {conflict}")
    facts: dict[str, Any] = {
        "model": model,
        "serial_number": str(info.serial_number),
        "firmware": f"{version}.{build}",
        "sdk_version": sdk.version(),
        "sensor_shape": [height, width],
    }
    with sdk.selected() as lib:
        facts |= _set_amplifier(sdk.camera, settings, name)
        facts |= _set_cooler(sdk, settings, name)
        _set_options(sdk, lib, settings, name)
        _set_region(sdk, lib, settings, (height, width), name)
        facts["em_gain_range"] = _set_gain_mode(sdk, lib, settings, name)
    return facts


def _set_amplifier(camera: Any, settings: AndorSettings, name: str) -> dict[str, Any]:
    """Choose amplifier, read-out rate, pre-amplifier gain and shift speed."""
    kind = "conventional" if settings.amplifier == "conventional" else "multiplying"
    all_modes = camera.get_all_amp_modes()
    modes = [mode for mode in all_modes if kind in str(mode.oamp_kind).lower()]
    if not modes:
        kinds = one_of(sorted({str(mode.oamp_kind) for mode in all_modes}))
        raise DeviceError(name, f"this camera has no amplifier of that kind; it has {kinds}")
    rates_hz = [float(mode.hsspeed_MHz) * 1e6 for mode in modes]
    wanted_hz = settings.readout_rate or max(rates_hz)
    rate_hz = _nearest(rates_hz, wanted_hz, "readout_rate", "frequency", name)
    modes = [mode for mode, its_hz in zip(modes, rates_hz, strict=True) if its_hz == rate_hz]
    gains = [float(mode.preamp_gain) for mode in modes]
    gain = _nearest(gains, settings.preamp_gain or gains[0], "preamp_gain", "", name)
    mode = modes[gains.index(gain)]
    camera.set_amp_mode(mode.channel, mode.oamp, mode.hsspeed, mode.preamp)
    shifts_us = [float(speed) for speed in camera.get_all_vsspeeds()]
    index = camera.get_max_vsspeed()
    if settings.vertical_shift_speed is not None:
        wanted_us = settings.vertical_shift_speed * 1e6
        index = shifts_us.index(_nearest(shifts_us, wanted_us, "vertical_shift_speed", "us", name))
    camera.set_vsspeed(index)
    return {
        "amplifier": str(mode.oamp_kind),
        "bit_depth": int(mode.channel_bitdepth),
        "readout_rate_hz": rate_hz,
        "preamp_gain": gain,
        "vertical_shift_s": shifts_us[index] * 1e-6,
    }


def _nearest(values: Sequence[float], wanted: float, setting: str, unit: str, name: str) -> float:
    best = min(values, key=lambda value: abs(value - wanted))
    if abs(best - wanted) <= NEAR * wanted:
        return best

    def format_value(value: float) -> str:
        if unit == "frequency":
            return format_quantity(float(f"{value:.3g}"), unit)
        return f"{value:.3g} {unit}".strip()

    offered = one_of(list(dict.fromkeys(format_value(value) for value in values)))
    text = f"`{setting}` is {format_value(wanted)}, which this camera does not have; it has {offered}"
    raise DeviceError(name, text)


def _set_cooler(sdk: Sdk, settings: AndorSettings, name: str) -> dict[str, Any]:
    if settings.cooling is None:
        return {}
    if not sdk.capabilities.ulSetFunctions & SetFunctions.TEMPERATURE:
        raise DeviceError(name, "this camera has no cooler; leave `cooling` out")
    wanted_c = round(settings.cooling.temperature_k - ZERO_CELSIUS_K)
    low_c, high_c = sdk.camera.get_temperature_range()
    if not low_c <= wanted_c <= high_c:
        text = f"cooling: temperature is {wanted_c} degC; this camera takes {low_c} to {high_c} degC"
        raise DeviceError(name, text)
    sdk.camera.set_temperature(wanted_c, enable_cooler=True)
    return {"setpoint_k": wanted_c + ZERO_CELSIUS_K}


def _set_options(sdk: Sdk, lib: Any, settings: AndorSettings, name: str) -> None:
    capabilities = sdk.capabilities
    if capabilities.ulSetFunctions & SetFunctions.BASELINECLAMP:
        lib.SetBaselineClamp(int(settings.baseline_clamp))
    if capabilities.ulFeatures & Features.METADATA:
        lib.SetMetaData(1)
    if capabilities.ulAcqModes & AcqModes.FRAMETRANSFER:
        sdk.camera.enable_frame_transfer_mode(settings.frame_transfer)
    elif settings.frame_transfer:
        raise DeviceError(name, "this camera has no frame transfer; leave `frame_transfer` out")
    sdk.camera.setup_ext_trigger(invert=settings.trigger_edge == "falling")
    if settings.fast_trigger:
        lib.SetFastExtTrigger(1)


def _set_region(
    sdk: Sdk, lib: Any, settings: AndorSettings, sensor_shape: tuple[int, int], name: str
) -> None:
    """Set region and binning; after frame transfer, which isolated crop needs."""
    y, x, height, width = settings.mode.region or (0, 0, *sensor_shape)
    binning = settings.binning
    lib.SetReadMode(FULL_IMAGE)
    lib.SetImage(binning, binning, x + 1, x + width, y + 1, y + height)
    if not settings.isolated_crop:
        return
    functions = sdk.capabilities.ulSetFunctions
    if functions & SetFunctions.EXTENDED_CROP_MODE:
        sdk.raw("SetIsolatedCropModeEx", 1, height, width, binning, binning, x + 1, y + 1)
    elif functions & SetFunctions.CROPMODE and (y, x) == (0, 0):
        sdk.raw("SetIsolatedCropMode", 1, height, width, binning, binning)
    else:
        text = "this camera cannot crop this region; with `isolated_crop` it must begin at y: 0, x: 0"
        raise DeviceError(name, f"{text}, if the camera has isolated crop at all")


def _set_gain_mode(sdk: Sdk, lib: Any, settings: AndorSettings, name: str) -> list[int] | None:
    """Choose the mode in which the EM gain is a factor; None for a camera or an amplifier without it."""
    capabilities = sdk.capabilities
    if settings.amplifier == "em" and capabilities.ulEMGainCapability & EM_GAIN_REAL:
        lib.SetEMGainMode(REAL_GAIN_MODE)
        if settings.em_gain > HIGH_GAIN and capabilities.ulSetFunctions & SetFunctions.EMADVANCED:
            lib.SetEMAdvanced(1)
        low, high = (int(value) for value in lib.GetEMGainRange())
        if settings.em_gain != 1 and not low <= settings.em_gain <= high:
            text = f"`em_gain` is {settings.em_gain}; this camera takes 1 (off) and {low} to {high}"
            raise DeviceError(name, text)
        return [low, high]
    if settings.em_gain > 1:
        raise DeviceError(name, "this camera has no EM gain that is set as a factor; leave `em_gain` out")
    return None
