"""Static tweezers that another system holds and labseq does not control."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from labseq.plugin import (
    Context,
    DeviceError,
    LimitError,
    Registry,
    Settings,
    StaticTweezers,
    TweezersFacts,
    hookimpl,
)

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the static tweezers ``external``, which their virtual twin replaces in a dry run."""
    registry.static_tweezers("external", ExternalStaticTweezers, ExternalSettings)


class ExternalSettings(Settings):
    """Static tweezers that another system holds, which have no settings."""

    def identities(self) -> tuple[str, ...]:
        """No names, because any number of processes may use these tweezers."""
        return ()


class ExternalStaticTweezers(StaticTweezers):
    """Static tweezers that are on, and stay on, whatever labseq does.

    Args:
        settings: None.
        context: Their name.
    """

    any_thread = True

    def __init__(self, settings: ExternalSettings, context: Context) -> None:
        del settings
        self._name = context.name or "static_tweezers"
        self._is_open = False

    @property
    def facts(self) -> TweezersFacts:
        """Nothing can be set, but a line of the timing box may release the atoms."""
        return TweezersFacts(control="nothing", ramps=False)

    def open(self) -> None:
        """Do nothing."""
        self._is_open = True

    def close(self) -> None:
        """Do nothing."""
        self._is_open = False

    def safe_state(self) -> None:
        """Do nothing, because the light belongs to the other system."""

    def load(self, amplitudes: tuple[NDArray[Any], NDArray[Any]] | None) -> None:
        """Accept only None.

        Raises:
            LimitError: ``amplitudes`` is not None.
        """
        self._check_open()
        if amplitudes is not None:
            raise LimitError(
                f"{self._name}: amplitudes", "given", "none, because another system holds the array"
            )

    def start(self) -> None:
        """Do nothing, because the array is at its nominal depth."""
        self._check_open()

    def ramp(self, depth: float, duration_s: float) -> None:
        """Accept only the nominal depth.

        Raises:
            LimitError: Another depth.
        """
        self._check_open()
        if depth != 1.0 or not duration_s >= 0:
            value = f"{depth:g} of the nominal depth within {duration_s:g} s"
            raise LimitError(f"{self._name}: ramp", value, "1, because another system holds the array")

    def describe(self) -> Mapping[str, Any]:
        """Report that nothing is known of these tweezers."""
        return {"model": "held by another system"}

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "not open; call open() first")
