"""Another control system leads, over TCP or a serial line; labseq images and rearranges when it says `go`."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the devices that a leader speaks through; in a dry run, one that says `go` by itself."""
    from labseq_follow.leader import serial_leader, tcp_leader
    from labseq_follow.settings import SIMULATED, SerialLeaderSettings, TcpLeaderSettings

    simulated = {"leader": SIMULATED}
    registry.device("tcp_leader", tcp_leader, TcpLeaderSettings, simulated=simulated)
    registry.device("serial_leader", serial_leader, SerialLeaderSettings, simulated=simulated)
