"""A timing box on a pty, in a process of its own: it outlives the process that drives it.

Each line on its standard input is answered by one of JSON: what is on, and the time (CLOCK_MONOTONIC) since
when that is so.
"""

from __future__ import annotations

import json
import os
import pty
import select
import sys
import time
import tty
from pathlib import Path

from labseq_ttl_sim.model import ModelBox


def main() -> None:
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    Path(sys.argv[1]).symlink_to(os.ttyname(slave))
    box, on, since_s = ModelBox(), 0, time.monotonic()
    while True:
        ready = select.select([0, master], [], [])[0]
        if master in ready:
            box.write(os.read(master, 4096))
            if box.on != on:
                on, since_s = box.on, time.monotonic()
            while box.in_waiting:
                os.write(master, box.read(4096))
        elif sys.stdin.readline():
            print(json.dumps([on, since_s]), flush=True)
        else:
            return


if __name__ == "__main__":
    main()
