"""The flat public namespace: complete, consistent, and cheap to import."""

import ast
from pathlib import Path
from types import FunctionType, ModuleType

import pytest

import labseq


def stub_names():
    tree = ast.parse(Path(labseq.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return {alias.asname or alias.name for node in imports for alias in node.names} - {"plugin"}


def test_every_name_of_the_stub_resolves_and_is_documented_and_no_other_is_offered():
    names = stub_names()
    assert len(names) > 30
    for name in names:
        value = getattr(labseq, name)
        assert value is not None, name
        assert not isinstance(value, type | FunctionType) or value.__doc__, name
    offered = {name for name in dir(labseq) if name[0] != "_"}
    others = {name for name in offered - names if not isinstance(getattr(labseq, name), ModuleType)}
    assert (names - offered, others) == (set(), {"annotations"})


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'make_plan'"):
        getattr(labseq, "make_plan")  # noqa: B009 - pyright knows that it is not there
