"""The tab of the device in BLACS; it has no outputs that can be set by hand."""

from blacs.device_base_class import DeviceTab


class LabseqTab(DeviceTab):
    """Starts the worker, which knows host, port and token from the connection table."""

    def initialise_workers(self):
        """Start the worker."""
        self.create_worker("main_worker", f"{__package__}.blacs_workers.LabseqWorker", {})
        self.primary_worker = "main_worker"
