"""Settings that are made once, when a camera is opened (amplifier, speeds, cooler, region, EM gain)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

from labseq.plugin import ConfigError, DeviceError, format_quantity
from labseq.plugin.messages import one_of
from labseq.plugin.units import ZERO_CELSIUS_K
from labseq_andor.codes import (
    EM_GAIN_REAL,
    FULL_IMAGE,
    REAL_GAIN_MODE,
    SDK_VERSION,
    AcqModes,
    Features,
    SetFunctions,
)
from labseq_andor.connection import AndorConnection
from labseq_andor.sdk import AndorSdk
from labseq_andor.settings import HIGH_GAIN

NEAR: Final = 0.02
"""Largest relative difference between a speed and its setting, since the SDK gives speeds as float32."""


def set_up(camera: AndorConnection) -> dict[str, Any]:
    """Set everything that stays the same in all series, with the shutter closed and without EM gain.

    Returns:
        The camera's report about itself, as JSON-ready values.

    Raises:
        DeviceError: Another model than the settings say, or a setting that the camera does not have.
        ConfigError: The region does not fit the sensor.
    """
    settings = camera.settings
    with camera.selected() as sdk:
        model = sdk.GetHeadModel()
        if not model.upper().startswith(settings.model.upper()):
            text = f"the connected camera is a {model}, but `model` is {settings.model}"
            raise DeviceError(camera.name, f"{text}; change `model`, or connect the other camera")
        width, height = sdk.GetDetector()
        if conflict := settings.sensor_conflict((height, width)):
            raise ConfigError(f"{camera.name}: {conflict}")
        *_, version, build = sdk.GetHardwareVersion()
        reported = {
            "model": model,
            "serial_number": str(camera.serial),
            "firmware": f"{version}.{build}",
            "sdk_version": sdk.GetVersionInfo(SDK_VERSION),
            "sensor_shape": [height, width],
            **_set_amplifier(sdk, camera),
            "vertical_shift_s": _set_shift(sdk, camera),
            "setpoint_k": _set_cooler(sdk, camera),
        }
        _set_options(sdk, camera)
        _set_region(sdk, camera, (height, width))
        return {**reported, "em_gain_range": _set_gain_mode(sdk, camera)}


@dataclass(frozen=True, slots=True)
class AmpMode:
    """A way to read the sensor, with the SDK's numbers for it.

    Attributes:
        channel: Number of the converter.
        amplifier: Number of the amplifier.
        rate: Number of the read-out rate.
        preamp: Number of the pre-amplifier's gain.
        rate_hz: Pixels per second.
        preamp_gain: Gain of the pre-amplifier.
    """

    channel: int
    amplifier: int
    rate: int
    preamp: int
    rate_hz: float
    preamp_gain: float


def _amp_modes(sdk: AndorSdk, amplifier: int) -> Iterator[AmpMode]:
    """The ways to read the sensor with an amplifier."""
    for channel in range(sdk.GetNumberADChannels()):
        rates, preamps = range(sdk.GetNumberHSSpeeds(channel, amplifier)), range(sdk.GetNumberPreAmpGains())
        for rate, preamp in product(rates, preamps):
            if sdk.IsPreAmpGainAvailable(channel, amplifier, rate, preamp):
                rate_hz = sdk.GetHSSpeed(channel, amplifier, rate) * 1e6
                yield AmpMode(channel, amplifier, rate, preamp, rate_hz, sdk.GetPreAmpGain(preamp))


def _set_amplifier(sdk: AndorSdk, camera: AndorConnection) -> dict[str, Any]:
    """Choose amplifier, read-out rate and pre-amplifier gain."""
    settings, name, functions = camera.settings, camera.name, camera.capabilities.ulSetFunctions
    kind = "conventional" if settings.amplifier == "conventional" else "multiplying"
    amplifiers = [sdk.GetAmpDesc(number) for number in range(sdk.GetNumberAmp())]
    number = next((n for n, described in enumerate(amplifiers) if kind in described.lower()), None)
    if number is None:
        text = f"this camera has no amplifier of that kind; it has {one_of(sorted(amplifiers))}"
        raise DeviceError(name, text)
    modes = list(_amp_modes(sdk, number))
    rates_hz = [mode.rate_hz for mode in modes]
    rate_hz = _nearest(rates_hz, settings.readout_rate or max(rates_hz), "readout_rate", "frequency", name)
    modes = [mode for mode in modes if mode.rate_hz == rate_hz]
    gains = [mode.preamp_gain for mode in modes]
    gain = _nearest(gains, settings.preamp_gain or gains[0], "preamp_gain", "", name)
    mode = modes[gains.index(gain)]
    sdk.SetADChannel(mode.channel)
    sdk.SetOutputAmplifier(mode.amplifier)
    if functions & SetFunctions.HREADOUT:
        sdk.SetHSSpeed(mode.amplifier, mode.rate)
    if functions & SetFunctions.PREAMPGAIN:
        sdk.SetPreAmpGain(mode.preamp)
    return {
        "amplifier": amplifiers[number],
        "bit_depth": sdk.GetBitDepth(mode.channel),
        "readout_rate_hz": rate_hz,
        "preamp_gain": gain,
    }


def _set_shift(sdk: AndorSdk, camera: AndorConnection) -> float:
    """Choose the time to shift the rows by one, and return it, in seconds."""
    wanted_s = camera.settings.vertical_shift_speed
    shifts_us = [sdk.GetVSSpeed(index) for index in range(sdk.GetNumberVSSpeeds())]
    index, shift_us = sdk.GetFastestRecommendedVSSpeed()
    if wanted_s is not None:
        shift_us = _nearest(shifts_us, wanted_s * 1e6, "vertical_shift_speed", "us", camera.name)
        index = shifts_us.index(shift_us)
    if camera.capabilities.ulSetFunctions & SetFunctions.VREADOUT:
        sdk.SetVSSpeed(index)
    return shift_us * 1e-6


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


def _set_cooler(sdk: AndorSdk, camera: AndorConnection) -> float | None:
    """Start to cool. Returns the temperature in kelvins, None if the cooler is left as it is."""
    cooling, name = camera.settings.cooling, camera.name
    if cooling is None:
        return None
    if not camera.capabilities.ulSetFunctions & SetFunctions.TEMPERATURE:
        raise DeviceError(name, "this camera has no cooler; leave `cooling` out")
    wanted_c = round(cooling.temperature_k - ZERO_CELSIUS_K)
    low_c, high_c = sdk.GetTemperatureRange()
    if not low_c <= wanted_c <= high_c:
        text = f"cooling: temperature is {wanted_c} degC; this camera takes {low_c} to {high_c} degC"
        raise DeviceError(name, text)
    sdk.SetTemperature(wanted_c)
    sdk.CoolerON()
    return wanted_c + ZERO_CELSIUS_K


def _set_options(sdk: AndorSdk, camera: AndorConnection) -> None:
    settings, capabilities = camera.settings, camera.capabilities
    if capabilities.ulSetFunctions & SetFunctions.BASELINECLAMP:
        sdk.SetBaselineClamp(int(settings.baseline_clamp))
    if capabilities.ulFeatures & Features.METADATA:
        sdk.SetMetaData(1)
    if capabilities.ulAcqModes & AcqModes.FRAMETRANSFER:
        sdk.SetFrameTransferMode(int(settings.frame_transfer))
    elif settings.frame_transfer:
        text = "this camera has no frame transfer; leave `frame_transfer` out"
        raise DeviceError(camera.name, text)
    if settings.trigger_edge == "falling":
        sdk.SetTriggerInvert(1)
    if settings.fast_trigger:
        sdk.SetFastExtTrigger(1)


def _set_region(sdk: AndorSdk, camera: AndorConnection, sensor_shape: tuple[int, int]) -> None:
    """Set region and binning, after frame transfer, which isolated crop needs."""
    settings, functions = camera.settings, camera.capabilities.ulSetFunctions
    binning, (y, x, height, width) = settings.binning, settings.mode.region or (0, 0, *sensor_shape)
    sdk.SetReadMode(FULL_IMAGE)
    sdk.SetImage(binning, binning, x + 1, x + width, y + 1, y + height)
    if not settings.isolated_crop:
        return
    if functions & SetFunctions.EXTENDED_CROP_MODE:
        sdk.SetIsolatedCropModeEx(1, height, width, binning, binning, x + 1, y + 1)
    elif functions & SetFunctions.CROPMODE and (y, x) == (0, 0):
        sdk.SetIsolatedCropMode(1, height, width, binning, binning)
    else:
        text = "this camera cannot crop this region; with `isolated_crop` it must begin at y: 0, x: 0"
        raise DeviceError(camera.name, f"{text}, if the camera has isolated crop at all")


def _set_gain_mode(sdk: AndorSdk, camera: AndorConnection) -> list[int] | None:
    """Choose the mode in which the EM gain is a factor. None for a camera or an amplifier without it."""
    settings, name, capabilities = camera.settings, camera.name, camera.capabilities
    if settings.amplifier == "em" and capabilities.ulEMGainCapability & EM_GAIN_REAL:
        sdk.SetEMGainMode(REAL_GAIN_MODE)
        sdk.SetEMCCDGain(0)
        if settings.em_gain > HIGH_GAIN and capabilities.ulSetFunctions & SetFunctions.EMADVANCED:
            sdk.SetEMAdvanced(1)
        low, high = sdk.GetEMGainRange()
        if settings.em_gain != 1 and not low <= settings.em_gain <= high:
            text = f"`em_gain` is {settings.em_gain}; this camera takes 1 (off) and {low} to {high}"
            raise DeviceError(name, text)
        return [low, high]
    if settings.em_gain > 1:
        raise DeviceError(name, "this camera has no EM gain that is set as a factor; leave `em_gain` out")
    return None
