"""A stand-in of Andor's SDK: a camera that exists only in software, below the real pylablib."""

from labseq_andor.counterpart.camera import SimulatedCamera
from labseq_andor.counterpart.faults import Faults
from labseq_andor.counterpart.library import SimulatedSdk, simulated_sdk

__all__ = ["Faults", "SimulatedCamera", "SimulatedSdk", "simulated_sdk"]
