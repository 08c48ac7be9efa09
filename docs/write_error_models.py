"""Writes docs/error_models.md from the error models themselves: `python docs/write_error_models.py`."""

from __future__ import annotations

import inspect
from pathlib import Path

from magtensor.components import Component
from magtensor.error_models.example import example_survey
from magtensor.error_models.settings import (
    AnyChannel,
    AsAWhole,
    Beginning,
    Choice,
    Delays,
    Duration,
    EventTimes,
    Forms,
    Frequencies,
    Range,
)
from magtensor.registry import Registry

PAGE = Path(__file__).with_name("error_models.md")
BUILT_IN = "magtensor"
KINDS = {
    "instrument": "Errors of the sensors or the platform; corrected in every survey.",
    "site": "Real fields at the place of the calibration; modelled there, never taken off another survey's field.",
    "reference": "Errors of the base station; they correct the total field.",
}
INTRODUCTION = """# Error models

Every error of an array that `magtensor` knows beside the linear one (scale, non-orthogonality, soft iron, misalignment,
offset). An error model gives regressors: what a unit of each coefficient adds to the raw outputs in nT, or to the
reference total field. From them follow the fit, the search for undeclared effects, and the correction. What is not
linear in a coefficient is a *setting*; a search tries the values named here.

The regressors are made from the modelled outputs and field (C b + o of the fitted field), from logged channels less
their mean over the calibration survey, and from time since the survey's start; never from the noisy raw outputs.

This page is written by `docs/write_error_models.py` from the models' own words; a test keeps it so.
"""
WRITING = """## Writing one

A function with the decorator `error_model` is enough. `examples/plugins/feedback_heating.py` is one in a single file
for a folder of plugins; `examples/feedback_heating/` is the same as a package of two files that `pip install` brings to
every recipe.

- The first argument is an `Excitation`: `time`, `elapsed`, `output`, `field`, `channel(name, lag_s)` and
  `thermometer(name, lag_s)`, `attitude`, `position`, and what is made of them: `derivative`, `relaxed` (a first-order
  lag of what turns with the platform, within each run), `lagged` (of what may jump, across gaps), `gradient`,
  `sensed` (what the sensors make of a vector).
- It returns `Terms`, most simply by `x.offsets` (a series on every axis), `x.scales` (a series times each axis's own
  output), `x.responses` (a series for each axis), `x.matrices` (a vector through nine coefficients a sensor),
  `x.one_each` (one coefficient a sensor), `x.shared` (one for all), `x.on_reference`; of a vector that sensors see,
  times a course, `x.one_each_sensing` and `x.shared_sensing` are the same at a fraction of the cost; `joined` puts
  several together.
- Keyword parameters are settings: a type, how it is profiled (`Range`, `Choice`, `Orders`, `Laws`, `Forms`,
  `Beginning`, `AnyChannel`, `EventTimes`, `Frequencies`, `Duration`), a description, and a default.
- `needs` names what it cannot do without: channels (`current_*`), `attitude`, `position`, `total_field`, `turning`
  (the platform does not stand still), `rotation` (samples dense enough for rates of change), `gradient` (a field that
  differs between the sensors); `a|b` where one of two will do.
- `pointwise=True` says that its regressors at a sample follow from that sample alone (channels and thermometers may
  be lagged); settings with many values are then searched faster. `agrees=function(x, settings, coefficients,
  explained)` says whether fitted coefficients are what the settings assume, where both mean one thing, and explain as
  large a share of |b| - F as such coefficients must; the loop adopts nothing of which they are not.
  `about=function(settings, coefficients)` gives the settings about which a model that is linear only nearby is to be
  made for such coefficients. `means=function(x, settings, coefficients)` says in a few words what coefficients, by
  sensor and name, mean together: the verdict holds it as `means` beside them, and its sentence in brackets.

`check_error_model(my_model)` of `magtensor.loop.checker` gives a list of everything that is wrong with it; put
`assert check_error_model(my_model) == []` into your tests.
"""


def page() -> str:
    """The whole page."""
    registry = Registry.load()
    models = [
        c for (kind, _, _), c in sorted(registry.components.items())
        if kind == "error_model" and registry.origin[kind, "", c.name].distribution == BUILT_IN
    ]  # fmt: skip
    parts = [INTRODUCTION]
    for kind, meaning in KINDS.items():
        own = [m for m in models if m.effect == kind]
        parts.append(f"## {kind.capitalize()}\n\n{meaning}\n")
        parts.append("| name | what | usual size |\n|---|---|---|\n" + "\n".join(_row(m) for m in own) + "\n")
        parts += [_section(m) for m in own]
    return "\n".join([*parts, WRITING])


def _row(model: Component) -> str:
    return f"| [`{model.name}`](#{model.name}) | {model.summary} | {model.typical} |"


def _section(model: Component) -> str:
    lines = [f"### {model.name}\n", inspect.getdoc(model.function) or "", ""]
    coefficients = _coefficients(model)
    if coefficients:
        lines.append(f"- Coefficients for four sensors: {coefficients}")
    if model.declared({}).needs:
        needs = (" or ".join(f"`{n}`" for n in need.split("|")) for need in model.declared({}).needs)
        lines.append(f"- Needs: {', '.join(needs)}")
    for name, parameter in model.parameters.items():
        marks = [_in_words(m) for m in getattr(parameter.annotation, "__metadata__", ()) if hasattr(m, "values")]
        tried = f" Tried: {marks[0]}." if marks else ""
        description = model.options.model_fields[name].description
        lines.append(f"- Setting `{name}` = {parameter.default!r}: {description}.{tried}")
    lines += [f"- Usual size: {model.typical}", f"- Source: {model.source}", ""]
    return "\n".join(lines)


def _coefficients(model: Component) -> str:
    """How many, in which units, as for a survey with one channel of each kind."""
    terms = model.function(example_survey(model))
    return f"{terms.count}, in {', '.join(dict.fromkeys(terms.units))}"


def _in_words(mark: object) -> str:
    if isinstance(mark, Delays):
        grid = f"{mark.count} within {mark.evenly:g}, growing by half up to {mark.high:g}, and whole hours"
        return f"{grid}, as far as the station's readings reach; the best refined"
    if isinstance(mark, Range):
        share = " of the survey's duration" if mark.of_duration else ""
        return f"{mark.low:g} to {mark.high:g}{share} in {mark.count} {mark.spacing} steps, the best refined"
    if isinstance(mark, AsAWhole):
        return (
            "False; True with the delays that what is left has most in common with, and once it is adopted, if better"
        )
    if isinstance(mark, Forms):
        others = " or ".join(repr(o) for o in mark.options[1:]) or "a curve"  # of `Bends`
        return f"{mark.options[0]!r}; {others} once it is adopted, if that is better"
    if isinstance(mark, Choice):
        return ", ".join(repr(o) for o in mark.options)
    if isinstance(mark, AnyChannel):
        units = f", and channels in units like {mark.or_units}" if mark.or_units else ""
        return f"`{mark.pattern}`{units}"
    if isinstance(mark, EventTimes):
        return f"{mark.count} times in the survey"
    if isinstance(mark, Frequencies):
        return f"the {mark.count} strongest lines of the residual's spectrum, the best refined"
    if isinstance(mark, Beginning):
        return "0; fitted together with a lag, if that is better, and anew on another survey"
    if isinstance(mark, Duration):
        return "the survey's duration"
    return type(mark).__name__


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
