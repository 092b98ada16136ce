"""The worker of the device in BLACS, in its own process."""

import json
from pathlib import Path

# isort: off
import labscript_utils.h5_lock  # noqa: F401 - labscript's lock on files, which must precede h5py
import h5py

# isort: on
import numpy as np
from blacs.tab_base_classes import Worker
from labseq_client import Leader


class LabseqWorker(Worker):
    """Sends the values of a shot before the shot, and writes labseq's answer to the shot's file afterwards.

    BLACS shows an exception of these methods in the tab, and does not take the shot or puts it back.
    """

    def init(self):
        """Keep the connection closed until the first shot."""
        self._leader = None
        self._h5_file = None

    def program_manual(self, values):
        """Do nothing, because no output can be set by hand."""
        return {}

    def transition_to_buffered(self, device_name, h5_file, initial_values, fresh):
        """Send the values. labseq refuses wrong values here, before atoms are loaded."""
        with h5py.File(h5_file, "r") as file:
            values = json.loads(file[f"devices/{device_name}"].attrs["values"])
        self._h5_file = h5_file
        try:
            self._connected().state()
        except ConnectionError:  # that run of labseq has ended, but another one may wait
            self.shutdown()
        leader = self._connected()
        if values:
            leader.set(values)
        return {}

    def transition_to_manual(self):
        """Wait for the end of labseq's shot, and write the answer to the group of the device in `data`."""
        try:
            answer = self._leader.wait()
        except OSError:
            self.shutdown()  # so that a late answer is not taken for the next shot's answer
            raise
        with h5py.File(self._h5_file, "r+") as file:
            group = file.require_group("data").require_group(self.device_name)
            group["answer"] = json.dumps(answer.facts)
            group.attrs["is_ready"] = answer.is_ready
            group.attrs["reason"] = answer.reason
            for number, image in enumerate(answer.images):
                occupancy = np.array(answer.occupancy(number), dtype=bool)
                group.create_dataset(f"occupancy_{number}_{image['name']}", data=occupancy)
        return True

    def abort_buffered(self):
        """Disconnect, because the values of this shot are no use for the next."""
        self.shutdown()
        return True

    def abort_transition_to_buffered(self):
        """Disconnect, as in abort_buffered."""
        return self.abort_buffered()

    def shutdown(self):
        """Disconnect. A shot of labseq continues."""
        if self._leader is not None:
            self._leader.close()
        self._leader = None

    def _connected(self):
        if self._leader is None:
            token = Path(self.token_file).read_text().strip() if self.token_file else None
            self._leader = Leader(self.host, self.port, token, all_shots=True)
        return self._leader
