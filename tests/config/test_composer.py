from __future__ import annotations

import pytest

from labseq.config.yaml_nodes import MAX_DEPTH, MAX_VALUES, compose
from labseq.errors import ConfigError


def plain(text: str) -> object:
    node = compose(text, "f.yaml")
    assert node is not None
    return node.plain()


def problems(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        compose(text, "f.yaml")
    return [str(problem) for problem in caught.value.problems]


def test_scalars_are_of_yaml_1_2() -> None:
    assert plain("{do: off, at: 10:30, on: 2026-01-01, n: 0o10, t: true, q: '1', e: }") == {
        "do": "off",
        "at": "10:30",
        "on": "2026-01-01",
        "n": 8,
        "t": True,
        "q": "1",
        "e": None,
    }


def test_block_text() -> None:
    assert plain("a: |\n  #.#\n  .#.\nb: >-\n  x\n  y\n") == {"a": "#.#\n.#.\n", "b": "x y"}


def test_aliases_stand_for_values() -> None:
    assert plain("a: &w [1, {x: 2}]\nb: *w\nc: &k word\nd: {*k : 3}") == {
        "a": [1, {"x": 2}],
        "b": [1, {"x": 2}],
        "c": "word",
        "d": {"word": 3},
    }


def test_all_that_can_be_found_is_reported() -> None:
    assert problems("a: !x 1\nb: 1\nb: 2\n<<: {}\n3: 4\nc: [\n") == [
        (
            "f.yaml:1:4: '!x' is a YAML tag, which is not allowed; expected a plain value; "
            "put text that begins with '!' in quotes"
        ),
        "f.yaml:3:1: 'b' is given twice (first in line 2, column 1); remove one of them",
        "f.yaml:4:1: merge keys ('<<') are not allowed; expected every setting written out",
        "f.yaml:5:1: a key is 3; expected text; write '3' in quotes",
        "f.yaml:6:4: the '[' that opens here is never closed; expected ',' or ']'",
    ]


def test_quoted_key_is_the_same_key() -> None:
    assert len(problems("a: 1\n'a': 2")) == 1


def test_quoted_merge_key_is_a_key() -> None:
    assert plain("'<<': 1") == {"<<": 1}


def test_nesting_up_to_the_limit() -> None:
    deepest = "[" * MAX_DEPTH + "]" * MAX_DEPTH
    plain(deepest)
    assert problems(f"[{deepest}]") == [
        f"f.yaml:1:{MAX_DEPTH + 1}: lists and mappings are nested more than {MAX_DEPTH} deep"
    ]


def test_nesting_by_aliases_counts() -> None:
    half = MAX_DEPTH // 2
    first = "a: &a " + "[" * half + "]" * half
    plain(f"{first}\nb: {'[' * (half - 1)}*a{']' * (half - 1)}")
    assert problems(f"{first}\nb: {'[' * half}*a{']' * half}") == [
        f"f.yaml:2:{4 + half}: lists and mappings are nested more than {MAX_DEPTH} deep"
    ]


def test_number_of_values_up_to_the_limit() -> None:
    fits = MAX_VALUES - 1  # the list is a value too
    assert plain("[" + "1," * fits + "]") == [1] * fits
    message = f"there are more than {MAX_VALUES} values up to here, aliases written out"
    assert problems("[" + "1," * (fits + 1) + "]") == [
        f"f.yaml:1:{2 + 2 * fits}: {message}; expected a smaller file"
    ]


def test_alias_bomb() -> None:
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    for old, new in zip("abcdefgh", "bcdefghi", strict=True):
        lines.append(f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]")
    (message,) = problems("\n".join(lines))
    assert f"more than {MAX_VALUES} values" in message


@pytest.mark.parametrize(
    "text",
    [
        "[" * 1_000_000,
        "{a: " * 250_000,
        "- " * 500_000,
        "? " * 500_000,
        "a:\n" * 300_000,
        "&a " * 300_000,
        "*" * 1_000_000,
        "!" * 1_000_000,
        "a: &a [*a]",
        "'" + "x\n" * 100_000,
        '"\\xff\\u12',
        "%TAG ! tag:\n---\n!x y",
    ],
    ids=lambda text: text[:12],
)
def test_hostile_text_ends_in_a_plain_error(text: str) -> None:
    assert len(problems(text)) >= 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &best 1\nb: *bset", "2:4: '*bset' has no anchor '&bset' before it; did you mean 'best'?"),
        ("a: *b", "1:4: '*b' has no anchor '&b' before it; put text that begins with '*' in quotes"),
        ("a: &b [*b]", "1:8: '*b' stands inside of '&b' itself"),
    ],
)
def test_wrong_aliases(text: str, message: str) -> None:
    assert problems(text) == [f"f.yaml:{message}"]


def test_key_after_a_list() -> None:
    assert problems("- a\nb: 1") == [
        "f.yaml:2:1: this line does not continue the list above; expected '- '; check the indentation"
    ]


def test_no_code_runs() -> None:
    (message, *_) = problems("a: !!python/object/apply:builtins.exit [1]")
    assert message.startswith("f.yaml:1:4: '!!python/object/apply:builtins.exit' is a YAML tag")
