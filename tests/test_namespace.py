"""The flat public namespace: complete, consistent, and cheap to import."""

import ast
from pathlib import Path
from types import FunctionType

import pytest

import labseq

HOME_OF = vars(labseq)["_HOME_OF"]


def stub_names():
    tree = ast.parse(Path(labseq.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return {alias.asname for node in imports for alias in node.names} - {"plugin"}


def test_the_stub_and_the_table_name_the_same():
    assert stub_names() == set(HOME_OF)


@pytest.mark.parametrize("name", sorted(HOME_OF))
def test_every_name_resolves_and_is_documented(name):
    value = getattr(labseq, name)
    assert value is not None
    assert name in dir(labseq)
    if isinstance(value, type | FunctionType):
        assert value.__doc__


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'make_plan'"):
        getattr(labseq, "make_plan")  # noqa: B009 - pyright knows that it is not there
