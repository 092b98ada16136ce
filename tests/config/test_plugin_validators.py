"""Settings models whose own validators refuse, or fail."""

from __future__ import annotations

from typing import Any, Self

import pytest
from pydantic import field_validator, model_validator

from labseq.config import Document
from labseq.errors import ConfigError
from labseq.settings import Settings


class Custom(Settings):
    pair: tuple[int, ...] = ()
    limit: int = 5

    @model_validator(mode="before")
    @classmethod
    def _any(cls, value: Any) -> Any:
        return value

    @field_validator("limit")
    @classmethod
    def _limit(cls, limit: int) -> int:
        if limit == 13:
            raise KeyError("unlucky")
        if limit == 12:
            raise ValueError("12 is reserved; expected another number; ask the night shift")
        if limit == 11:
            raise AssertionError("11 is\n   odd")
        return limit

    @model_validator(mode="after")
    def _together(self) -> Self:
        if self.limit < len(self.pair):
            raise ValueError("more numbers than the limit")
        return self


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("limit: 12", "1:12: limit: 12 is reserved; expected another number; ask the night shift"),
        ("limit: 11", "1:12: limit: 11 is odd"),
        ("limit: 13", "1:4: these settings make the plugin's check fail: KeyError: 'unlucky'"),
        ("limit: 1, pair: [1, 2]", "1:4: a: more numbers than the limit"),
        ("pair: [1, x]", "1:15: pair.1 is 'x'"),
        ("pair: 5", "1:11: pair is 5; expected a list"),
    ],
)
def test_validators_of_plugins(text: str, message: str) -> None:
    document = Document.parse(f"a: {{{text}}}", "f.yaml")
    with pytest.raises(ConfigError) as caught:
        document.validate(Custom, ("a",))
    assert str(caught.value).removeprefix("f.yaml:").startswith(message)


def test_lists_become_tuples_behind_validators_too() -> None:
    assert Document.parse("a: {pair: [1, 2]}", "f.yaml").validate(Custom, ("a",)).pair == (1, 2)
