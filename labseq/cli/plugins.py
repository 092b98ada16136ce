"""``labseq plugins``: what is installed, and what of it works."""

from __future__ import annotations

from pathlib import Path

from labseq.cli.output import columns, say
from labseq.config import load_profile, plugin_paths
from labseq.plugins import PluginHost
from labseq.session import load_plugins


def list_plugins(profile: str | None) -> None:
    """Print a table of the plugins.

    Args:
        profile: Name or path of a profile whose plugin folders are searched too.

    Raises:
        ConfigError: The profile is wrong, or one of its folders does not exist.
    """
    say(*table(load_plugins(_folders(profile))))


def table(host: PluginHost) -> list[str]:
    """A row per plugin, and below it the reason if it failed to load."""
    rows = [("plugin", "state", "version", "origin", "offers")]
    for info in host.infos:
        offers = ", ".join(f"{entry.kind}:{entry.name}" for entry in host.registry.entries(info.name))
        rows.append((info.name, info.state, info.version or "-", info.origin, offers or "-"))
    reasons = [f"{info.name}: {info.reason}" for info in host.infos if info.reason]
    return [*columns(rows), *([""] if reasons else []), *reasons]


def _folders(profile: str | None) -> list[Path]:
    """The profile's plugin folders; the plugins that it names need not exist for that."""
    if profile is None:
        return []
    document, spec = load_profile(profile, beside=Path())
    return plugin_paths(document, spec.plugin_folders)
