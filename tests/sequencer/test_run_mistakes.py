"""Runs on fakes that answer wrongly: whose fault it is stands in the error."""

import numpy as np
import pytest

from labseq.errors import DeviceError, LabseqError
from labseq.sequencer import State

from .rig import FULL, SAFE_ORDER, Rig


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, "detect\\(\\) returned NoneType"),
        ((np.ones((2, 2)), np.ones((2, 2))), "the occupancy is float64"),
        ((np.ones((3, 2), bool), np.ones((2, 2))), r"the occupancy is bool \(3, 2\); expected bool \(2, 2\)"),
        ((FULL, np.ones(4)), "the confidence is"),
    ],
)
def test_a_detector_of_the_wrong_shape_is_named(answer, message):
    class Wrong:
        def detect(self, frame):
            return answer

    rig = Rig(occupancies=[FULL], detector=Wrong())
    with pytest.raises(DeviceError, match=message) as caught:
        rig.run()
    assert caught.value.device == "detector"
    assert rig.made_safe() == SAFE_ORDER


def test_a_camera_that_returns_no_frame_is_named():
    rig = Rig()
    vars(rig.lab.camera)["read"] = lambda timeout_s: np.zeros((2, 2))
    with pytest.raises(DeviceError, match=r"camera: read\(\) returned ndarray; expected a Frame"):
        rig.run()


@pytest.mark.parametrize("method", ["open", "begin_shot", "load", "close"])
def test_a_simulation_that_fails_is_named_and_all_devices_are_safe(method):
    rig = Rig(simulated=True)

    def fail(*args):
        raise ValueError("nothing there")

    vars(rig.lab.simulation)[method] = fail
    if method == "close":
        rig.run()
        told = rig.observer.of("closed")[-1]
        assert told == {
            "device": "simulation",
            "ok": False,
            "error": "simulation: fail() raised ValueError: nothing there",
        }
    else:
        with pytest.raises(DeviceError, match=r"simulation: fail\(\) raised ValueError: nothing there"):
            rig.run()
    assert rig.made_safe() == SAFE_ORDER
    assert rig.sequencer.state is State.CLOSED


@pytest.mark.parametrize("error", [KeyError("typo"), SystemExit(0), KeyboardInterrupt()])
@pytest.mark.parametrize("method", ["plan_timeline", "run"])
def test_whatever_a_third_party_step_raises_is_named(method, error):
    class Broken:
        needs_image = takes_image = False

        def plan_timeline(self, context):
            return []

        def run(self, shot):
            return None

    def fail(self, given):
        raise error

    setattr(Broken, method, fail)
    with pytest.raises(LabseqError, match=rf"step 0 \(mine\) raised {type(error).__name__}"):
        Rig(steps=(("mine", Broken()),)).run()


@pytest.mark.parametrize("answer", [None, "bars", [None]])
def test_a_timeline_that_is_none_is_named(answer):
    class Broken:
        needs_image = takes_image = False

        def plan_timeline(self, context):
            return answer

        def run(self, shot):
            return None

    with pytest.raises(LabseqError, match=r"step 0 \(mine\) raised (Type|Attribute)Error"):
        Rig(steps=(("mine", Broken()),))
