"""`labseq plugins`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Final

from labseq.assembly.plugin_choice import load_plugins
from labseq.config.document import plugin_paths
from labseq.console.report import Column, reporting, table
from labseq.plugins.host import PluginHost, PluginInfo


@dataclass(frozen=True, slots=True)
class PluginRow(PluginInfo):
    """A plugin and its contributions, such as "planner:psca"."""

    offers: Sequence[str] = ()


PLUGINS: Final[Sequence[Column[PluginRow]]] = (
    Column("plugin", lambda plugin: plugin.name),
    Column("state", lambda plugin: plugin.state),
    Column("version", lambda plugin: plugin.version or "-"),
    Column("origin", lambda plugin: plugin.origin),
    Column("offers", lambda plugin: ", ".join(plugin.offers) or "-"),
)


@dataclass(frozen=True, slots=True)
class Plugins:
    """All installed and local plugins."""

    plugins: Sequence[PluginRow]

    @classmethod
    def of(cls, host: PluginHost) -> Plugins:
        """The plugins of a host, and the unused ones in ``./plugins``."""
        rows: list[PluginRow] = []
        for info in (*host.infos, *host.unused()):
            offers = [f"{kind}:{name}" for kind, name in host.registry.offers(info.name)]
            rows.append(PluginRow(**asdict(info), offers=offers))
        return cls(rows)

    def as_text(self) -> list[str]:
        """A row per plugin, then the reasons why plugins failed to load, and notes."""
        remarks: list[str] = []
        for plugin in self.plugins:
            remarks += [f"{plugin.name}: {plugin.reason}"] if plugin.reason else []
            remarks += [f"{plugin.name}: warning: {note}" for note in plugin.notes]
        return [*table(self.plugins, PLUGINS), *([""] if remarks else []), *remarks]


def list_plugins(profile: str | None, *, as_json: bool = False) -> None:
    """Print a table of the plugins, including those in a profile's folders and in ``./plugins``."""
    with reporting(as_json=as_json) as show:
        if profile is None:
            host = load_plugins()
        else:
            from labseq.config.profile import load_profile  # takes a tenth of the command's time

            document, spec = load_profile(profile)  # the plugins that it names need not exist
            host = load_plugins(plugin_paths(document, spec.plugin_folders), max_wait_s=spec.timeouts.load_s)
        host.import_all()
        show(Plugins.of(host))
