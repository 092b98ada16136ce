"""An external control system starts the shots with the signal `go`, over TCP or a serial line."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the step and devices for an external control system, which a dry run simulates."""
    steps = "labseq_follow.steps"
    registry.step("leader", f"{steps}:LeaderStep", f"{steps}:LeaderStepSettings")
    for kind, settings in (("tcp_leader", "TcpLeaderSettings"), ("serial_leader", "SerialLeaderSettings")):
        factory, model = f"labseq_follow.leader:{kind}", f"labseq_follow.settings:{settings}"
        registry.device(kind, factory, model, simulated={"leader": "simulated"})
