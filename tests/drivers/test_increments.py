"""Numbers that a device takes in steps."""

from hypothesis import given, strategies as st

from labseq.drivers.camera import nearest


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
