"""A checker for authors of error models: everything that can be known of one without data.

    def test_my_model():
        assert check_error_model(my_model) == []

It works on small made-up surveys (`example_survey`), which have every channel that the model's needs and settings name.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from itertools import combinations, product
from typing import Any

import numpy as np

from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.components import Component, PluginError, component_of
from magtensor.error_models.delays import cleared
from magtensor.error_models.example import example_survey
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.needs import FACTS, missing
from magtensor.error_models.settings import AnyChannel, Choice, EventTimes, Range, profiled
from magtensor.error_models.terms import REFERENCE, Terms
from magtensor.loop.correcting.correction import corrected_raw
from magtensor.loop.fitting.model import Adopted, Record

TRIED = 24  # combinations of settings at most
APART = 0.1  # of the survey, by which two times of one model differ: between them is more than a sample
DEPENDENT = 1e-9  # singular value, relative, below which regressors are linearly dependent
DISTORTION_NT = 0.1  # rms that the effect adds in the round trip: little enough beside the differences between sensors
RECOVERED_NT = 1e-3  # what the round trip may leave


def check_error_model(candidate: Component | Callable[..., Terms]) -> list[str]:
    """What is wrong with an error model, one line each; empty where nothing is.

    Parameters
    ----------
    candidate: the marked function, or its component.
    """
    component = candidate if isinstance(candidate, Component) else component_of(candidate)
    if component is None or component.kind != "error_model":
        return [f"{candidate!r} is not marked with @error_model"]
    try:
        _ = component.options
    except PluginError as error:
        return [str(error)]
    problems = _documentation(component) + _settings(component) + _pickling(component)
    for title, survey in _surveys(component).items():
        if missing(component, survey):
            continue
        idle: set[str] | None = None
        for settings in _combinations(component, survey):
            found = _regressors(component, survey, settings, dense=title == "tumbling")
            problems += [f"{title}{_shown(settings)}: {p}" for p in found]
            if found:
                break  # the other settings most likely fail in the same way
            if title == "tumbling":
                now = set(_idle(component.function(survey, **settings), len(survey.sensors)))
                idle = now if idle is None else idle & now
        else:
            if idle:  # with a threshold that no channel here reaches it is no fault
                which = ", ".join(sorted(idle))
                problems.append(f"{title}: the regressors of {which} are zero throughout, with whatever settings")
    return list(dict.fromkeys(problems))


def _surveys(component: Component) -> dict[str, Excitation]:
    made = {
        "tumbling": example_survey(component),
        "uniform field": example_survey(component, uniform=True),
        "static postures": example_survey(component, postures=True),
        "one sensor": example_survey(component, sensors=1),
        "twelve sensors": example_survey(component, sensors=12),
    }
    for survey in made.values():
        every = [survey.time, survey.output, survey.field, survey.total_field, survey.position, survey.attitude]
        for values in (*every, *survey.logged.values(), survey.run, survey.segment):
            if values is not None:
                values.setflags(write=False)  # an error model that changes what it is given fails here
    return made


def _documentation(component: Component) -> list[str]:
    found = []
    if not component.summary:
        found.append("no docstring: its first paragraph says what goes wrong in the instrument")
    if not component.source:
        found.append("no source: @error_model(..., source=) says where the model comes from")
    if not component.typical:
        found.append("no typical magnitude: @error_model(..., typical=) says what to expect")
    if component.effect not in ("instrument", "site", "reference"):
        found.append(f"its kind is {component.effect!r}; instrument, site or reference would be right")
    for need in component.declared({}).needs:
        for word in need.split("|"):
            near = [] if word in FACTS else get_close_matches(word, FACTS, n=1, cutoff=0.8)
            if near:
                found.append(f"needs {word!r}, which is taken for the name of a channel (did you mean {near[0]}?)")
    return found


def _settings(component: Component) -> list[str]:
    found = []
    for name, parameter in component.parameters.items():
        field = component.options.model_fields[name]
        if not field.description:
            found.append(f"setting {name} has no description: Annotated[..., Field(description=)]")
        if field.is_required():
            found.append(f"setting {name} has no default, so that no recipe can declare the model without it")
            continue
        for mark in getattr(parameter.annotation, "__metadata__", ()):
            if isinstance(mark, Range) and not mark.of_duration and not mark.low <= field.default <= mark.high:
                found.append(f"setting {name}: the default {field.default!r} is not between {mark.low} and {mark.high}")
            if isinstance(mark, Choice) and field.default not in mark.options:
                found.append(f"setting {name}: the default {field.default!r} is none of {mark.options}")
    return found


def _pickling(component: Component) -> list[str]:
    try:
        same = pickle.loads(pickle.dumps(component.function)) is component.function
    except (pickle.PicklingError, AttributeError, ImportError, TypeError) as error:
        return [f"cannot be pickled ({error}): a function at the top of a module can"]
    return [] if same else ["does not survive pickling: the module's name must stand for the same function"]


def _grids(component: Component, x: Excitation) -> dict[str, list[Any]]:
    grids = {}
    for name, parameter in component.parameters.items():
        for mark in getattr(parameter.annotation, "__metadata__", ()):
            if callable(getattr(mark, "values", None)):
                values = list(mark.values(x))
                grids[name] = values if len(values) <= 3 else [values[0], values[len(values) // 2], values[-1]]
    return grids


def _combinations(component: Component, x: Excitation) -> list[dict[str, Any]]:
    """The defaults, and combinations of the ends and the middle of each setting's grid."""
    grids = _grids(component, x)
    every = [dict(zip(grids, values, strict=True)) for values in product(*grids.values())]
    times = [n for n, mark in profiled(component).items() if isinstance(mark, EventTimes)]
    every = [c for c in every if all(abs(c[a] - c[b]) > APART * x.duration for a, b in combinations(times, 2))]
    step = max(1, len(every) // TRIED)
    defaults: list[dict[str, Any]] = [{}] if _only_one_channel_each(component, x) else []
    return defaults + every[::step]


def _only_one_channel_each(component: Component, x: Excitation) -> bool:
    marks = [m for p in component.parameters.values() for m in getattr(p.annotation, "__metadata__", ())]
    return all(len(m.values(x)) == 1 for m in marks if isinstance(m, AnyChannel))


def _regressors(component: Component, x: Excitation, settings: Mapping[str, Any], dense: bool) -> list[str]:
    """Everything about the terms of one survey with one combination of settings."""
    try:
        terms = component.function(x, **settings)
        again = component.function(x, **settings)
    except Exception as error:  # whatever a stranger's code raises is told, not passed on
        return [f"{type(error).__name__}: {error}"]
    if not isinstance(terms, Terms):
        return [f"gives {type(terms).__name__}; magtensor.error_models.terms.Terms would be right"]
    found = _shape(terms, x)
    if found:
        return found
    if not np.isfinite(terms.series).all():
        found.append("its regressors are not all finite")
    if not _same(terms, again):
        found.append("gives something else when called again: use no randomness, keep no state")
    if any(not units for units in terms.units):
        found.append("a coefficient has no units ('1' for a pure number)")
    if component.pointwise:
        some = np.arange(0, len(x.time), 3)
        alone = component.function(x.at(some), **settings).series
        if not np.allclose(alone, terms.series[some], rtol=1e-9, atol=1e-12 * np.abs(terms.series).max(initial=0.0)):
            found.append("is marked pointwise, but its regressors at a sample depend on other samples")
    keys = list(zip(terms.names, terms.sensors, strict=True))
    if len(set(keys)) < len(keys):
        twice = sorted({f"{n} {s}".strip() for n, s in keys if keys.count((n, s)) > 1})
        found.append(f"several coefficients have one name: {', '.join(twice)}")
    on_reference = terms.part_output == REFERENCE
    if component.effect == "reference" and not on_reference.all():
        found.append("is of the reference but acts on the sensors")
    if component.effect != "reference" and on_reference.any():
        found.append(f"is of kind {component.effect} but acts on the reference")
    if dense and not found and not _idle(terms, len(x.sensors)):
        found += _independence(terms, len(x.sensors)) + _round_trip(component, x, settings)
    return found


def _shape(terms: Terms, x: Excitation) -> list[str]:
    p, parts = len(terms.names), len(terms.part_term)
    if not p:
        return ["gives no coefficients"]
    if len(terms.sensors) != p or len(terms.units) != p:
        return [f"has {p} names, {len(terms.sensors)} sensors and {len(terms.units)} units: as many would be right"]
    if terms.series.ndim != 2 or len(terms.series) != len(x.time):
        return [f"its series are {terms.series.shape}; ({len(x.time)}, K) would be right"]
    if not len(terms.part_output) == len(terms.part_series) == len(terms.part_weight) == parts:
        return ["part_term, part_output, part_series and part_weight differ in length"]
    if set(terms.sensors) - set(x.sensors) - {""}:
        return [f"names sensors that the survey has not: {', '.join(sorted(set(terms.sensors) - set(x.sensors)))}"]
    limits = (
        ("part_term", terms.part_term, 0, p),
        ("part_output", terms.part_output, REFERENCE, 3 * len(x.sensors)),
        ("part_series", terms.part_series, 0, terms.series.shape[1]),
    )
    found = [
        f"{name} goes from {values.min()} to {values.max()}; {low} to {high - 1} would be right"
        for name, values, low, high in limits
        if len(values) and (values.min() < low or values.max() >= high)
    ]
    idle = sorted(set(range(p)) - set(terms.part_term.tolist()))
    return found + [f"coefficient {terms.names[i]} {terms.sensors[i]} acts on nothing" for i in idle]


def _same(one: Terms, other: Terms) -> bool:
    words = (one.names, one.sensors, one.units) == (other.names, other.sensors, other.units)
    pairs = [(one.series, other.series), (one.part_term, other.part_term)]
    pairs += [(one.part_output, other.part_output), (one.part_series, other.part_series)]
    pairs += [(one.part_weight, other.part_weight)]
    return words and all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in pairs)


def _dense(terms: Terms, sensors: int) -> Array:
    """(N (3 S + 1), P): each coefficient's effect on every output and on the reference."""
    each = [
        np.column_stack([terms.contribution(unit, 3 * sensors), terms.on_reference(unit)]).ravel()
        for unit in np.eye(terms.count)
    ]
    return np.stack(each, axis=1)


def _idle(terms: Terms, sensors: int) -> list[str]:
    """The coefficients that do nothing."""
    size = np.linalg.norm(_dense(terms, sensors), axis=0)
    return [f"{terms.names[i]} {terms.sensors[i]}".strip() for i in np.flatnonzero(size == 0)]


def _independence(terms: Terms, sensors: int) -> list[str]:
    columns = _dense(terms, sensors)
    size = np.linalg.norm(columns, axis=0)
    normal = (columns / size).T @ (columns / size)
    rank = int((np.linalg.eigvalsh(normal) > DEPENDENT).sum())
    return [] if rank == terms.count else [f"its {terms.count} regressors are linearly dependent: rank {rank}"]


def _round_trip(component: Component, x: Excitation, settings: Mapping[str, Any]) -> list[str]:
    """Distort the outputs by the effect, then correct them as `apply` does."""
    if component.effect != "instrument":
        return []
    model = Adopted(component, settings)
    terms = model.terms(x)
    outputs = 3 * len(x.sensors)
    strength = np.array([np.sqrt(np.mean(terms.contribution(unit, outputs) ** 2)) for unit in np.eye(terms.count)])
    unlike = np.sqrt(2.0) * np.cos(2.4 * np.arange(terms.count))  # what all sensors share would be a field
    theta = DISTORTION_NT / strength / np.sqrt(terms.count) * unlike
    distorted = cleared(x.output, x.time, x.run, [terms], [-theta])
    offset = (x.output - x.sensed(x.field)).mean(axis=0)
    inverse = np.asarray(np.linalg.inv(x.matrix), dtype=float)
    linear = ArrayCalibration(inverse, offset, np.full((4 * outputs, 4 * outputs), np.nan), "platform")
    off = corrected_raw(_record(x, distorted), linear, [model], [theta]) - x.output
    left = float(np.abs(off).max())
    if left < RECOVERED_NT:
        return []
    return [f"distorted and corrected again, outputs are off by {left:.2g} nT: the regressors change too much with b"]


def _record(x: Excitation, raw: Array) -> Record:
    return Record(
        time=x.time,
        start=x.start,
        raw=raw,
        total_field=x.total_field,
        quiet_field=x.total_field,
        sensors=x.sensors,
        logged=x.logged,
        origins={name: np.zeros(values.shape[1:]) for name, values in x.logged.items()},
        units=x.units,
        run=x.run,
        segment=x.segment,
        position=x.position,
        attitude=x.attitude,
        samples=np.arange(len(x.time)),
    )


def _shown(settings: Mapping[str, Any]) -> str:
    return f" ({', '.join(f'{k}={v}' for k, v in settings.items())})" if settings else ""
