"""Arrays as the kernels of PSCA take them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


def bools(values: Any) -> NDArray[np.bool_]:
    return np.array(values, np.bool_)


def ints(values: Sequence[int]) -> NDArray[np.int64]:
    return np.array(values, np.int64)
