"""Checks the fits of a sequence, and the conditions under which they end the run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from labseq.config.document import Document
from labseq.config.scan import Scan, numbers_of
from labseq.config.sequence import MeasureSettings, SequenceSpec
from labseq.data.fit_models import MODELS
from labseq.data.fits import parameter_unit
from labseq.data.precision import read_limit
from labseq.data.quantities import make_quantity
from labseq.errors import ConfigError, Loc, PluginLoadError, UnknownPluginError, one_of
from labseq.messages import clean, did_you_mean
from labseq.model import TargetPattern
from labseq.plugins.host import PluginHost
from labseq.units import dimension_of, si_unit_of

if TYPE_CHECKING:
    from labseq.data.fits import Model


def check_fit(
    document: Document,
    sequence: SequenceSpec,
    scan: Scan | None,
    number: int,
    target: TargetPattern | None,
    host: PluginHost,
) -> None:
    """Check that a quantity can be fitted as its sequence says.

    Args:
        document: The sequence's file.
        sequence: Its content.
        scan: Its scan. None without a scan, or if it has errors.
        number: Index of the quantity in the run's list.
        target: The target. None if it has errors.
        host: The plugins.

    Raises:
        ConfigError: There is no such model or parameter, no scan of a number, or no such error.
    """
    place: Loc = ("measure", number)
    measure = (sequence.measure or ())[number]
    name = measure.fit or ""
    model = find_model(document, (*place, "fit"), name, host)
    if sequence.scan is None:
        what = "a fit needs a scan"
        raise document.error((*place, "fit"), what, "'scan' in the sequence")
    named = [("report", measure.report)] if measure.report else []
    named += [("parameters", name) for name in measure.parameters]
    named += [("stop_when", name) for name in measure.stop_when]
    for key, parameter in named:
        if parameter not in model.units:
            hint = did_you_mean(parameter, model.units)
            what = f"the model '{clean(name)}' has no parameter '{clean(parameter)}'"
            is_key = key != "report"
            loc = (*place, key, parameter) if is_key else (*place, key)
            raise document.error(loc, what, one_of([*model.units]), hint, is_key)
    units = _scanned_unit(document, place, scan), _unit_of_quantity(measure, target)
    if measure.stop_when:
        _check_stop(document, sequence, place, measure, model, units)


def find_model(document: Document, place: Loc, name: str, host: PluginHost) -> Model:
    """A model of labseq or of a plugin.

    Raises:
        ConfigError: There is no such model, or its plugin failed.
    """
    if name in MODELS:
        return MODELS[name]
    from labseq.data.lab_models import lab_model_of  # takes a while to import

    try:
        return lab_model_of(host, name)
    except UnknownPluginError as error:
        known = [*MODELS, *error.known]
        hint = did_you_mean(name, known) or error.hint
        raise document.error(place, f"there is no model '{clean(name)}'", one_of(known), hint) from None
    except PluginLoadError as error:
        raise document.error(place, str(error)) from None


def _scanned_unit(document: Document, place: Loc, scan: Scan | None) -> str:
    """The SI unit of the fit's x axis, which is the first scanned address with several values."""
    if scan is None or not scan.axes:  # an option may have replaced every address
        return ""
    several = (axis for axis in scan.axes if len({str(value.plain()) for value in axis.values}) > 1)
    axis = next(several, scan.axes[0])
    try:
        return si_unit_of(f"1 {numbers_of(axis.values)[0].unit}")
    except ConfigError:
        what = f"a fit needs numbers, but the values of '{clean(axis.address)}' are not"
        raise document.error((*place, "fit"), what, "a scan of a number") from None


def _unit_of_quantity(measure: MeasureSettings, target: TargetPattern | None) -> str:
    quantity = make_quantity(measure.value, target or TargetPattern.none((1, 1)))
    return "%" if quantity.is_fraction else quantity.unit


def _check_stop(
    document: Document,
    sequence: SequenceSpec,
    place: Loc,
    measure: MeasureSettings,
    model: Model,
    units: tuple[str, str],
) -> None:
    """Check the errors at which the run ends.

    Raises:
        ConfigError: An error is unreadable, its parameter is fixed, or the scan's order is not shuffled.
    """
    fixed = {name for name in model.fixed if name not in measure.parameters}
    fixed |= {name for name, value in measure.parameters.items() if value != "free"}
    for name, written in measure.stop_when.items():
        loc: Loc = (*place, "stop_when", name)
        if name in fixed:
            what, hint = f"'{clean(name)}' is fixed", f"write 'parameters: {{{clean(name)}: free}}'"
            raise document.error(loc, what, "a parameter that is fitted", hint, key=True)
        unit = parameter_unit(model.units[name], *units)
        try:
            read_limit(written, unit)
        except ValueError as error:
            # a sequence cannot have units such as %/s
            limit = f"0.1 {unit}" if dimension_of(unit) else f"a number in {unit.replace('%', '1')}"
            expected = f"the error to reach: 2 % of the value, or {'0.01' if unit in ('', '%') else limit}"
            raise document.error(loc, str(error), expected) from None
    if sequence.order != "shuffled":
        what = "the run cannot end early because it takes all shots of a point before the next point"
        hint = "write 'order: shuffled' and 'repeats'"
        expected = "a scan that takes its points in rounds"
        raise document.error((*place, "stop_when"), what, expected, hint, key=True)
