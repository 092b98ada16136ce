"""Prints the size and shape of the code: ``python tests/measure_structure.py [ROOT]``, or ``poe structure``.

Lines and modules of each package, modules with one importer, the longest chain of imports, the modules that
``import labseq.session`` loads, and the lines of each driver without its simulator.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path

SIMULATORS = ("_sim", "simulator", "simulated", "emulation", "capture")
"""Marks in the path of a module that belongs to a simulated device."""

Graph = dict[str, set[str]]


def read_modules(root: Path) -> dict[str, Path]:
    """Dotted name and file of each module in ``labseq/`` and ``plugins/``."""
    found: dict[str, Path] = {}
    for base, folder in ((root, root / "labseq"), (root / "plugins", root / "plugins")):
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(base).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def read_imports(modules: dict[str, Path], *, lazy: bool) -> Graph:
    """What each module imports of the others.

    Args:
        modules: From :func:`read_modules`.
        lazy: Whether imports inside functions count, too.
    """
    graph: Graph = {}
    for name, path in modules.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        graph[name] = set[str]()
        for node in ast.walk(tree) if lazy else tree.body:
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                wanted = [f"{node.module}.{alias.name}" for alias in node.names]
                graph[name] |= {one if one in modules else node.module for one in wanted}
            elif isinstance(node, ast.Import):
                graph[name] |= {alias.name for alias in node.names}
        graph[name] &= set(modules) - {name}
    return graph


def longest_chain(graph: Graph) -> list[str]:
    """The longest chain of modules, each of which imports the next one when it is loaded."""
    active: set[str] = set()

    @cache
    def chain(name: str) -> tuple[str, ...]:
        active.add(name)
        tails = [chain(other) for other in sorted(graph[name] - active)]
        active.discard(name)
        return (name, *max(tails, key=len, default=()))

    return list(max((chain(name) for name in sorted(graph)), key=len))


def count_lines(paths: list[Path]) -> int:
    """Lines of all files together."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def loaded_by(module: str, root: Path) -> int:
    """Modules of labseq that a fresh process has loaded after it imported one."""
    code = f"import sys, {module}; print(sum(n.split('.')[0] == 'labseq' for n in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    return int(done.stdout)


def main(root: Path) -> None:
    """Print all figures of a checkout."""
    modules = read_modules(root)
    core = {name: path for name, path in modules.items() if name.split(".")[0] == "labseq"}
    imports = read_imports(modules, lazy=True)
    importers: Graph = defaultdict(set)
    for name, others in imports.items():
        for other in others:
            importers[other].add(name)

    packages: dict[str, list[Path]] = defaultdict(list)
    for name, path in core.items():
        parts = name.split(".")
        is_package = len(parts) > 1 and (root / "labseq" / parts[1]).is_dir()
        packages[parts[1] if is_package else "(top level)"].append(path)
    print(f"{'package':24}{'modules':>8}{'lines':>8}")
    for package, paths in sorted(packages.items()):
        print(f"{package:24}{len(paths):8}{count_lines(paths):8}")
    print(f"{'labseq':24}{len(core):8}{count_lines(list(core.values())):8}")

    print(f"\n{'plugin':24}{'driver':>8}{'simulator':>11}")
    totals = [0, 0]
    for folder in sorted(path for path in (root / "plugins").iterdir() if (path / "__init__.py").exists()):
        groups: list[list[Path]] = [[], []]
        for path in folder.rglob("*.py"):
            inside = str(path.relative_to(root / "plugins"))
            groups[any(mark in inside for mark in SIMULATORS)].append(path)
        lines = [count_lines(paths) for paths in groups]
        totals = [total + n for total, n in zip(totals, lines, strict=True)]
        print(f"{folder.name:24}{lines[0]:8}{lines[1]:11}")
    print(f"{'plugins':24}{totals[0]:8}{totals[1]:11}")

    tests = sorted((root / "tests").rglob("*.py"))
    print(f"\ntests: {count_lines(tests)} lines in {len(tests)} files")
    single = [name for name in core if len(importers[name]) == 1]
    print(f"modules of labseq with one importer: {len(single)}")
    chain = longest_chain(read_imports(core, lazy=False))
    print(f"longest import chain: {len(chain)}\n  " + " > ".join(chain))
    print(f"modules that `import labseq.session` loads: {loaded_by('labseq.session', root)}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else ".").resolve())
