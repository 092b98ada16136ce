"""The four hooks of labseq plugins.

A plugin is a module (or an installed package with an entry point of group ``labseq``) that implements any of
these with ``@labseq.plugin.hookimpl`` and defines ``LABSEQ_API``, the version it was written for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import pluggy

if TYPE_CHECKING:
    from labseq.model import RunRecord, ShotRecord
    from labseq.registry import Registry

hookspec: Final = pluggy.HookspecMarker("labseq")
hookimpl: Final = pluggy.HookimplMarker("labseq")


LABSEQ_API: Final = 1
"""Version of the hooks and roles. A plugin written for another version is not loaded."""


@hookspec
def labseq_register(registry: Registry) -> None:
    """Offer factories, for example ``registry.planner("mine", MyPlanner, MySettings)``.

    Called once, when the plugin is loaded. Do no I/O and import no vendor package here. Both belong in a
    device's ``open()``.
    """


@hookspec
def labseq_run_started(run: RunRecord) -> None:
    """A run has started, with all devices open and no shot taken yet.

    A failure is logged with the plugin's name and never stops the run.
    """


@hookspec
def labseq_shot_finished(shot: ShotRecord) -> None:
    """A shot is on disk. Called between shots, so be quick.

    A failure is logged with the plugin's name and never stops the run.
    """


@hookspec
def labseq_run_finished(run: RunRecord) -> None:
    """A run has ended for any reason, and all devices are in their safe state.

    A failure is logged with the plugin's name and never stops the run.
    """
