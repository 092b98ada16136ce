"""One at a time on the same real devices."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from labseq.errors import DeviceError
from labseq.locks import Holder, Lock, knows_no_locks
from labseq.recording import lock_files
from labseq.session.choosing import ResolvedProfile


@contextmanager
def lock_devices(
    bench: ResolvedProfile, roots: Sequence[Path], what: str, warn: Callable[[str], object], *, in_spite: bool = False
) -> Generator[Callable[[str], None]]:
    """Keep everybody else from a profile's devices in the block.

    A lock goes with its process: one that is killed leaves none. It stands in the data root and in the
    user's state folder, as the markers of runs do, so that it counts whatever ``--output`` says.

    Args:
        bench: The profile.
        roots: See :func:`labseq.recording.marker_roots`; those that do not exist are passed over, but
            for the user's own.
        what: What the devices are held for, for whoever finds them held.
        warn: Told what the user should know: that nothing keeps others from the devices.
        in_spite: Whether to go on where somebody else holds them, and only tell.

    Yields:
        What tells anew what the devices are held for.

    Raises:
        DeviceError: Somebody else holds them; says who.
    """
    standing = [root for root in roots if root.is_dir() or root not in roots[:1]]
    locks: list[Lock] = []
    with ExitStack() as stack:
        for file in lock_files(standing, bench.hardware_key):
            lock = Lock(file, what)
            try:
                holder = lock.take()
            except OSError as error:
                if knows_no_locks(error):
                    text = f"the folder {file.parent} knows no locks: nothing keeps a run on another computer"
                    warn(f"{text} from the same devices")
                continue
            if holder is None:
                stack.callback(lock.release)
                locks.append(lock)
            elif in_spite:
                warn(f"its devices are in use by {holder}")
                break
            else:
                raise DeviceError(bench.profile.name, _refusal(holder))
        else:
            if not locks:
                warn("no lock could be had: nothing keeps another run from the same devices")

        def describe(text: str) -> None:
            for lock in locks:
                lock.describe(text)

        yield describe


def _refusal(holder: Holder) -> str:
    return f"its devices are in use by {holder}; wait for its end, or end a run with 'labseq stop'"
