"""The device in a labscript file.

    from user_devices.labseq.labscript_devices import Labseq

    Labseq("labseq", host="192.168.1.20", token_file="C:/labscript/leader.token")
    start()
    labseq.set_value("planner.degree_of_parallelism", n_tweezers)  # n_tweezers is a global of runmanager
    go_edge.go_high(t)  # the digital output that is wired to `go` of labseq's timing box
    t += wait("rearranged", t, timeout=2)  # resumed by the edges of `ready` and `failed`

labscript compiles a shot before it is taken. So the edges at labseq's timing box set the times, and this
device transfers values before the shot and occupancies after it.
"""

import json

from labscript import Device, LabscriptError, set_passed_properties


class Labseq(Device):
    """labseq, which takes images and rearranges atoms when the edge comes."""

    description = "labseq"

    @set_passed_properties(property_names={"connection_table_properties": ["host", "port", "token_file"]})
    def __init__(self, name, host="127.0.0.1", port=5750, token_file="", **kwargs):
        """Declare the device.

        Args:
            name: Name of the device.
            host: Computer of labseq.
            port: The `port` of its device `tcp_leader`.
            token_file: Copy of the file `leader.token` on the computer of BLACS. Default this user's own.
            **kwargs: Arguments of the base class.
        """
        Device.__init__(self, name, None, None, **kwargs)
        self.BLACS_connection = f"{host}:{port}"
        self._values = {}

    def set_value(self, address, value):
        """Set a value for this shot.

        Args:
            address: As for `labseq run --set`. The sequence must allow it with `leader: {may_set: [...]}`.
            value: A number, or a text such as "5 ms", usually from a global of runmanager.

        Raises:
            LabscriptError: The value is not a number, a text or a list of these.
        """
        try:
            json.dumps(value)
        except TypeError:
            raise LabscriptError(
                f"{self.name}: the value of '{address}' is {value!r}; expected a number, a text or a list"
            ) from None
        self._values[address] = value

    def generate_code(self, hdf5_file):
        """Write the values to the shot file, from which BLACS reads them."""
        self.init_device_group(hdf5_file).attrs["values"] = json.dumps(self._values)
