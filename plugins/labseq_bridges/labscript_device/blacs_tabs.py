"""The tab of the device in BLACS, without outputs to set by hand."""

from blacs.device_base_class import DeviceTab


class LabseqTab(DeviceTab):
    """Starts the worker, which reads host, port and token from the connection table."""

    def initialise_workers(self):
        """Start the worker."""
        self.create_worker("main_worker", f"{__package__}.blacs_workers.LabseqWorker", {})
        self.primary_worker = "main_worker"
