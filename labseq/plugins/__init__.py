"""Finds, loads, blocks and reports plugins; fills the registry.

Entry points of the group ``labseq`` come first, then folders. A plugin that
fails to load takes nothing down with it: it is reported, and it is an error only
where a sequence or profile names what it would have offered. Plugins' code that runs
before a run has a thread of its own, a time limit, and leaves the process as it was.
"""

from labseq.plugins.contained import LOCAL_PACKAGE, contained
from labseq.plugins.host import ENTRY_POINT_GROUP, PATH_VARIABLE, PluginHost, PluginInfo

__all__ = [
    "ENTRY_POINT_GROUP",
    "LOCAL_PACKAGE",
    "PATH_VARIABLE",
    "PluginHost",
    "PluginInfo",
    "contained",
]
