"""Names that new things may have."""

from __future__ import annotations

import builtins
import keyword
import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from labseq.config.wording import clean
from labseq.errors import ConfigError, Problem
from labseq.plugins import PluginHost

MAX_LENGTH: Final = 40

_PLUGIN: Final = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_FILE: Final = re.compile(r"[A-Za-z][A-Za-z0-9]*([_-][A-Za-z0-9]+)*")
_YAML: Final = frozenset({"true", "false", "null"})
_OURS: Final = frozenset({"labseq", "labseq_local", "plugins", "conftest"})
_WINDOWS: Final = frozenset({"con", "prn", "aux", "nul"}) | {
    f"{p}{n}" for p in ("com", "lpt") for n in range(10)
}


def check_plugin_name(kind: str, name: str, package: str, host: PluginHost) -> None:
    """Refuse a name that a plugin cannot have, or that is taken.

    Args:
        kind: Kind of the plugin.
        name: Its name.
        package: Name of the Python package that it will be.
        host: The plugins that there are.

    Raises:
        ConfigError: With what would be right.
    """
    if not _PLUGIN.fullmatch(name) or len(name) > MAX_LENGTH:
        guess = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_0123456789")[:MAX_LENGTH]
        expected = (
            f"a lower-case word of at most {MAX_LENGTH} letters, digits and '_' that begins with a letter"
        )
        raise _refused(
            kind,
            name,
            "it is no name for a part of Python",
            expected,
            guess if _PLUGIN.fullmatch(guess) else "",
        )
    hint = f"my_{name}"
    if keyword.iskeyword(name) or hasattr(builtins, name):
        raise _refused(kind, name, "it is a word of Python itself", "another name", hint)
    if name in sys.stdlib_module_names or name in _OURS:
        raise _refused(kind, name, "a part of Python or labseq is called so", "another name", hint)
    if name in _WINDOWS:
        raise _refused(kind, name, "it is no name for a file on Windows", "another name", hint)
    _check_is_free(kind, name, package, host)


def _check_is_free(kind: str, name: str, package: str, host: PluginHost) -> None:
    called, hint = kind.replace("_", " "), f"my_{name}"
    entry = host.registry.find(kind, name)
    if entry is not None:
        what = f"the plugin '{entry.origin}' offers a {called} of that name"
        raise _refused(kind, name, what, "another name", hint)
    taken = next((info for info in host.infos if info.name == package), None)
    if taken is not None:
        what = f"there is a plugin '{package}' ({taken.origin})"
        raise _refused(kind, name, what, "another name", hint)
    if _is_installed(package):
        what = f"there is a Python package '{package}', which the plugin would hide"
        raise _refused(kind, name, what, "another name", hint)


def check_file_name(kind: str, name: str, profiles: Path) -> None:
    """Refuse a name that a sequence or profile cannot have.

    Args:
        kind: "sequence" or "profile".
        name: Its name, without an ending.
        profiles: Folder of the profiles that come with labseq.

    Raises:
        ConfigError: With what would be right.
    """
    if not _FILE.fullmatch(name) or len(name) > MAX_LENGTH:
        guess = re.sub(r"\.ya?ml$", "", name, flags=re.IGNORECASE)
        guess = re.sub(r"[^A-Za-z0-9]+", "_", guess).strip("_0123456789")[:MAX_LENGTH]
        expected = f"at most {MAX_LENGTH} letters, digits, '-' and '_', from a letter on, without an ending"
        raise _refused(
            kind, name, "it is no name for a file", expected, guess if _FILE.fullmatch(guess) else ""
        )
    if name.lower() in _WINDOWS:
        raise _refused(kind, name, "it is no name for a file on Windows", "another name", f"my_{name}")
    if name.lower() in _YAML:
        raise _refused(kind, name, "in YAML it is no text", "another name", f"my_{name}")
    if kind == "profile" and (profiles / f"{name}.yaml").exists():
        what = "a profile of that name comes with labseq, and yours would hide it"
        raise _refused(kind, name, what, "another name", f"my_{name}")


def _is_installed(package: str) -> bool:
    """Whether Python finds such a package; a mere folder of that name in the way does not count."""
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):  # one that is loaded in an odd way
        return True
    return spec is not None and spec.origin is not None


def _refused(kind: str, name: str, why: str, expected: str, guess: str) -> ConfigError:
    called = kind.replace("_", " ")
    what = f"{'an' if called[0] in 'aeiou' else 'a'} {called} cannot be called '{clean(name)}': {why}"
    return ConfigError(Problem(what, expected=expected, hint=f"for example '{guess}'" if guess else ""))
