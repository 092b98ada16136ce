"""Finds and loads plugins, reports those that fail, and calls their code with a time limit.

Plugins come from entry points of the group ``labseq``, then from folders, in the order sequence, profile,
``--plugins`` and LABSEQ_PLUGIN_PATH. No other code runs, because ``./plugins`` is only searched for a plugin
that a message can advise. A plugin that fails to load does not affect the others. It is reported, and is an
error only if a sequence or profile uses it.
"""
