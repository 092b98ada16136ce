"""Static tweezers equalised on the virtual lab, from the run to the entry in use."""

from __future__ import annotations

import io
import os
import pty
import sys
import threading
import tty
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labseq_slm.static_tweezers import SlmStaticTweezers
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from numpy.typing import NDArray
from PIL import Image

from labseq.builtin.equalise import factors
from labseq.errors import ConfigError, DeviceError
from labseq.plugin import Context, DepthRamp, RandomStream, SiteGrid, TweezerAmplitudes

PROFILE = """grid: {rows: 8, cols: 10, spacing: 4.49 um}
detector: {use: threshold, frame: [150, 240], centre_px: [74.5, 119.5]}
devices: {wavemeter: {use: virtual_spot_meter, noise: 1 %}}
simulation:
  use: virtual
  machine_seed: 3
  tone_response: 8 %
  image: {frame: [150, 240], centre_px: [74.5, 119.5]}
"""
METER = ["shot.0.equalise.device=wavemeter"]
CAMERAS = {
    "second camera": """devices:
  trap_camera:
    use: virtual
    role: camera
    region: {y: 180, x: 130, height: 152, width: 252}
    faults: {transient: 10 %}
""",
    "camera of the atoms": "equalise: {device: camera, exposure: 2 ms}\n",
}
SIMULATION = """grid: {rows: 8, cols: 10, spacing: 4.49 um}
detector: {use: threshold, frame: [150, 240], centre_px: [74.5, 119.5]}
simulation:
  use: virtual
  machine_seed: 3
  tone_response: 8 %
  depth_disorder: 0 %
  image: {sensor: qcmos, tweezer_light: 900000, frame: [150, 240], centre_px: [74.5, 119.5]}
"""


def true_powers(outcome: Any = None, **settings: Any) -> NDArray[np.float64]:
    """The powers themselves, at the amplitudes that were found."""
    physics = SimulationSettings.model_validate({"machine_seed": 3, "tone_response": 0.08} | settings)
    context = Context("simulation", SiteGrid(8, 10), random=RandomStream(0))
    simulation = VirtualSimulation(physics, context)
    simulation.open()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    if outcome is not None:
        values = outcome.stored.entry.values
        amplitudes = TweezerAmplitudes(values["row_amplitudes"], values["column_amplitudes"])
        simulation.play("static_tweezers", amplitudes, 0.0)
    return simulation.spot_powers()


def true_spread(outcome: Any = None) -> float:
    """Separable part of the powers."""
    return factors(true_powers(outcome)).separable_spread


@pytest.mark.usefixtures("rendered")
def test_uneven_rows_and_columns_are_made_even_and_stay_so(tmp_path: Path, make_lab: Any) -> None:
    lab = make_lab(tmp_path, PROFILE)
    with pytest.raises(ConfigError, match=r"has no device 'trap_camera'; expected .*'wavemeter'"):
        lab.calibrate("tweezers")
    outcome = lab.calibrate("tweezers", overrides=METER)
    entry = outcome.stored.entry
    assert true_spread() > 0.05
    assert true_spread(outcome) < 0.006
    assert entry.quality["separable_spread"] <= 0.005
    assert entry.quality["residual_spread"] == pytest.approx(0.04, rel=0.3)
    assert (outcome.refused, entry.origin["n_shots"]) == ("", 1)
    assert "rows and columns are equal to 0." in outcome.summary_lines[0]
    assert " remains, which the tones cannot change" in outcome.summary_lines[1]
    for axis in ("row", "column"):
        assert entry.values[f"{axis}_amplitudes"].sum() <= 1 + 1e-9
    with Image.open(io.BytesIO(outcome.stored.picture.read_bytes())) as image:
        assert image.format == "PNG"
        assert min(image.size) > 400
    again = lab.calibrate("tweezers", seed=2, overrides=METER)  # starts at the amplitudes in use
    assert len(again.run.shots[0].readings["equalise.spreads"]) <= 2
    assert again.stored.entry.origin["calibrations"] == {"tweezers": entry.id}
    assert true_spread(again) < 0.006
    assert lab.calibrate("tweezers", source=outcome.run.path).stored.entry.id == entry.id


@pytest.mark.parametrize("camera", CAMERAS)
def test_tweezers_are_equalised_by_frames_of_a_camera_alone(
    camera: str, tmp_path: Path, make_lab: Any
) -> None:
    lab = make_lab(tmp_path, SIMULATION + CAMERAS[camera])
    outcome = lab.calibrate("tweezers")
    powers = true_powers(outcome, depth_disorder=0.0)
    assert np.std(true_powers(depth_disorder=0.0)) > 0.1
    assert np.std(powers) < 0.006 * np.mean(powers)
    assert outcome.stored.entry.quality["n_measured"] < 40


@pytest.mark.parametrize(
    ("camera", "changes", "message"),
    [
        (
            "second camera",
            ["shot.0.equalise.exposure=20 ms"],
            r"pixels are saturated \(65535 counts\); shorten",
        ),
        ("second camera", ["profile.simulation.tweezer_image.tweezer_light=0"], "no lattice found: "),
        (
            "camera of the atoms",
            ["profile.simulation.image.sensor=emccd", "profile.camera.em_gain=300"],
            "with an EM gain of 300 light other than the atoms' would age .* set `em_gain` .* to 1",
        ),
    ],
)
def test_frames_without_measurable_spots_end_the_run(
    camera: str, changes: list[str], message: str, tmp_path: Path, make_lab: Any
) -> None:
    lab = make_lab(tmp_path, SIMULATION + CAMERAS[camera])
    with pytest.raises(DeviceError, match=message):
        lab.calibrate("tweezers", overrides=changes)


SLM = """grid: {rows: 8, cols: 10, spacing: 4.49 um}
detector: {use: threshold, frame: [150, 240], centre_px: [74.5, 119.5]}
devices:
  trap_camera: {use: virtual, role: camera, region: {y: 180, x: 130, height: 152, width: 252}}
  meter: {use: virtual, values: {power: 1.0}}
simulation:
  use: virtual
  machine_seed: 3
  depth_disorder: 10 %
"""
BY_SLM = (
    "profile.static_tweezers={use: slm, output: simulated, pixels: [256, 256], pixel_pitch: 50 um, "
    "offset: [70 um, 0 um]}"
)
TOTAL = ["shot.0.equalise.device=meter", "shot.0.equalise.value=power"]


def test_the_sites_of_an_slm_are_equalised_one_by_one(
    tmp_path: Path, make_lab: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    powers: list[NDArray[np.float64]] = []
    safe = SlmStaticTweezers.safe_state
    simulations: list[VirtualSimulation] = []
    opened = VirtualSimulation.open
    monkeypatch.setattr(VirtualSimulation, "open", lambda self: (simulations.append(self), opened(self))[1])

    def safe_state(self: SlmStaticTweezers) -> None:
        powers.append(simulations[-1].spot_powers())
        safe(self)

    monkeypatch.setattr(SlmStaticTweezers, "safe_state", safe_state)
    lab = make_lab(tmp_path, SLM)
    outcome = lab.calibrate("tweezers", overrides=[BY_SLM])
    entry = outcome.stored.entry
    assert outcome.run.shots[0].readings["equalise.spreads"][0] > 0.08
    assert np.std(powers[0]) < 0.01 * np.mean(powers[0])
    assert entry.quality["separable_spread"] <= 0.005
    assert entry.values["weights"].shape == (8, 10)
    assert np.ptp(entry.values["row_amplitudes"]) == 0, "other static tweezers can use the calibration, too"
    assert "sites are equal to 0." in outcome.summary_lines[0]
    again = lab.calibrate("tweezers", seed=2, overrides=[BY_SLM])
    assert len(again.run.shots[0].readings["equalise.spreads"]) <= 2
    outcome = lab.calibrate("tweezers")  # of the virtual static tweezers, which have tones
    assert "weights" not in outcome.stored.entry.values
    with pytest.raises(DeviceError, match=r"is one number, .* for weights of sites use a camera or an array"):
        lab.calibrate("tweezers", overrides=[BY_SLM, *TOTAL])


class PowerMeter:
    """A power meter on a pseudo-terminal, which sees the light of all simulated tweezers."""

    def __init__(self, simulations: list[VirtualSimulation]) -> None:
        self.simulations, self.rng = simulations, np.random.default_rng(4)
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.port, self.n_asked = os.ttyname(slave), 0
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self) -> None:
        with os.fdopen(self.master, "r+b", buffering=0) as line:
            while line.readline() == b"MEAS:POW?\r\n":
                self.n_asked += 1
                power_w = 30e-6 * self.simulations[-1].spot_powers().sum() * self.rng.normal(1, 0.002) + 2e-6
                line.write(f"{power_w:.6E}\r\n".encode())


SERIAL = """devices:
  power_meter:
    use: serial
    port: PORT
    baud_rate: 115200
    write_ends_with: "\\r\\n"
    read_ends_with: "\\r\\n"
    values: {power: {ask: "MEAS:POW?", unit: W}}
equalise: {device: power_meter, value: power}
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
def test_tweezers_are_equalised_by_a_power_meter_on_a_serial_line(
    tmp_path: Path, make_lab: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulations: list[VirtualSimulation] = []
    opened = VirtualSimulation.open
    monkeypatch.setattr(VirtualSimulation, "open", lambda self: (simulations.append(self), opened(self))[1])
    meter = PowerMeter(simulations)
    lab = make_lab(tmp_path, SIMULATION + SERIAL.replace("PORT", meter.port))
    outcome = lab.calibrate("tweezers")
    assert meter.n_asked > 19 * outcome.stored.entry.quality["n_measured"]
    powers = true_powers(outcome, depth_disorder=0.0)
    assert np.std(powers) < 0.006 * np.mean(powers)
