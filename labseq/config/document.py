"""A YAML file with its overrides and expressions, validated part by part."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeVar, cast

from labseq.config.addresses import Override, find
from labseq.config.validation import ValidationContext, check, node_of, validate
from labseq.config.yaml_nodes import Mark, Node, compose
from labseq.errors import ConfigError, Loc, Problem, ProblemCollector, collecting
from labseq.files import PLUGINS
from labseq.messages import clean, shown, visible
from labseq.settings import FORMAT, SettingsType, path_beside
from labseq.text_files import decode, is_folder, read_bytes

M = TypeVar("M")

FileKind = Literal["sequence", "hardware profile"]
_KINDS: Final[Mapping[FileKind, str]] = {"sequence": "shot", "hardware profile": "grid"}
"""Kind of file -> a key that occurs only in this kind."""


class StoredText(NamedTuple):
    """The text of a file when a run began. Paths in it stay relative to the file.

    Attributes:
        text: The text.
        name: Its name in messages, for example the path of the copy.
    """

    text: str
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class Expressions:
    """The expressions of a file.

    Attributes:
        written: The file with its expressions.
        root: The same with their values.
        texts: Place of each expression -> its text.
        reads: Place of each expression -> the places of all values that it depends on, also indirectly.
    """

    written: Node
    root: Node
    texts: Mapping[Loc, str]
    reads: Mapping[Loc, frozenset[Loc]]

    def following(self, loc: Loc) -> list[Loc]:
        """The expressions that depend on a value, on a part of it, or on the mapping or list that has it."""
        return [
            reader
            for reader, read in self.reads.items()
            if any(loc[: len(other)] == other[: len(loc)] for other in read)
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Document:
    r"""The content of a sequence or profile file, with its overrides. Immutable.

    Example:
        >>> document = Document.parse("shots: 20\nshot:\n  - load: {}\n", "mine.yaml")
        >>> document.locate(("shot", 0, "load"))
        (3, 11)
        >>> print(document.problem(("shots",), "too many shots"))
        mine.yaml:1:8: too many shots

    Attributes:
        path: The file.
        text: The file's text, without a byte order mark.
        root: The top mapping, with the results of the expressions once they are computed.
        expressions: The expressions. None before :meth:`evaluated`.
        replaced: Locations of wrong values that fallbacks replaced so that the rest could be checked.
    """

    path: Path
    text: str
    root: Node
    expressions: Expressions | None = None
    replaced: frozenset[Loc] = frozenset()

    @classmethod
    def read(cls, path: Path, kept: StoredText | None = None) -> Document:
        """Read a file.

        Args:
            kept: The text to use instead of reading the file, which then need not exist.

        Raises:
            ConfigError: The file cannot be read, or is not strict YAML 1.2 with a mapping at the top.
        """
        text, name = (read_bytes(path), str(path)) if kept is None else kept
        return replace(cls.parse(text, visible(name)), path=path)

    @classmethod
    def parse(cls, text: str | bytes, name: str) -> Document:
        """Parse the content of a file, called ``name`` in messages.

        Raises:
            ConfigError: The content is not strict YAML 1.2 with a mapping at the top.
        """
        decoded = decode(text, name) if isinstance(text, bytes) else text.removeprefix("\ufeff")
        root = compose(decoded, name)
        expected = "a mapping that begins with 'labseq: 1'"
        if root is None or root.value is None:
            raise ConfigError(Problem("the file is empty", name, expected=expected))
        if not isinstance(root.value, dict):
            what = f"the top level is {shown(root.plain(), root.raw)}"
            raise root.mark.error(what, expected)
        return cls(Path(name), decoded, root)

    @property
    def name(self) -> str:
        """The file's name as the user gave it, for messages."""
        return self.root.mark.source

    @property
    def data(self) -> dict[str, Any]:
        """The content as plain dicts, lists and scalars."""
        return self.root.plain()

    @property
    def written(self) -> Node:
        """The top mapping with its expressions instead of their results."""
        return self.root if self.expressions is None else self.expressions.written

    def evaluated(self) -> Document:
        """A copy with the results of its expressions.

        Raises:
            ConfigError: All errors in the expressions.
        """
        written = self.written
        texts = (node.value for _, node in written.leaves() if isinstance(node.value, str))
        if not any(text.startswith("=") for text in texts):
            return replace(self, root=written, expressions=Expressions(written, written, {}, {}))
        from labseq.config.expressions import evaluate  # most files have none

        expressions = Expressions(written, *evaluate(written, self.text))
        return replace(self, root=expressions.root, expressions=expressions)

    def get(self, loc: Loc, default: Any = None) -> Any:
        """The plain value at a location, or the default."""
        node = self.root.at(loc)
        return default if node is None else node.plain()

    def locate(self, loc: Loc, key: bool = False) -> tuple[int, int]:
        """Line and column, counted from 1, of the value at a location, or of its key.

        A missing value has the line and column of its nearest parent. The value of an option has line 0.
        """
        mark = self.root.mark_at(loc, key)
        return mark.line, mark.column

    def problem(self, loc: Loc, what: str, expected: str = "", hint: str = "", key: bool = False) -> Problem:
        """Create a problem at a location in the file, or in the option that set the value."""
        return self.root.mark_at(loc, key).problem(what, expected, hint)

    def error(
        self, loc: Loc, what: str, expected: str = "", hint: str = "", key: bool = False
    ) -> ConfigError:
        """Create an error for a problem at a location, as :meth:`problem` does."""
        return ConfigError(self.problem(loc, what, expected, hint, key))

    def with_values(self, values: Iterable[tuple[Loc, Node, Mark | None]]) -> Document:
        """A copy with other values at some locations, and its expressions computed again.

        Raises:
            ConfigError: An expression can no longer be computed.
        """
        root = self.written
        for loc, node, key in values:
            root = root.replaced(loc, node, key=key)
        document = replace(self, root=root, expressions=None)
        return document if self.expressions is None else document.evaluated()

    def override(self, address: str, value: str, origin: str, *, may_add: Collection[str] = ()) -> Document:
        """A copy with one value replaced, or added to a mapping.

        Args:
            address: Keys, list indices and names of list items: "shot.2.rearrange.window"
                or "shot.sort.window".
            value: YAML for one value, for example ``5``, ``45 ms``, ``[60 ms, 40 ms]``, ``{use: psca}``.
            origin: The option, which messages give as the place of errors in the value.
            may_add: Addresses of mappings that are added if the file has none.

        Raises:
            ConfigError: The address does not exist, or the value is not valid YAML.
        """
        loc = find(self.root, address, origin, may_add)
        # an option without a value means null, as an empty value in a file does
        node = compose(value, origin, is_option=True) or Node(None, Mark(origin))
        return self.with_values([(loc, node, None)])

    @classmethod
    def of_options(cls, overrides: Sequence[Override], called: str) -> Document:
        """A document that contains only what options set.

        Args:
            called: Its name in messages.

        Raises:
            ConfigError: All the options that cannot be read.
        """
        paths = [override.address.split(".") for override in overrides]
        parents = {".".join(path[:n]) for path in paths for n in range(1, len(path))}
        with collecting() as problems:
            return cls.parse("{}", called).override_all(overrides, problems, may_add=parents)

    def override_all(
        self,
        overrides: Iterable[Override],
        problems: ProblemCollector,
        *,
        may_add: Collection[str] = (),
    ) -> Document:
        """A copy with several values replaced, in order (see :meth:`override`).

        Args:
            problems: Receives the problems of overrides that cannot be applied.
            may_add: Addresses of mappings that are added if the file has none.
        """
        document = self
        for override in overrides:
            with problems:
                document = document.override(
                    override.address, override.value, override.source, may_add=may_add
                )
        return document

    def validate(
        self,
        model: type[M],
        loc: Loc = (),
        *,
        core_keys: Collection[str] = (),
        called: str = "",
    ) -> M:
        """Validate the mapping at a location with a settings model. An empty or missing mapping counts as {}.

        Args:
            loc: Location of the mapping.
            core_keys: Keys that belong to another model and are left out.
            called: Name of the mapping in messages, for example "camera 'andor'". "" for its key.

        Raises:
            ConfigError: All errors in the mapping, in file order.
        """
        name = next((step for step in reversed(loc) if isinstance(step, str)), "")
        context = ValidationContext(name, called, core_keys, self.path.parent, needs_units=True)
        node = self.root.at(loc) or Node({}, self.root.mark_at(loc))
        return validate(model, node, context)


def check_kind(document: Document, kind: FileKind) -> None:
    """Raise for a file of the wrong kind or of a newer format, before any other check.

    Raises:
        ConfigError: The file is for a newer labseq, or it is not of this kind.
    """
    version, keys = document.get(("labseq",)), cast("dict[str, Node]", document.root.value)
    if isinstance(version, int) and version > FORMAT:
        what = f"this file is for a newer labseq (its format is {version}, this labseq reads {FORMAT})"
        raise document.error(("labseq",), what, "", "update labseq")
    for other, key in _KINDS.items():
        if other != kind and key in keys and _KINDS[kind] not in keys:
            what = f"this is a {other} (it has the key '{key}')"
            raise document.error((key,), what, f"a {kind}", key=True)


def plugin_paths(document: Document, folders: Sequence[str]) -> list[Path]:
    """The folders of ``plugin_folders``, relative to the file that names them.

    Only ``plugins`` may be missing. Every file made by ``labseq new`` names this folder, and a file that uses
    no plugin from it can be copied without it.

    Raises:
        ConfigError: Another folder does not exist.
    """
    paths = [path_beside(document.path.parent, folder) for folder in folders]
    problems = [
        document.problem(
            ("plugin_folders", i),
            f"there is no plugin folder '{clean(folder)}'",
            f"a folder at {visible(str(path))}",
        )
        for i, (folder, path) in enumerate(zip(folders, paths, strict=True))
        if folder != PLUGINS and not is_folder(path)
    ]
    if problems:
        raise ConfigError(problems)
    return [path for path in paths if is_folder(path)]


@dataclass(frozen=True, slots=True)
class FallbackValues:
    """Valid values that replace invalid ones, so that the rest of a file can still be checked.

    Attributes:
        values: Every required key -> a valid value.
        items: Key of a list or mapping -> a valid item.
    """

    values: Mapping[str, Any]
    items: Mapping[str, Any]


def load_checked(
    document: Document, model: type[M], called: str, fallbacks: FallbackValues, problems: ProblemCollector
) -> tuple[Document, M]:
    """Validate a whole file, and continue with fallbacks for wrong values.

    Args:
        model: The settings model of the whole file.
        fallbacks: Values that replace invalid ones.
        problems: Receives the problems of the file.

    Raises:
        ConfigError: The file has errors, and its other values cannot be checked.
    """
    try:
        return document, document.validate(model, called=called)
    except ConfigError as error:
        repaired = _without_wrong_values(document, model, fallbacks)
        # With fallbacks for these two, plugins would be unknown and the target would not match the grid.
        if any(repaired.get((key,)) != document.get((key,)) for key in ("plugin_folders", "profile")):
            raise
        spec = repaired.validate(model, called=called)
        problems.add(error)
        return repaired, spec


def _without_wrong_values(document: Document, model: SettingsType, fallbacks: FallbackValues) -> Document:
    """A copy whose invalid values are replaced by fallbacks, or removed if there is no fallback."""
    root, seen, replaced = document.root, set[Loc](), set[Loc]()
    for _ in range(5):  # validators of a whole list run only once all its items are right
        findings = check(model, root, ValidationContext("", needs_units=True))
        if not isinstance(findings, list):
            break
        values = dict(cast("dict[str, Node]", root.value))
        # an item of a list is replaced as a whole, so that the other items can still be checked
        for loc in dict.fromkeys(finding.loc[:2] for finding in findings if finding.loc):
            key, around = str(loc[0]), values.get(str(loc[0]))
            if len(loc) > 1 and key in fallbacks.items and around and around.at(loc[1:]) and loc not in seen:
                item = node_of(fallbacks.items[key], around.mark)
                values[key] = around.replaced(loc[1:], item, same_key=True)
                replaced.add(loc)
            elif key in fallbacks.values:
                values[key] = node_of(fallbacks.values[key], root.mark)
                replaced.add((key,))
            else:
                values.pop(key, None)
            seen.add(loc)
        root = Node(values, root.mark, {key: root.keys.get(key, root.mark) for key in values})
    return replace(document, root=root, expressions=None, replaced=frozenset(replaced))
