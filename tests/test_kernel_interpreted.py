"""Kernels left as plain Python, each case in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

CODE = """
import sys
{before}
from labseq.kernel import announcing, interpret
interpret()
with announcing(print):
    from labseq.motion.check_kernels import longest_move
import types
print(isinstance(longest_move, types.FunctionType), "numba" in sys.modules)
"""


@pytest.mark.parametrize(
    ("before", "environment", "expected"),
    [
        ("", {}, "True False"),
        ("import numba", {}, "False True"),
        ("", {"NUMBA_DISABLE_JIT": "0"}, "False True"),
        ("", {"NUMBA_DISABLE_JIT": "1"}, "True True"),
    ],
)
def test_kernels_are_interpreted_where_that_is_allowed(
    before: str, environment: dict[str, str], expected: str
) -> None:
    inherited = {key: value for key, value in os.environ.items() if key != "NUMBA_DISABLE_JIT"}
    done = subprocess.run(
        [sys.executable, "-c", CODE.format(before=before)],
        capture_output=True,
        text=True,
        env=inherited | environment,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == expected
