"""Numbers that a device takes in steps."""

import pytest
from hypothesis import given, strategies as st

from labseq.plugin import LimitError
from labseq.plugin.camera import check_step, nearest


@given(
    value=st.integers(-50, 200),
    low=st.integers(0, 20),
    n_steps=st.integers(0, 20),
    step=st.integers(1, 16),
    rest=st.integers(0, 15),
)
def test_no_good_number_is_nearer_than_the_nearest(
    value: int, low: int, n_steps: int, step: int, rest: int
) -> None:
    high = low + n_steps * step + rest % step
    good = range(low, high + 1, step)
    found = nearest(value, low, high, step)
    assert found in good
    assert abs(found - value) == min(abs(one - value) for one in good)


def test_a_region_between_the_cameras_steps_is_refused_with_the_nearest_good_one() -> None:
    with pytest.raises(LimitError, match=r"width is 500; .*steps of 32.* 512"):
        check_step("camera: region's width", 500, (16, 1024, 16), 2)
