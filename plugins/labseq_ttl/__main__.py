"""Look at a timing box, and give it a serial number (``python -m labseq_ttl PORT [--serial N]``)."""

from __future__ import annotations

import sys
from argparse import ArgumentParser
from collections.abc import Sequence

from labseq.plugin import LabseqError
from labseq.plugin.system import NeverStopped
from labseq_ttl.access import MAX_WAIT_S
from labseq_ttl.box import Box, open_box


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a box's identity and state, and return the exit code, 3 if there is no box."""
    parser = ArgumentParser(prog="python -m labseq_ttl", description="Look at a timing box.")
    parser.add_argument("port", help="its serial port, /dev/ttyACM0")
    parser.add_argument("--serial", type=int, help="give it this serial number, 0 to 65535", metavar="N")
    given = parser.parse_args(arguments)
    if given.serial is not None and not 0 <= given.serial <= 0xFFFF:
        parser.error(f"--serial is {given.serial}; expected 0 to 65535")
    try:
        box = Box(open_box(given.port, "timing box"), "timing box", NeverStopped(), MAX_WAIT_S)
        try:
            box.identify()
            if given.serial is not None:
                box.set_serial_number(given.serial)
            identity, state = box.identify(), box.state()
        finally:
            box.close()
    except LabseqError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    low = [str(channel) for channel in range(16) if state.polarity >> channel & 1]
    sys.stdout.write(
        f"serial number {identity.serial_number}, started {identity.boots} times, last by {identity.cause}; "
        f"active low: {', '.join(low) or 'none'}\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
