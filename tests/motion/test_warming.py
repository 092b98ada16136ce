from __future__ import annotations

import subprocess
import sys

FIRST_PLAN = """
import gc
import sys
import labseq.kernels.kernel as kernel
import labseq.motion as motion
import labseq.motion.rendering as rendering
from labseq import Plan, SiteGrid, TargetPattern

def loaded():
    return {one: {*one._dispatchers} for one in gc.get_objects() if isinstance(one, kernel._Kernel)}

motion.warm()
rendering.warm_rendering()
kernel.load_kernels()
warm, before = set(sys.modules), loaded()
target = TargetPattern([[False, True]], [[True, False]])
plan = Plan.from_batches([([(0, 0)], [(0, 1)])])
motion.check_plan(plan, [[True, False]], target, 1)
program = motion.tone_program(plan, SiteGrid(1, 2))
rendering.render(program)
print(sorted(name for name in set(sys.modules) - warm if name.startswith("labseq")))
print([one.__name__ for one, kinds in loaded().items() if kinds != before[one]])
"""


def test_after_warming_the_first_plan_loads_no_kernels() -> None:
    done = subprocess.run([sys.executable, "-c", FIRST_PLAN], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n[]\n"
