from __future__ import annotations

import pytest

from labseq.bench.comparison import PlannerEntry, parse_grid, parse_loading, parse_overrides, parse_planners
from labseq.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "planner_entries"),
    [
        ("psca", [PlannerEntry("psca")]),
        (" psca , lsap_squared", [PlannerEntry("psca"), PlannerEntry("lsap_squared")]),
        ("psca:a=1,b=2,lsap", [PlannerEntry("psca", (("a", "1"), ("b", "2"))), PlannerEntry("lsap")]),
        ("psca:a=1,psca:a=2", [PlannerEntry("psca", (("a", "1"),)), PlannerEntry("psca", (("a", "2"),))]),
        ("psca:max_tones={row: 16, col: 5},lsap", [
            PlannerEntry("psca", (("max_tones", "{row: 16, col: 5}"),)), PlannerEntry("lsap"),
        ]),
    ],
)  # fmt: skip
def test_commas_separate_planners_and_their_settings(text: str, planner_entries: list[PlannerEntry]) -> None:
    assert list(parse_planners(text)) == planner_entries


@pytest.mark.parametrize("text", ["", "psca,,lsap", "psca:a", "psca:a=", "a b", "psca:=1"])
def test_what_is_no_list_of_planners_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="not a list of planners"):
        parse_planners(text)


def test_a_planner_is_named_once() -> None:
    with pytest.raises(ConfigError, match="'psca a=1' is named twice"):
        parse_planners("psca:a=1,psca,psca:a=1")


@pytest.mark.parametrize("text", ["20", "0x5", "20x1001", "20x20x20", ""])
def test_what_is_no_size_of_a_grid_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="expected ROWSxCOLS"):
        parse_grid(text)


@pytest.mark.parametrize("text", ["-0.1", "101 %", "nan", "0.5 ms"])
def test_what_is_no_probability_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="expected a number from 0 to 1"):
        parse_loading(text)


def test_probabilities() -> None:
    assert [parse_loading(text) for text in ("0", "1", "0.75", "75%", "55 %")] == [0, 1, 0.75, 0.75, 0.55]


def test_settings_of_planners_need_no_prefix() -> None:
    assert parse_overrides(["a=1", "planner.b=x=y"]) == ((("a", "1"), ("b", "x=y")), ())


@pytest.mark.parametrize("text", ["speed", "planner.=1", "profile.speed=1"])
def test_addresses_that_cannot_be_set_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"expected planner\.KEY=VALUE"):
        parse_overrides([text])
