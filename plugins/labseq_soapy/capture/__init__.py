"""A radio that exists only in software: a module of SoapySDR that keeps what it was sent."""

from labseq_soapy.capture.build import built, can_build
from labseq_soapy.capture.outputs import CapturedOutputs
from labseq_soapy.capture.ring import Fault, Ring

__all__ = ["CapturedOutputs", "Fault", "Ring", "built", "can_build"]
