"""``labseq plugins``: what is installed, and what of it works."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from labseq.cli.output import columns, stdout_to_stderr, say
from labseq.cli.show import as_line
from labseq.config import load_profile, plugin_paths
from labseq.plugins import PluginHost, PluginInfo
from labseq.registry import LOAD_S
from labseq.scaffolds import PLUGINS
from labseq.session import load_plugins


def list_plugins(profile: str | None, *, as_json: bool = False) -> None:
    """Print a table of the plugins.

    Args:
        profile: Name or path of a profile whose plugin folders are searched too; without one, it is the
            folder ``plugins``, if there is one.
        as_json: Whether to print one line of JSON instead.

    Raises:
        ConfigError: The profile is wrong, or one of its folders does not exist.
    """
    answer = stdout_to_stderr() if as_json else None
    folders, max_wait_s = _folders(profile)
    host = load_plugins(folders, max_wait_s=max_wait_s)
    if answer is None:
        say(*table(host))
    else:
        answer(as_line({"plugins": [_values(host, info) for info in host.infos]}))


def table(host: PluginHost) -> list[str]:
    """A row per plugin, and below them why one failed to load, and what one did besides."""
    rows = [("plugin", "state", "version", "origin", "offers")]
    told: list[str] = []
    for info in host.infos:
        rows.append(
            (info.name, info.state, info.version or "-", info.origin, ", ".join(_offers(host, info)) or "-")
        )
        told += [f"{info.name}: {info.reason}"] if info.reason else []
        told += [f"{info.name}: warning: {note}" for note in info.notes]
    return [*columns(rows), *([""] if told else []), *told]


def _offers(host: PluginHost, info: PluginInfo) -> list[str]:
    return [f"{entry.kind}:{entry.name}" for entry in host.registry.entries(info.name)]


def _values(host: PluginHost, info: PluginInfo) -> dict[str, Any]:
    names = ("name", "state", "version", "origin", "source", "reason", "notes")
    return {**{name: getattr(info, name) for name in names}, "offers": _offers(host, info)}


def _folders(profile: str | None) -> tuple[list[Path], float]:
    """The profile's plugin folders and patience; the plugins that it names need not exist for that."""
    if profile is None:
        return [path for path in (Path(PLUGINS),) if path.is_dir()], LOAD_S
    document, spec = load_profile(profile, beside=Path())
    return plugin_paths(document, spec.plugin_folders), spec.timeouts.load
