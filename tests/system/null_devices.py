"""Devices that do nothing, and a sequence on them: what is left is labseq's own."""

from __future__ import annotations

from pathlib import Path

PLUGIN = '''
"""Devices that do nothing at once."""

import numpy as np

from labseq.plugin import Camera, Frame, MobileTweezers, StaticTweezers, Step, hookimpl

LABSEQ_API = 1


class Null:
    def __init__(self, settings, context):
        self.frame = Frame(np.zeros((8, 8), np.uint16), 1e-3, 0.0)
        self.occupancy = np.ones(context.grid.shape, bool)
        self.confidence = np.ones(context.grid.shape, np.float32)

    def nothing(self, *args, **kwargs):
        return None

    open = close = safe_state = arm = trigger = load = start = ramp = play = wait = nothing

    def describe(self):
        return {"model": "null"}

    def detect(self, frame):
        return self.occupancy, self.confidence


class NullCamera(Null, Camera):
    def read(self, timeout_s):
        return self.frame


class NullStaticTweezers(Null, StaticTweezers):
    pass


class NullMobileTweezers(Null, MobileTweezers):
    def prepare(self, program):
        return 1e-3


class NullStep(Step):
    def __init__(self, settings):
        pass

    def plan_timeline(self, context):
        return []

    def run(self, shot):
        return None


@hookimpl
def labseq_register(registry):
    registry.camera("nothing", NullCamera, virtual_time=True)
    registry.static_tweezers("nothing", NullStaticTweezers, virtual_time=True)
    registry.mobile_tweezers("nothing", NullMobileTweezers, virtual_time=True)
    registry.detector("nothing", Null)
    registry.step("nothing", NullStep)
'''
PROFILE = """
labseq: 1
name: nothing
grid: {rows: 4, cols: 4, spacing: 4.49 um}
camera: {use: nothing}
static_tweezers: {use: nothing}
mobile_tweezers: {use: nothing}
detector: {use: nothing}
plugin_folders: [plugins]
alarms: {stop_after: 0}
"""
SEQUENCE = """
labseq: 1
name: null devices
profile: ./profile.yaml
seed: 1
shots: SHOTS
target: {pattern: compact, rows: 2, cols: 2}
record_frames: none
shot:
  - load: {duration: 10 ms}
  - image: {exposure: 1 ms}
"""


def write(folder: Path, n_shots: int) -> Path:
    """The sequence's file, with its profile and plugin beside it."""
    (folder / "plugins").mkdir()
    (folder / "plugins" / "null_devices.py").write_text(PLUGIN, encoding="utf-8")
    (folder / "profile.yaml").write_text(PROFILE, encoding="utf-8")
    path = folder / "sequence.yaml"
    path.write_text(SEQUENCE.replace("SHOTS", str(n_shots)), encoding="utf-8")
    return path
