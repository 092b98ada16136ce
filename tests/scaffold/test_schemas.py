"""The JSON schemas take every file that is right, and refuse those that are built wrongly."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import jsonschema
import pytest
from pydantic import Field, PlainValidator

import labseq
from labseq.assembly.plugin_choice import load_plugins
from labseq.config.yaml_nodes import compose
from labseq.errors import ConfigError
from labseq.registry import Registry
from labseq.scaffold.schemas import FileKind, file_schema, model_schema, quantity_schema
from labseq.units import UNITS
from tests.config import test_wrong_sequences
from tests.config.test_profile import WRONG
from tests.config.wrong_files import wrong_files

ROOT = Path(__file__).parents[2]
FILES = [
    *(("sequence", path) for path in sorted((ROOT / "sequences").glob("*.yaml"))),
    *(("profile", path) for path in sorted((ROOT / "hardware_profiles").glob("*.yaml"))),
]
ABOUT_VALUES = re.compile(
    r"with '/' in it|at least one letter|is taken by step|'0 ms'; expected more|one per cycle"
    r"|in SI units|a wait needs|is given with 'for'|has no 'timeout'|needs 'for'|lowest of the"
    r"|a step of 0|a device is called|there is no device|`blinding` is set for a camera"
)
"""Messages about the values of a file that is well-formed; only `labseq check` reports them."""


CATALOGUE = [
    (kind, old, new, message)
    for kind, table in (
        ("sequence", test_wrong_sequences.KEYS + test_wrong_sequences.STEPS[1:]),
        ("profile", WRONG),
    )
    for old, new, message in wrong_files(table)
]
"""The wrong files of the tests of the configuration: kind, what is replaced by what, and the message."""


Valid = Callable[[str, Any], bool]


@pytest.fixture(scope="module")
def registry() -> Registry:
    return load_plugins().registry


@pytest.fixture(scope="module")
def is_valid(registry: Registry) -> Valid:
    kinds: list[FileKind] = ["sequence", "profile"]
    schemas: dict[str, Any] = {kind: file_schema(kind, registry) for kind in kinds}
    for schema in schemas.values():
        jsonschema.Draft7Validator.check_schema(schema)
    validators = {kind: jsonschema.Draft7Validator(schema) for kind, schema in schemas.items()}
    return lambda kind, data: validators[kind].is_valid(data)


@pytest.mark.parametrize(("kind", "path"), FILES, ids=lambda value: getattr(value, "name", value))
def test_every_shipped_file_is_accepted(kind: str, path: Path, is_valid: Valid) -> None:
    node = compose(path.read_text(encoding="utf-8"), path.name)
    assert node is not None
    assert is_valid(kind, node.plain())


def test_files_that_are_built_wrongly_are_refused(is_valid: Valid) -> None:
    for kind, old, new, message in CATALOGUE:
        good = (ROOT / "tests" / "config" / "data" / f"{kind}.yaml").read_text("utf-8")
        try:
            node = compose(good.replace(old, new, 1), kind)
        except ConfigError:  # no YAML
            continue
        data = None if node is None else node.plain()
        assert is_valid(kind, data) is bool(ABOUT_VALUES.search(message)), (kind, message)


GOOD = """
labseq: 1
name: x
shots: 1
target: {pattern: compact, rows: 5, cols: 5}
planner: {use: psca}
shot: [{load: {}}, {image: {}}]
"""


@pytest.mark.parametrize(
    ("old", "new", "good"),
    [
        ("planner: {use: psca}\n", "", True),
        ("{use: psca}", "{use: psca, degree_of_parallelism: 7, max_tones: {row: 3}}", True),
        ("{use: psca}", "{use: psca, degree_of_paralelism: 7}", False),
        ("{use: psca}", "{use: psca, max_tones: {rows: 3}}", False),
        ("compact, rows: 5", "compact", False),
        ("compact, rows: 5, cols: 5", "sierpinski, order: 3", True),
        ("{load: {}}", "{load: {duration: 500 ms}, name: fill}", True),
        ("{load: {}}", "{load: {duration: 500 MHz}}", False),
        ("{load: {}}", "{load: {duration: 500}}", False),
        ("{load: {}}", "{load: {duration: 0}}", True),
        ("{load: {}}", "{load: {}, image: {}}", False),
        ("shots: 1", "scan: {planner.degree_of_parallelism: [3, 5]}", True),
        ("shots: 1", "scan: [{a.b: {range: [0, 4, 2]}}, {c.d: {linspace: [1, 2, 3]}}]", True),
        ("shots: 1", "scan: {a.b: {rage: [0, 4, 2]}}", False),
        ("shots: 1", "scan: {use: climb, over: {a.b: {from: 1, to: 9}}, maximise: n, points: 3}", True),
        ("shots: 1", "scan: {use: climb, step: 0.5, over: {a.b: {from: 1 us, to: 9 us}}, minimise: n}", True),
        ("shots: 1", "scan: {use: climb, over: {a.b: {from: 1, to: 9}}, maximise: n, minimise: m}", False),
        ("shots: 1", "scan: {use: climb, over: {a.b: {from: 1}}, maximise: n}", False),
        ("shots: 1", "scan: {use: climb, stepp: 1, over: {a.b: {from: 1, to: 9}}, maximise: n}", False),
        ("shots: 1", "scan: {use: climb, step: = 1/2, over: {a.b: {from: 1, to: 9}}, maximise: n}", False),
        ("{image: {}}", "{image: {}, policy: {timeout: 1 s, retries: 2, on_failure: stop}}", True),
        ("{image: {}}", "{name: x, image: {}, policy: {over_budget: warn}}", True),
        ("{image: {}}", "{image: {}, policy: {retry: 2}}", False),
        ("{image: {}}", "{name: x, policy: {retries: 2}}", False),
        (
            "shots: 1",
            "shots: 1\npolicy: {when_exhausted: skip_point, checks: [{value: n, at_least: 1}]}",
            True,
        ),
        ("shots: 1", "shots: 1\npolicy: {checks: [{at_least: 1}]}", False),
        ("shots: 1", "shots: 1\nmeasure: [filling, {value: loading, fit: linear}]", True),
        ("shots: 1", "shots: 1\nmeasure: [{fit: linear}]", False),
        ("shots: 1", "shots: 1\nvariables: {t: 20 ms, n: 3, f: 1.5 MHz, x: = 2 * variables.n}", True),
        ("shots: 1", "shots: 1\nvariables: {t: long}", False),
        ("shots: 1", "shots: = 2 * 3", True),
        ("{load: {}}", "{load: {duration: = 2 * variables.t}}", True),
        ("{load: {}}", "{load: = variables.t}", False),
        ("{load: {}}", "{rearrange: {cycles: 2, window: [20 ms, = variables.t], stop_when: = 1}}", False),
        ("{load: {}}", "{rearrange: {cycles: 2, window: [20 ms, = variables.t]}}", True),
        ("rows: 5", "rows: = variables.n", True),
        ("shots: 1\n", "", False),
        ("shots: 1", "shots: 1\nanalysis: [{use: survival, atoms: moved, finish_within: 5 s}]", True),
        ("shots: 1", "shots: 1\nanalysis: [{use: survival, atoms: some}]", False),
        ("shots: 1", "shots: 1\nplugin_folders:", True),
    ],
)
def test_sequences_with_plugins(old: str, new: str, good: bool, is_valid: Valid) -> None:
    assert old in GOOD
    node = compose(GOOD.replace(old, new, 1), "x")
    assert node is not None
    assert is_valid("sequence", node.plain()) is good


@pytest.mark.parametrize(
    ("more", "good"),
    [
        ("variables: {t: 20 ms}", True),
        ("budgets: {plan: 5 ms, write: = variables.t}", True),
        ("budgets: {planning: 5 ms}", False),
        ("timeouts: {load: 3 s}", True),
        ("timeouts: {load: = 2 * timeouts.plan, plan: 1 s}", True),
        ("timeouts: {load: 3 um}", False),
        ("policy: {on_failure: stop}", False),
    ],
)
def test_profiles_with_more(more: str, good: bool, is_valid: Valid) -> None:
    text = (ROOT / "hardware_profiles" / "virtual.yaml").read_text(encoding="utf-8")
    profile, further = compose(text, "x"), compose(more, "y")
    assert profile is not None
    assert further is not None
    assert is_valid("profile", {**profile.plain(), **further.plain()}) is good


def test_a_bare_name_is_reported_once(registry: Registry) -> None:
    validator = jsonschema.Draft7Validator(file_schema("profile", registry)["properties"]["detector"])
    assert [error.message for error in validator.iter_errors("threshold")] == [
        "'threshold' is not of type 'object'"
    ]


def test_keys_are_explained(registry: Registry) -> None:
    schema = file_schema("sequence", registry)
    assert "shots" in schema["properties"]["shots"]["description"]
    exposure = schema["definitions"]["step.image"]["properties"]["exposure"]
    assert exposure["default"] == "45 ms"
    assert "exposure" in exposure["description"]
    assert "(s, ms, us, ns, min, h)" in exposure["patternErrorMessage"]
    planner = schema["properties"]["planner"]["anyOf"][0]["properties"]["use"]
    assert len(planner["enum"]) == len(planner["enumDescriptions"])
    assert {"psca", "lsap", "tetris"} <= {*planner["enum"]}


@pytest.mark.parametrize("dimension", UNITS)
def test_a_quantity_is_a_number_or_text_with_a_unit(dimension: str) -> None:
    schema = jsonschema.Draft7Validator(quantity_schema(dimension))
    assert schema.is_valid(3.5)
    for unit in UNITS[dimension]:
        assert schema.is_valid(f"3.5 {unit}")
        assert schema.is_valid(f"-1e3{unit}")
    assert not schema.is_valid("3.5 furlong")
    assert not schema.is_valid("")
    assert not any(schema.is_valid(value) for value in (None, True, [3.5]))


class Odd(labseq.plugin.Settings):
    """What no schema can tell of."""

    of_the_plugin: Annotated[complex, PlainValidator(complex)] = Field(
        default=1j, description="a number of its own"
    )
    inner: Odd | None = Field(default=None, description="itself")
    pair: tuple[labseq.plugin.Duration, Literal["a", "b"]] = Field(default=(0.1, "a"), description="two")


def test_a_model_that_is_hard_to_describe_still_reports_its_keys() -> None:
    definitions: dict[str, Any] = {}
    schema = model_schema(Odd, "odd.", definitions)
    assert [*schema["properties"]] == ["of_the_plugin", "inner", "pair"]
    whole = jsonschema.Draft7Validator({**schema, "definitions": definitions})
    whole.check_schema(whole.schema)
    assert whole.is_valid({"of_the_plugin": "2+3j", "inner": {"pair": ["20 ms", "b"]}})
    assert not whole.is_valid({"inner": {"pair": ["20 ms", "c"]}})
    assert not whole.is_valid({"inner": {"pairs": []}})
