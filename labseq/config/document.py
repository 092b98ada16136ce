"""A YAML file with its overrides and expressions, validated part by part."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar, cast, overload

from pydantic import BaseModel

from labseq.config.addresses import Override, find
from labseq.config.expressions import Expressions, evaluate
from labseq.config.messages import ProblemCollector
from labseq.config.validation import ValidationContext, node_of, validate
from labseq.config.yaml_nodes import Mark, Node, compose
from labseq.errors import ConfigError, Loc, Problem
from labseq.messages import shown, visible
from labseq.settings import NoSettings
from labseq.text_files import decode, read_bytes

M = TypeVar("M", bound=BaseModel)


class StoredText(NamedTuple):
    """The text of a file as it was at another time; paths in it stay relative to the file.

    Attributes:
        text: The text.
        name: What messages call it, for example the path of the copy.
    """

    text: str
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class Document:
    r"""A sequence or a profile as it was written. Immutable: do not change ``data``.

    Example:
        >>> document = Document.parse("shots: 20\nshot:\n  - load: {}\n", "mine.yaml")
        >>> document.locate(("shot", 0, "load"))
        (3, 11)
        >>> print(document.problem(("shots",), "too many shots"))
        mine.yaml:1:8: too many shots

    Attributes:
        path: The file.
        name: The file's name as the user gave it, for messages.
        text: The file's text, exactly, but for a byte order mark.
        root: The top mapping.
        data: The same as plain dicts, lists and scalars, overrides included.
        expressions: What of it was worked out; None before :meth:`evaluated`.
    """

    path: Path
    name: str
    text: str
    root: Node
    data: dict[str, Any] = field(init=False)
    expressions: Expressions | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "data", self.root.plain())

    @classmethod
    def read(cls, path: Path, kept: StoredText | None = None) -> Document:
        """Read a file.

        Args:
            path: The file.
            kept: What it says, in place of what it says today; it need not exist then.

        Raises:
            ConfigError: It cannot be read, or is no strict YAML 1.2 with a mapping at the top.
        """
        text, name = (read_bytes(path), str(path)) if kept is None else kept
        return replace(cls.parse(text, visible(name)), path=path)

    @classmethod
    def parse(cls, text: str | bytes, name: str) -> Document:
        """Read the content of a file called ``name``.

        Raises:
            ConfigError: It is no strict YAML 1.2 with a mapping at the top.
        """
        decoded = decode(text, name) if isinstance(text, bytes) else text.removeprefix("\ufeff")
        root = compose(decoded, name)
        expected = "a mapping that begins with 'labseq: 1'"
        if root is None or root.value is None:
            raise ConfigError(Problem("the file is empty", name, expected=expected))
        if not isinstance(root.value, dict):
            what = f"the file holds {shown(root.plain(), root.raw)} at its top"
            raise ConfigError(root.mark.problem(name, what, expected))
        return cls(Path(name), name, decoded, root)

    @property
    def written(self) -> Node:
        """The top mapping with its expressions, whether or not they were worked out."""
        return self.root if self.expressions is None else self.expressions.written

    def evaluated(self) -> Document:
        """A copy with the values of its expressions in their places.

        Raises:
            ConfigError: Everything that is wrong with them.
        """
        expressions = evaluate(self.written, self.name, self.text)
        return replace(self, root=expressions.root, expressions=expressions)

    def replaced(self, root: Node) -> Document:
        """A copy with another tree; its expressions are worked out anew if those of this one were.

        Args:
            root: The tree, with its expressions.

        Raises:
            ConfigError: What is wrong with them.
        """
        document = replace(self, root=root, expressions=None)
        return document if self.expressions is None else document.evaluated()

    def get(self, loc: Loc, default: Any = None) -> Any:
        """The plain value at a location, or the default."""
        node = self.root.at(loc)
        return default if node is None else node.plain()

    def locate(self, loc: Loc, key: bool = False) -> tuple[int, int]:
        """Line and column, from 1, of the value at a location, or of its key.

        For what does not exist, those of the nearest parent that does; (0, 0)
        for what came from an option.
        """
        mark = self.root.mark_at(loc, key)
        return mark.line, mark.column

    def problem(self, loc: Loc, what: str, expected: str = "", hint: str = "", key: bool = False) -> Problem:
        """Say that something is wrong at a location: in the file, or in the option it came from."""
        return self.root.mark_at(loc, key).problem(self.name, what, expected, hint)

    def error(
        self, loc: Loc, what: str, expected: str = "", hint: str = "", key: bool = False
    ) -> ConfigError:
        """The same as an error to raise."""
        return ConfigError(self.problem(loc, what, expected, hint, key))

    def override(self, address: str, value: str, origin: str, *, may_add: Collection[str] = ()) -> Document:
        """A copy with one value replaced, or added to a mapping.

        Args:
            address: Keys, list indices and names of list items: "shot.2.rearrange.window"
                or "shot.sort.window".
            value: YAML for one value: ``5``, ``45 ms``, ``[60 ms, 40 ms]``, ``{use: psca}``.
            origin: The option, named as the place of anything wrong with the value.
            may_add: Addresses of mappings that are made if the file has none.

        Raises:
            ConfigError: The address leads nowhere, or the value is no YAML.
        """
        loc = find(self.root, address, self.name, origin, may_add)
        node = compose(value, self.name, origin) or Node(None, Mark(0, 0, origin))
        return self.replaced(self.written.replaced(loc, node))

    def override_all(
        self,
        overrides: Iterable[Override | tuple[str, str]],
        *,
        may_add: Collection[str] = (),
        found: ProblemCollector | None = None,
    ) -> Document:
        """A copy with several values replaced, in order; see :meth:`override`.

        Args:
            overrides: Address and value of each.
            may_add: Addresses of mappings that are made if the file has none.
            found: Where the problems go; without it they are raised.

        Raises:
            ConfigError: All the overrides that cannot be applied.
        """
        document = self
        collected = ProblemCollector() if found is None else found
        for one in overrides:
            override = Override(*one)
            with collected:
                document = document.override(
                    override.address, override.value, override.source, may_add=may_add
                )
        if found is None:
            collected.raise_any()
        return document

    @overload
    def validate(
        self,
        model: type[M],
        loc: Loc = ...,
        *,
        drop: Collection[str] = ...,
        other_keys: Collection[str] = ...,
        called: str = ...,
    ) -> M: ...
    @overload
    def validate(
        self,
        model: None,
        loc: Loc = ...,
        *,
        drop: Collection[str] = ...,
        other_keys: Collection[str] = ...,
        called: str = ...,
    ) -> None: ...
    def validate(
        self,
        model: type[M] | None,
        loc: Loc = (),
        *,
        drop: Collection[str] = (),
        other_keys: Collection[str] = (),
        called: str = "",
    ) -> M | None:
        """Make settings of the mapping at a location; an empty or missing one counts as {}.

        Args:
            model: The settings model; None for what takes no settings.
            loc: Where the mapping is.
            drop: Keys that are somebody else's and left out.
            other_keys: Keys to name as known when one is misspelt.
            called: What messages call the mapping: "camera 'andor'"; "" for its key.

        Raises:
            ConfigError: Everything that is wrong in the mapping, in file order.
        """
        name = next((step for step in reversed(loc) if isinstance(step, str)), "")
        asked = ValidationContext(name, called, drop, other_keys, self.path.parent)
        result = validate(model or NoSettings, self.root.at(loc), asked)
        if not isinstance(result, list):
            return None if model is None else cast("M", result)
        placed = [(self.root.mark_at(loc + found.loc, found.key), found.words) for found in result]
        placed.sort(key=lambda pair: pair[0].order)
        problems = [mark.problem(self.name, w.what, w.expected, w.hint) for mark, w in placed]
        raise ConfigError(problems)


# Without these, plugins would count as unknown that are not, and a target would meet another grid.
_NEEDED: Final = ("plugin_folders", "profile")


@dataclass(frozen=True, slots=True)
class FallbackValues:
    """What takes the place of wrong values; it must never give rise to errors of its own.

    Attributes:
        values: Every key that a file must have -> a right value.
        items: Key of a list or mapping -> a right item of it.
    """

    values: Mapping[str, Any]
    items: Mapping[str, Any]


def load_checked(
    document: Document, model: type[M], called: str, fallbacks: FallbackValues, found: ProblemCollector | None
) -> tuple[Document, M]:
    """Validate a whole file; gather its problems, if asked to, and go on with stand-ins.

    Args:
        document: The file.
        model: The settings model of the whole file.
        called: What to call it in messages.
        stand_ins: What takes the place of wrong values.
        found: Where the problems go; without it they are raised.

    Raises:
        ConfigError: The file is wrong, and nothing else can be said of it.
    """
    try:
        return document, document.validate(model, called=called)
    except ConfigError as error:
        if found is None:
            raise
        mended = replace_invalid(document, model, fallbacks)
        if any(mended.get((key,)) != document.get((key,)) for key in _NEEDED):
            raise
        spec = mended.validate(model, called=called)
        found.add(error)
        return mended, spec


def replace_invalid(document: Document, model: type[BaseModel], fallbacks: FallbackValues) -> Document:
    """Replace or leave out every top-level value that the model refuses.

    Args:
        document: A wrong file.
        model: The settings model of the whole file.
        stand_ins: What takes the place of wrong values.

    Returns:
        A copy that the model accepts, unless its values do not go together.
    """
    root = document.root
    assert isinstance(root.value, dict)
    right = {key: node_of(value, root.mark) for key, value in fallbacks.values.items()}

    def accepts(key: str, node: Node) -> bool:
        return not isinstance(
            validate(model, Node({**right, key: node}, root.mark), ValidationContext("")), list
        )

    def mended_items(key: str, node: Node) -> Node:
        other = node_of(fallbacks.items[key], node.mark)
        if isinstance(node.value, list):
            kept = [item if accepts(key, Node([item], node.mark)) else other for item in node.value]
            return Node(kept, node.mark)
        if isinstance(node.value, dict):
            named = {
                name: item if accepts(key, Node({name: item}, node.mark)) else other
                for name, item in node.value.items()
            }
            return Node(named, node.mark, node.keys)
        return node

    kept: dict[str, Node] = {}
    for key in model.model_fields.keys() & root.value.keys():
        node = root.value[key]
        if not accepts(key, node) and key in fallbacks.items:
            node = mended_items(key, node)
        if accepts(key, node):
            kept[key] = node
    keys = {key: root.keys.get(key, root.mark) for key in {**right, **kept}}
    return Document(document.path, document.name, document.text, Node({**right, **kept}, root.mark, keys))
