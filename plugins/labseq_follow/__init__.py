"""An external control system starts the shots with the signal `go`, over TCP or a serial line."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the devices that connect an external control system; in a dry run it is simulated."""
    from labseq_follow.leader import serial_leader, tcp_leader
    from labseq_follow.settings import SIMULATED, SerialLeaderSettings, TcpLeaderSettings

    simulated = {"leader": SIMULATED}
    registry.device("tcp_leader", tcp_leader, TcpLeaderSettings, simulated=simulated)
    registry.device("serial_leader", serial_leader, SerialLeaderSettings, simulated=simulated)
