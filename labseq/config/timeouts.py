"""How long plugins may take."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import Field

from labseq.config.settings import Duration, Settings

Timeout: TypeAlias = Annotated[Duration, Field(gt=0)]


class TimeoutSettings(Settings):
    """How long plugins may take before they count as hung."""

    call: Timeout = Field(default=10.0, description="longest device call, beyond what it does by itself")
    safe_state: Timeout = Field(default=5.0, description="longest way of a device to its safe state")
    plan: Timeout = Field(default=5.0, description="longest planning of a cycle")
    load: Timeout = Field(
        default=30.0, description="longest loading of a plugin, and longest way of a constructor"
    )
