"""Settings of a sequence file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self, TypeAlias, cast

from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator, model_validator

from labseq.config.addresses import Override
from labseq.config.document import Document, FallbackValues, StoredText, check_kind, load_checked
from labseq.errors import Loc, ProblemCollector, collecting
from labseq.messages import clean, shown
from labseq.model.policies import OverBudget, Then, WhenExhausted
from labseq.settings import (
    FORMAT,
    Choice,
    Duration,
    Folders,
    FormatVersion,
    Name,
    PatternChoice,
    Settings,
    Text,
    Variables,
    empty_is,
    placed_by_field,
    setting_error,
)

if TYPE_CHECKING:
    from labseq.config.scan import Scan

ScanOrder = Literal["sequential", "shuffled"]


class CheckSettings(Settings):
    """A check of a quantity of the last shots, between two shots."""

    value: Text = Field(
        description="name of a quantity: `filling_fraction`, `survival:before,after`, `stage.plan_s`, "
        "`reading.laser.power_w`, `analysis.survival.survival`"
    )
    at_least: float | None = Field(default=None, description="smallest allowed mean, SI")
    at_most: float | None = Field(default=None, description="largest allowed mean, SI")
    shots: int = Field(
        default=1, ge=1, le=10_000, description="number of latest shots that the mean is taken over"
    )
    then: Literal["warn", "skip_point", "stop"] = Field(
        default="warn", description="reaction to a mean outside of the limits"
    )

    @model_validator(mode="after")
    def _has_limits(self) -> Self:
        if self.at_least is None and self.at_most is None:
            raise setting_error("the check has no limit", "'at_least', 'at_most' or both")
        if self.at_least is not None and self.at_most is not None and self.at_least > self.at_most:
            what = f"at_least is {self.at_least:g}, but at_most is {self.at_most:g}"
            raise setting_error(what, "'at_most' above 'at_least'", at=("at_least",))
        return self


class MeasureSettings(Settings):
    """A quantity that the run measures, and how it depends on the scanned value."""

    value: Text = Field(
        description="name of a quantity: `survival:before,after@target`, `filling`, "
        "`reading.laser.power_w`, `analysis.survival.survival`"
    )
    fit: Text | None = Field(
        default=None, description="model to fit to it against the scanned value, such as `exponential`"
    )
    report: Text | None = Field(
        default=None, description="parameter of the fit that is the result of the run, by default its first"
    )
    parameters: Annotated[dict[str, int | float | str], empty_is({})] = Field(
        default={}, description="fixed parameters of the fit: `{offset: 0}`. The value `free` frees one"
    )
    stop_when: Annotated[dict[str, int | float | str], empty_is({})] = Field(
        default={},
        description="errors of parameters below which the run ends before its last shot, "
        "relative as in `{decay: 2 %}` or absolute as in `{decay: 0.5 s}`",
    )

    @model_validator(mode="after")
    def _has_a_fit(self) -> Self:
        for key in ("report", "parameters", "stop_when"):
            if self.fit is None and getattr(self, key):
                raise setting_error(f"'{key}' is given without a fit", "'fit' as well", at=(key,), key=True)
        return self


def _as_mapping(value: Any) -> Any:
    return {"value": value} if isinstance(value, str) else value


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str | dict) else value


def _each_once(measures: tuple[MeasureSettings, ...]) -> tuple[MeasureSettings, ...]:
    names = [measure.value for measure in measures]
    for i, name in enumerate(names):
        if name in names[:i]:
            expected = "each quantity once (`labseq show --scan QUANTITY --fit MODEL` fits other models)"
            raise setting_error(f"'{clean(name)}' is listed a second time", expected, at=(i,))
    return measures


_Measure = Annotated[MeasureSettings, BeforeValidator(_as_mapping)]
_MeasureList = Annotated[tuple[_Measure, ...], Field(min_length=1), AfterValidator(_each_once)]
Measures: TypeAlias = Annotated[_MeasureList | None, BeforeValidator(_as_list)]
"""The quantities that a run measures, the most important first. None to choose them by the steps."""


_WORD: Final = re.compile(r"[^\W\d][\w-]*")
"""Names of steps and regions."""


def _check_region_names(regions: dict[str, Any]) -> dict[str, Any]:
    for name in regions:
        if name in ("target", "reservoir") or not _WORD.fullmatch(name):
            what = f"'{clean(name)}' cannot be the name of a region"
            expected = "a word of letters, digits, '_' and '-', other than target and reservoir"
            raise setting_error(what, expected, at=(name,), key=True)
    return regions


_Site = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]
_Sites = Annotated[list[_Site], Field(min_length=1)]
Regions: TypeAlias = Annotated[
    dict[str, str | _Sites | dict[str, Any]], empty_is({}), AfterValidator(_check_region_names)
]
"""Name -> rows and columns as text, a list of sites, or a pattern. The pattern is checked later."""


class PolicySettings(Settings):
    """``policy`` of a sequence: reactions to failures for the run and for steps without their own policy."""

    on_failure: Then | None = Field(
        default=None,
        description="reaction to a failure, by default to repeat the shot if it is transient, else to stop",
    )
    when_exhausted: WhenExhausted = Field(
        default="stop", description="reaction when a shot has failed `attempts` times"
    )
    over_budget: OverBudget = Field(
        default="record", description="reaction to a stage that takes longer than its budget"
    )
    checks: Annotated[tuple[CheckSettings, ...], empty_is(())] = Field(
        default=(), description="quantities that are checked between the shots"
    )


class AnalysisChoice(Choice):
    """An analysis chosen by name, with the plugin's settings as further keys of the same mapping."""

    finish_within: Duration = Field(
        default=10.0,
        description="how long it may continue after the run, for shots that it has not analysed yet. "
        "Also how long a run waits for a result that a check or an adaptive scan needs",
    )


def _listed(choices: tuple[AnalysisChoice, ...]) -> tuple[AnalysisChoice, ...]:
    """Add to each analysis its location. Raise for duplicate names, because they are also names of files."""
    first: dict[str, int] = {}
    for i, choice in enumerate(choices):
        if first.setdefault(choice.use, i) != i:
            what = f"the analysis '{choice.use}' is listed a second time"
            raise setting_error(what, "each analysis once", at=(i, "use"))
    return tuple(choice.placed("analysis", i) for i, choice in enumerate(choices))


Analyses: TypeAlias = Annotated[tuple[AnalysisChoice, ...], empty_is(()), AfterValidator(_listed)]
"""The analyses of a sequence."""

DEFAULT_PLANNER: Final = "psca"


@dataclass(frozen=True, slots=True)
class StepSpec:
    """One step of the shot.

    Attributes:
        kind: Name of the step in the registry: "load", "image", ...
        name: The step's own name, for addresses. "" if it has none.
        loc: Location of the mapping of its settings in the document.
    """

    kind: str
    name: str
    loc: Loc

    @property
    def policy_loc(self) -> Loc:
        """Location of the mapping of its policy, which need not exist."""
        return (*self.loc[:-1], "policy")


def _step(value: Any) -> StepSpec:
    """Read one item of ``shot``. Its index is added later."""
    if isinstance(value, str) and _WORD.fullmatch(value):
        raise setting_error(f"a step is just '{value}'", "a mapping", f"write '- {value}: {{}}'")
    if not isinstance(value, dict):
        raise setting_error(f"a step is {shown(value)}", "a mapping such as 'image: {exposure: 45 ms}'")
    item = cast("dict[str, Any]", value)
    kinds = [key for key in item if key not in ("name", "policy")]
    if not kinds:
        raise setting_error("this step has no action", "a mapping such as 'image: {exposure: 45 ms}'")
    if len(kinds) > 1:
        what = f"'{clean(kinds[1])}' is in the same step as '{clean(kinds[0])}'"
        hint = f"begin a new step with '- ', or indent settings of '{clean(kinds[0])}' further"
        raise setting_error(what, "one step in each item of the list", hint, at=(kinds[1],), key=True)
    kind, settings = kinds[0], item[kinds[0]]
    if settings is not None and not isinstance(settings, dict):
        expected = "a mapping of settings such as {key: value}"
        hint = "put a space after the ':'" if ":" in kind else ""
        raise setting_error(f"{clean(kind)} is {shown(settings)}", expected, hint, at=(kind,))
    name = item.get("name", "")
    if "name" in item and not (isinstance(name, str) and _WORD.fullmatch(name)):
        expected = "a word of letters, digits, '_' and '-' that begins with a letter"
        raise setting_error(f"the name of the step is {shown(name)}", expected, at=("name",))
    return StepSpec(kind, cast("str", name), (kind,))


def _numbered(steps: tuple[StepSpec, ...]) -> tuple[StepSpec, ...]:
    """Add to each step its location, and raise for duplicate names."""
    first: dict[str, int] = {}
    for i, step in enumerate(steps):
        if step.name and first.setdefault(step.name, i) != i:
            what = f"the name '{step.name}' is taken by step {first[step.name]} (counted from 0)"
            raise setting_error(what, "another name", at=(i, "name"))
    return tuple(replace(step, loc=("shot", i, step.kind)) for i, step in enumerate(steps))


Steps: TypeAlias = Annotated[
    tuple[Annotated[StepSpec, PlainValidator(_step)], ...], Field(min_length=1), AfterValidator(_numbered)
]
"""The steps of a shot, in order."""


class LeaderPermissions(Settings):
    """``leader`` of a sequence: the settings that another control system may change for each shot."""

    may_set: Annotated[tuple[Text, ...], Field(min_length=1)] = Field(
        description="addresses in `planner`, `target`, `shot.N.<step>` or `variables`, as for `--set`"
    )


class SequenceSpec(Settings):
    """A sequence file. The settings of its plugins are checked later."""

    labseq: FormatVersion = Field(description="version of the file format: 1")
    name: Name = Field(description="name of the sequence and of its run folders")
    profile: Text = Field(default="virtual", description="hardware profile: a name, or a path to its file")
    shots: int = Field(ge=1, le=1_000_000, description="how many shots a run takes")
    seed: Annotated[int, Field(ge=0, lt=2**63)] | None = Field(
        default=None, description="seed of all random numbers. Without it, each run draws a new seed"
    )
    target: Annotated[PatternChoice, placed_by_field] | None = Field(
        default=None,
        description="the final pattern of atoms. Only a sequence that rearranges needs it",
    )
    planner: Annotated[Choice, placed_by_field] = Field(description="the plugin that plans the moves")
    record_frames: Literal["all", "last", "none"] = Field(
        default="all", description="which camera frames of a shot are kept"
    )
    attempts: int = Field(
        default=3, ge=1, le=100, description="number of attempts at a shot before the run stops"
    )
    policy: Annotated[PolicySettings, empty_is({})] = Field(
        default=PolicySettings(),
        description="reactions to failures, exceeded budgets and quantities out of range",
    )
    alarms: bool = Field(
        default=True,
        description="whether shots give the alarms of the profile. Use false if no atoms are expected",
    )
    plugin_folders: Folders = Field(default=[], description="folders with plugins, relative to this file")
    scan: dict[str, Any] | list[dict[str, Any]] | None = Field(
        default=None, description="addresses whose values change from shot to shot"
    )
    repeats: int = Field(default=1, ge=1, le=1_000_000, description="shots at each point of the scan")
    order: ScanOrder = Field(default="sequential", description="order of the scan's shots")
    leader: LeaderPermissions | None = Field(
        default=None, description="settings that another control system may change with `go`"
    )
    measure: Measures = Field(
        default=None,
        description="the quantities that the run measures, the most important first. By default "
        "`filling` and `defect_free` with a target, else the survival between the last two images",
    )
    regions: Regions = Field(
        default={},
        description="named sets of sites for quantities (`filling@corner`): rows and columns `'0:4,0:4'`, "
        "a list of sites `[[0, 0], [3, 5]]`, or a pattern as a target has it, such as a drawing",
    )
    variables: Variables = Field(default={}, description="numbers and quantities that expressions refer to")
    analysis: Analyses = Field(default=(), description="analyses of each shot, in parallel to the run")
    shot: Steps = Field(description="the steps of a shot")


_FALLBACKS: Final = FallbackValues(
    values={
        "labseq": FORMAT,
        "name": "x",
        "shots": 1,
        "target": {"pattern": "compact", "rows": 1, "cols": 1},
        "planner": {"use": DEFAULT_PLANNER},
        "shot": [{"image": {}}],
    },
    items={"shot": {"image": {}}},
)


def load_sequence(
    path: Path,
    overrides: Sequence[Override] = (),
    *,
    profile_set: Sequence[Override] = (),
    problems: ProblemCollector | None = None,
    kept: StoredText | None = None,
) -> tuple[Document, SequenceSpec, Scan | None]:
    """Read a sequence file.

    Args:
        overrides: Values that replace those in the file.
        profile_set: Overrides of the profile, with their "profile.". They replace a scan of their address.

    Returns:
        The document with overrides, the default planner and the first point of its scan, its content with
        fallbacks for wrong values, and its scan, whose axes in the profile have no locations yet.

    Raises:
        ConfigError: All errors, except in settings of plugins.
    """
    document = Document.read(path, kept)
    check_kind(document, "sequence")
    if document.get(("planner",)) is None:
        # as an override, so that messages about it give no place in the file
        document = document.override("planner", f"{{use: {DEFAULT_PLANNER}}}", "the default planner")
    with collecting(problems) as collector:
        document = document.override_all(overrides, collector, may_add=("policy",)).evaluated()
        scan: Scan | None = None
        # before the values of the file are checked, because the first point replaces some of them
        if document.get(("scan",)) is None:
            _refuse_without_scan(document, collector)
        else:
            from labseq.config.scan import load_scan  # a sequence without a scan does not need it

            document, scan = load_scan(document, overrides, profile_set, collector)
        return *load_checked(document, SequenceSpec, "a sequence", _FALLBACKS, collector), scan


def _refuse_without_scan(document: Document, problems: ProblemCollector) -> None:
    """Find settings of a scan in a sequence without one."""
    for key in ("repeats", "order"):
        if document.get((key,)) is not None:
            what = f"'{key}' is given without a scan"
            problems.add(document.error((key,), what, "a 'scan' as well", key=True))
