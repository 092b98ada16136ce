"""Base class of camera drivers that set their camera through a vendor's library."""

from __future__ import annotations

from labseq.drivers.sdk_camera import SdkCamera, without_rounding

__all__ = ["SdkCamera", "without_rounding"]
