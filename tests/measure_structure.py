"""Prints the size and shape of the code: ``python tests/measure_structure.py [ROOT]``, or ``poe structure``.

Lines and modules of each package, the lines of each driver without its simulator, what a virtual run loads
and how often it changes the file until the first shot, circles, modules with one importer, the longest chain
of imports, branches, comments, and constants that are used once.
"""

from __future__ import annotations

import ast
import io
import json
import re
import subprocess
import sys
import tempfile
import tokenize
from collections import Counter, defaultdict
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


PROFILED = """
import json, os, sys
from pathlib import Path
import labseq
from labseq.session import session

folder, changes, last, opened = os.path.dirname(labseq.__file__), [0, 0], "", 0

def follow(frame, event, argument):
    global last, opened
    code = frame.f_code
    if not code.co_filename.startswith(folder):
        return
    if event == "call" and code.co_filename != last:
        changes[opened] += 1
        last = code.co_filename
    if event == "return" and code.co_name == "open":
        opened |= code is session.Session.open.__func__.__code__
    if code.co_filename.endswith("shot.py") and code.co_qualname == "RunningShot.__init__":
        sys.setprofile(None)

sys.setprofile(follow)
with session.Session.open(Path("sequences/compact_225.yaml"), shots=1, output=Path(sys.argv[1])) as run:
    run.run()
files = [module.__file__ for name, module in sys.modules.items() if name.split(".")[0] == "labseq"]
print(json.dumps({"files": files, "changes": changes}))
"""
"""Runs one shot, and prints the modules of labseq that it loaded, and how often its calls entered another
file: until the session was open, and from there until the shot began."""


def virtual_run(root: Path, output: Path) -> tuple[list[Path], list[int]]:
    """What a run on virtual hardware loads of labseq, and how often its calls changed the file.

    Args:
        output: Folder for the run.
    """
    command = [sys.executable, "-c", PROFILED, str(output)]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    printed = json.loads(done.stdout.splitlines()[-1])
    return [Path(file) for file in printed["files"]], printed["changes"]


def circles(graph: Graph) -> list[list[str]]:
    """Groups of packages of labseq that import each other, directly or through others."""
    reached: Graph = {name: set() for name in graph}
    for name in graph:
        waiting = [*graph[name]]
        while waiting:
            if (other := waiting.pop()) not in reached[name]:
                reached[name].add(other)
                waiting += graph[other]
    groups = {frozenset({other for other in reached[name] if name in reached[other]}) for name in graph}
    return [sorted(group) for group in groups if len(group) > 1]


def by_package(graph: Graph) -> Graph:
    """The imports between packages and modules at the top of labseq."""
    joined: Graph = defaultdict(set)
    for name, others in graph.items():
        top = ".".join(name.split(".")[:2])
        joined[top] |= {".".join(other.split(".")[:2]) for other in others} - {top, "labseq"}
    return {name: others & set(joined) for name, others in joined.items()}


BRANCHES = (ast.If, ast.IfExp, ast.For, ast.While, ast.ExceptHandler, ast.match_case, ast.comprehension)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def density(paths: list[Path]) -> tuple[float, float, int]:
    """Branches per function, share of lines with a comment, number of constants that are used once."""
    n_branches = n_functions = n_comments = n_lines = n_once = 0
    texts = [path.read_text(encoding="utf-8") for path in paths]
    words = Counter(word for text in texts for word in re.findall(r"\w+", text))
    for text in texts:
        tree = ast.parse(text)
        n_functions += sum(isinstance(node, FUNCTIONS) for node in ast.walk(tree))
        for node in ast.walk(tree):  # as McCabe's complexity counts them
            n_branches += isinstance(node, BRANCHES)
            n_branches += len(getattr(node, "ifs", ()))
            n_branches += len(node.values) - 1 if isinstance(node, ast.BoolOp) else 0
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        comments = {token.start[0] for token in tokens if token.type == tokenize.COMMENT}
        n_comments += len(comments)
        n_lines += len(text.splitlines())
        for node in tree.body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            names = [target.id for target in targets if isinstance(target, ast.Name)]
            constants = [name for name in names if re.fullmatch("_?[A-Z][A-Z0-9_]*", name)]
            n_once += sum(words[name] == 2 for name in constants)
    return n_branches / n_functions, n_comments / n_lines, n_once


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
    print(f"circles: {circles(by_package(read_imports(core, lazy=False))) or 'none'}")
    branches, comments, n_once = density(list(core.values()))
    print(f"branches per function: {branches:.2f}; lines with a comment: {comments:.1%}")
    print(f"constants that are used once: {n_once}")
    with tempfile.TemporaryDirectory() as output:
        files, changes = virtual_run(root, Path(output))
    print(f"a virtual run loads {count_lines(files)} lines in {len(files)} modules")
    print(f"calls into another file: {changes[0]} until the session is open, then {changes[1]} until a shot")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else ".").resolve())
