from __future__ import annotations

import subprocess
import sys

FIRST_PLAN = """
import sys
import labseq.kernel as kernel
import labseq.motion as motion
from labseq import Plan, SiteGrid, TargetPattern

motion.warm()
motion.warm_rendering()
kernel.load_kernels()
warm, pending = set(sys.modules), list(kernel._PENDING)
target = TargetPattern([[False, True]], [[True, False]])
plan = Plan.from_batches([([(0, 0)], [(0, 1)])])
motion.check_plan(plan, [[True, False]], target, 1)
program = motion.tone_program(plan, SiteGrid(1, 2))
motion.render(program)
print(sorted(name for name in set(sys.modules) - warm if name.startswith("labseq")))
print([one for one in pending if one not in kernel._PENDING or one._dispatchers])
"""


def test_after_warming_the_first_plan_loads_no_kernels() -> None:
    # the first process compiles what no other one has, and then knows the kernels that those call, too
    subprocess.run([sys.executable, "-c", FIRST_PLAN], stdout=subprocess.DEVNULL, check=True)
    done = subprocess.run([sys.executable, "-c", FIRST_PLAN], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n[]\n"
