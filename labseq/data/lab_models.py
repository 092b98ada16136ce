"""A lab's own fit models: lmfit models that plugins offer by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from labseq.data.fit_models import MODELS, Points, Solution
from labseq.data.least_squares import Floats
from labseq.data.reader import Run
from labseq.errors import ConfigError, PluginLoadError, Problem, UnknownPluginError, one_of
from labseq.files import PLUGINS
from labseq.messages import clean, did_you_mean
from labseq.model.estimate import Estimate
from labseq.plugins.calls import call_plugin
from labseq.plugins.host import PluginHost
from labseq.registry import Entry
from labseq.settings import path_beside
from labseq.text_files import is_folder

T = TypeVar("T")

MAX_WAIT_S: Final = 30.0
"""How long a plugin may take to load, or to do one fit."""
METHODS: Final = ("fit", "eval", "guess", "make_params", "param_names", "param_hints", "independent_vars")
"""What labseq uses of an lmfit model. Only the plugin imports lmfit."""


@dataclass(frozen=True, slots=True, eq=False)
class LabModel:
    """An lmfit model of a plugin, with the attributes of :class:`labseq.data.fit_models.FitModel`."""

    entry: Entry
    model: Any
    formula: str
    units: Mapping[str, str]
    fixed: Mapping[str, float]
    significance: Mapping[str, float]
    without: Mapping[str, float]
    advice: str

    def solve(
        self, points: Points, fixed: Mapping[str, float], near: Solution | None = None
    ) -> Solution | None:
        """Fit the parameters that are not fixed. None if the fit does not converge.

        Raises:
            ConfigError: Code of the plugin raised, did not return, or returned something other than values.
        """
        return _called(self.entry, lambda: self._solve(points, fixed, near))

    def _solve(self, points: Points, fixed: Mapping[str, float], near: Solution | None) -> Solution | None:
        scanned = {self.model.independent_vars[0]: points.x}
        parameters = self._start(points)
        for name in self.units:
            parameters[name].set(vary=name not in fixed)
        for name, value in (fixed if near is None else {**near.start, **fixed}).items():
            parameters[name].set(value=value)
        if unknown := [name for name in self.units if not math.isfinite(parameters[name].value)]:
            remedy = f"write model.set_param_hint('{unknown[0]}', value=...)"
            raise self.entry.owner.fault(f"fit '{self.entry.name}' lacks a starting value; {remedy}")
        self._check_values(self.model.eval(parameters, **scanned), points.x)
        weights, by_scatter = 1 / points.error, not points.has_errors
        result = self.model.fit(points.y, parameters, weights=weights, scale_covar=by_scatter, **scanned)
        if not result.success:
            return None
        errors = {name: one.stderr for name, one in result.params.items()}
        values = {
            name: Estimate(float(one.value), math.nan if errors[name] is None else float(errors[name]))
            for name, one in result.params.items()
            # lmfit adds parameters that follow from the others, such as the width at half maximum
            if name in self.units or errors[name]
        }
        values |= {name: Estimate(value, 0.0) for name, value in fixed.items()}
        function = partial(_evaluate, self.model, result.params)
        return Solution(values, float(result.redchi) if points.has_errors else math.nan, function)

    def _start(self, points: Points) -> Any:
        """The parameters at their starting values from the model's guess, or else from its hints."""
        try:
            return self.model.guess(points.y, points.x)
        except NotImplementedError:
            return self.model.make_params()

    def _check_values(self, values: Any, x: Floats) -> None:
        array = np.asarray(values)
        if array.shape == x.shape and array.dtype.kind in "iuf":
            return
        code = getattr(getattr(self.model, "func", None), "__code__", None)
        place = f" ({code.co_filename}:{code.co_firstlineno})" if code is not None else ""
        came = f"values of shape {array.shape} and type {array.dtype} for {len(x)} points"
        raise self.entry.owner.fault(
            f"fit '{self.entry.name}' returned {came}; expected one number for each{place}"
        )


def _evaluate(model: Any, parameters: Any, x: Floats) -> Floats:
    return np.asarray(model.eval(parameters, **{model.independent_vars[0]: x}), np.float64)


def find_lab_model(run: Run, name: str) -> LabModel:
    """A model from an installed plugin or from one of the run's plugin folders.

    Raises:
        ConfigError: There is no such model, or its plugin has an error. The message says which.
    """
    host = PluginHost(MAX_WAIT_S)
    host.load_entry_points()
    host.load_folders(plugin_folders_of(run))
    try:
        return lab_model_of(host, name)
    except UnknownPluginError as error:
        known = [*MODELS, *error.known]
        hint = did_you_mean(name, known) or error.hint
        problem = f"there is no fit '{clean(name)}'"
        raise ConfigError(Problem(problem, "--fit", expected=one_of(known), hint=hint)) from error
    except PluginLoadError as error:
        raise _fault(error) from error


def lab_model_of(host: PluginHost, name: str) -> LabModel:
    """A model from one of the loaded plugins.

    Raises:
        UnknownPluginError: No plugin offers it.
        PluginLoadError: The plugin has an error.
    """
    entry = host.get("fit", name)
    return call_plugin(entry.owner, f"fit '{name}'", lambda: _made(entry))


def _made(entry: Entry) -> LabModel:
    model = entry.factory()
    if missing := [name for name in METHODS if not hasattr(model, name)]:
        came = f"a {type(model).__name__}, without {missing[0]}"
        raise entry.owner.fault(f"fit '{entry.name}' returned {came}; expected an lmfit.Model")
    # parameters with an expression follow from the others
    names = {one for one in model.param_names if not model.param_hints.get(one, {}).get("expr")}
    parameters = [one for one in model.make_params().values() if one.name in names]
    return LabModel(
        entry,
        model,
        str(model.name),
        {one.name: entry.units.get(one.name, "") for one in parameters},
        {one.name: float(one.value) for one in parameters if not one.vary},
        {},
        {},
        "points that follow the model, other starting values in the plugin, or fewer parameters (--fit-set)",
    )


def plugin_folders_of(run: Run) -> list[Path]:
    """The plugin folders of a run's sequence, then those of its profile, as the run loaded them."""
    resolved: Mapping[str, Any] = run.record.get("resolved") or {}
    named = (("sequence_path", resolved), ("profile_path", resolved.get("profile") or {}))
    paths = [
        (folder, path_beside(Path(run.record[path]).parent, folder))
        for path, settings in named
        for folder in settings.get("plugin_folders", ())
    ]
    # every file that `labseq new` writes names this folder, which need not exist
    return [path for folder, path in paths if folder != PLUGINS or is_folder(path)]


def _called(entry: Entry, work: Callable[[], T]) -> T:
    """Run code of a plugin. An error in it becomes an error of the fit, with file and line."""
    try:
        return call_plugin(entry.owner, f"fit '{entry.name}'", work)
    except PluginLoadError as error:
        raise _fault(error) from error


def _fault(error: PluginLoadError) -> ConfigError:
    return ConfigError(Problem(f"plugin '{error.plugin}': {error.reason}", "--fit"))
