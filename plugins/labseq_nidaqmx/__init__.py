"""Lines on cards of National Instruments, through NI-DAQmx."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the lines ``nidaqmx``, with simulated cards in a dry run."""
    registry.lines(
        "nidaqmx",
        "labseq_nidaqmx.lines:NidaqmxLines",
        "labseq_nidaqmx.settings:NidaqmxSettings",
        simulated="labseq_nidaqmx.library:simulated_settings",
    )
