"""Finds and loads plugins, reports those that fail, and calls their code with a time limit.

Entry points of the group ``labseq`` come first, then folders. A plugin that fails to load does not affect
the others: it is reported, and is an error only if a sequence or profile uses it.
"""

from labseq.plugins.calls import LOCAL_PACKAGE, call_plugin
from labseq.plugins.host import ENTRY_POINT_GROUP, PATH_VARIABLE, PluginHost, PluginInfo

__all__ = [
    "ENTRY_POINT_GROUP",
    "LOCAL_PACKAGE",
    "PATH_VARIABLE",
    "PluginHost",
    "PluginInfo",
    "call_plugin",
]
