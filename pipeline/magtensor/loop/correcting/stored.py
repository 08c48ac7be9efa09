"""Adopted effects in a calibration file: written, read again, and taken off another survey."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.error_models.needs import FACTS
from magtensor.error_models.settings import NOT_KNOWN, AnyChannel, Beginning, Duration, EventTimes, profiled
from magtensor.error_models.waveform import NAME
from magtensor.errors import DataError, UsageError
from magtensor.loop.correcting.another_survey import TONE, WARM_UP, shows_a_state, tone_here, unknown
from magtensor.loop.correcting.beyond import extrapolated, seen_here
from magtensor.loop.correcting.correction import corrected_raw, corrected_reference, hidden_objection, on_its_time
from magtensor.loop.correcting.dates import LONG, as_dated_here
from magtensor.loop.correcting.lengths import AVERAGING, contradicted, refuted
from magtensor.loop.fitting.model import Adopted, Record, unread
from magtensor.loop.fitting.record import channels_of, record_of
from magtensor.registry import Registry
from magtensor.survey.flags import flag_ranges
from magtensor.survey.model import Survey, Variable
from magtensor.survey.times import split_since

SHIFTED = "the log of what an effect follows is late or early"
MISSES = 10.0  # times as long as between its readings: then a channel is missing
LONG_PART = 0.01  # of a survey, at least


def effect_variables(
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    origins: Mapping[str, Array],
    survey: Survey,
    believed: NDArray[np.bool_] | None = None,
) -> dict[str, Variable]:
    """The effects found on a survey as a variable of the group `calibration`; nothing where there are none.

    Args:
        believed: (N,) the samples that the effects were fitted to; all that may be used if None.
    """
    if not adopted:
        return {}
    texts = [
        json.dumps(
            {
                "error_model": a.name,
                "kind": a.component.effect,
                "settings": dict(a.settings),
                "sensors": list(a.sensors),
                "theta": np.asarray(t).tolist(),
            },
            default=float,
        )
        for a, t in zip(adopted, theta, strict=True)
    ]
    attributes = {"channel_origins": json.dumps({k: np.asarray(v).tolist() for k, v in origins.items()})}
    attributes["start"], attributes["end"] = started(survey).isoformat(), ended(survey).isoformat()
    attributes |= seen_here(record_of(survey, origins, use=believed), adopted)
    return {"calibration/effects": (("effect",), np.array(texts, dtype=np.str_), attributes)}


def stored_effects(calibration: Survey, registry: Registry) -> tuple[list[Adopted], list[Array], dict[str, Array]]:
    """Effects, coefficients and channel origins of a calibration.

    Raises:
        UsageError: an error model of the calibration is not installed.
    """
    if "calibration/effects" not in calibration:
        return [], [], {}
    variable = calibration["calibration/effects"]
    adopted, theta = [], []
    for text in variable.values:
        facts: dict[str, Any] = json.loads(str(text))
        name = facts["error_model"]
        if ("error_model", "", name) not in registry.components:
            raise UsageError(f"the calibration needs the error model {name}: {registry.unknown('error_model', name)}")
        component = registry.find("error_model", name)
        adopted.append(Adopted(component, facts["settings"], tuple(facts["sensors"])))
        theta.append(np.asarray(facts["theta"], dtype=float))
    known = variable.attrs.get("channel_origins") or variable.attrs["channel_means"]  # so called up to 2026
    origins = {k: np.asarray(v, dtype=float) for k, v in json.loads(known).items()}
    return adopted, theta, origins


def on_its_clock(
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    origins: Mapping[str, Array],
    calibration: Survey,
    fitted: ArrayCalibration,
    survey: Survey,
) -> list[Adopted]:
    """Effects of a calibration as they are on another survey: what happened at a time has happened since then.

    A jump stays, and a drift holds its last value, unless the survey itself shows that it begins anew, happened before
    or has not yet. Warming up begins with every survey, but goes on in one that follows sooner than the
    electronics could cool, and what a lagged response began with is another survey's own.
    """
    facts = calibration["calibration/effects"].attrs if adopted else {}
    if "start" not in facts:
        return list(adopted)
    begun, end = (datetime.fromisoformat(str(facts[name])) if name in facts else None for name in ("start", "end"))
    assert begun is not None
    known = begun_with(adopted, begun, survey)
    if end is not None:
        known = [replace(a, start=_seconds(begun, survey)) if _still_warm(a, end, survey) else a for a in known]
    moved = [i for i, a in enumerate(known) if a.component.effect != "site"]
    dated = [i for i in moved if _of_a_time(known[i])]  # how warm a survey begins is asked elsewhere
    if not dated:
        return known
    record = record_of(survey, origins=origins, every=True)
    own = [i for i in moved if not _lacking(known[i], record)]
    own = [i for i in own if known[i].name != NAME]  # its waveform here is found when the others are taken off
    effects = [(known[i], theta[i]) for i in own]
    asked = [own.index(i) for i in dated if i in own]
    here = {own[i]: a for i, a in as_dated_here(record, fitted, effects, asked, survey.good).items()}
    return [here.get(i, a) for i, a in enumerate(known)]


def begun_anew(adopted: Sequence[Adopted], calibration: Survey) -> str:
    """Which effects that go with time go with another survey's own, not the calibration's; "" where none does."""
    if not adopted or "start" not in calibration["calibration/effects"].attrs:  # nothing says when that was
        return ""
    return ", ".join(dict.fromkeys(a.name for a in adopted if _of_a_time(a) and a.start is None))


def not_as_dated(adopted: Sequence[Adopted], survey: Survey) -> str:
    """Which effects that go with time had happened before a survey, or not yet in it, where the dates say otherwise;
    "" where none is."""
    late = [(a.name, a.start - float(survey.time[0])) for a in adopted if a.start is not None]
    words = [f"{name} ({'happened before' if s < 0 else 'not yet'})" for name, s in late if abs(s) >= LONG]
    return ", ".join(dict.fromkeys(words))


def held(adopted: Sequence[Adopted], survey: Survey) -> str:
    """Which effects stay as they were when what is known of them ended, and for how long; "" where none does. What
    happened at a time is over then, as a recorder's slip is."""
    words = []
    for a in adopted:
        marks = profiled(a.component)
        known = [float(a.settings[n]) for n, mark in marks.items() if isinstance(mark, Duration)]
        over = any(isinstance(mark, EventTimes) for mark in marks.values())
        if a.start is None or not known or over or abs(late := a.start - float(survey.time[0])) >= LONG:
            continue
        beyond = float(survey.time[-1] - survey.time[0]) - late - max(known)
        if beyond > LONG_PART * max(known):
            words.append(f"{a.name} (for {beyond:.0f} s)")
    return ", ".join(dict.fromkeys(words))


def in_equilibrium(adopted: Sequence[Adopted], survey: Survey) -> str:
    """Which responses that lag are taken to begin in equilibrium, for the survey does not show what they began with; ""
    where none is."""
    if shows_a_state(survey.values("b_raw"), "position" in survey):
        return ""
    return ", ".join(dict.fromkeys(a.name for a in adopted if unknown(a)))


@dataclass(frozen=True)
class Here:
    """The effects of a calibration that another survey lets be taken off, with their coefficients.

    Attributes:
        beyond: of each that goes beyond what the calibration has seen, how far.
        refuted: what its own lengths refute; "" where nothing is.
        left_in: what it may have and does not let be taken off, and why; "" where there is nothing.
    """

    adopted: list[Adopted]
    theta: list[Array]
    beyond: dict[str, str]
    refuted: str
    left_in: str


def those_here(
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    origins: Mapping[str, Array],
    fitted: ArrayCalibration,
    survey: Survey,
    calibration: Survey,
) -> Here:
    """The effects that another survey has too.

    Its lengths may refute two kinds: rows that are averages belong to the way a survey was recorded; and what an effect
    does beyond what the calibration has seen nobody knows. A source that nobody logged cannot be told from a field that
    bends within the array, nor where nearly all of it could be a gradient.

    Args:
        fitted: as the survey is corrected with; calibration: as it is stored.
    """
    beyond = extrapolated(survey, calibration, adopted, origins)
    here = Here(list(adopted), list(theta), beyond, "", left_in(survey, adopted))
    if "total_field" not in survey:
        beyond = {}  # lengths alone change with the field
    asked = {AVERAGING, NAME, TONE, *beyond} & {a.name for a in adopted}
    record = record_of(survey, origins=origins, every=True) if asked else None
    if record is None or any(a.component.effect != "site" and _lacking(a, record) for a in adopted):
        return here  # what it lacks is told when the effects are taken off
    record = replace(record, total_field=corrected_reference(record, adopted, theta))
    own = dict.fromkeys(a.name for a in adopted if a.component.effect == "instrument")
    for name in own:
        asked_here = name == AVERAGING or name in beyond
        if asked_here and refuted(name, record, fitted, here.adopted, here.theta, survey.good):
            why = f"{name} ({beyond[name]})" if name in beyond else name
            here = _without(here, name, refuted="; ".join(w for w in (here.refuted, why) if w))
    if TONE in asked and len(survey.sensors) > 1 and _a_tone_does_not_show(record, fitted, here, survey.good):
        words = f"{TONE}: what differs between the sensors does not show it, and its phase, on this survey"
        here = replace(here, left_in="; ".join(w for w in (here.left_in, words) if w))
    if NAME in asked and (why := hidden_objection(record, fitted, here.adopted, here.theta, survey.good)):
        words = f"{NAME}: {why}"
        here = _without(here, NAME, left_in="; ".join(w for w in (here.left_in, words) if w))
    return here


def _a_tone_does_not_show(record: Record, fitted: ArrayCalibration, here: Here, good: NDArray[np.bool_] | None) -> bool:
    every = zip(here.adopted, here.theta, strict=True)
    own = [(a, t) for a, t in every if a.component.effect == "instrument" and a.name != NAME]
    timely, rest = on_its_time(record, fitted, own, good)
    return any(tone_here(timely, fitted, a, t, good, rest) is None for a, t in rest if a.name == TONE)


def _without(here: Here, name: str, **words: str) -> Here:
    kept = [i for i, a in enumerate(here.adopted) if a.name != name]
    adopted, theta = [here.adopted[i] for i in kept], [here.theta[i] for i in kept]
    beyond = {effect: how for effect, how in here.beyond.items() if effect != name}
    return replace(here, adopted=adopted, theta=theta, beyond=beyond, **words)


def contradicted_here(
    before: Survey,
    cleaned: Survey,
    fitted: ArrayCalibration,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    origins: Mapping[str, Array],
) -> str:
    """Which effects that were taken off a survey its own total field contradicts; "" where none is, or there is none.

    Args:
        before: the survey as it was read; cleaned: without the effects.
    """
    if "total_field" not in cleaned or not any(a.component.effect == "instrument" for a in adopted):
        return ""
    record = record_of(before, origins=origins, every=True)
    record = replace(record, total_field=np.asarray(cleaned.values("total_field"), dtype=float))
    b = fitted.apply(np.asarray(cleaned.values("b_raw"), dtype=float))
    return ", ".join(dict.fromkeys(contradicted(record, fitted, adopted, theta, cleaned.good, b)))


def begun_with(adopted: Sequence[Adopted], begun: datetime, survey: Survey) -> list[Adopted]:
    """Effects of a survey that began at some date, on the clock of another survey."""
    seconds = _seconds(begun, survey)
    if seconds != float(survey.time[0]) or shows_a_state(survey.values("b_raw"), "position" in survey):
        adopted = [_begun_unknown(a) for a in adopted]
    return [replace(a, start=seconds) if _of_a_time(a) else a for a in adopted]


def _seconds(date: datetime, survey: Survey) -> float:
    """A date on the clock of a survey, s."""
    return (date - started(survey)).total_seconds() + float(survey.time[0])


def _still_warm(model: Adopted, end: datetime, survey: Survey) -> bool:
    """Whether a survey follows another one, which ended at some date, within the time constant of a warming up."""
    after = (started(survey) - end).total_seconds()
    return model.name == WARM_UP and 0.0 <= after < float(model.settings["tau_s"])


def _begun_unknown(model: Adopted) -> Adopted:
    grids = profiled(model.component).items()
    began = {n: NOT_KNOWN for n, g in grids if isinstance(g, Beginning) and g.matters(model.settings)}
    return replace(model, settings={**model.settings, **began}) if began else model


def _of_a_time(model: Adopted) -> bool:
    """Whether a setting is a time, or the length, of the survey that the model was fitted to."""
    return any(isinstance(mark, (EventTimes, Duration)) for mark in profiled(model.component).values())


def started(survey: Survey) -> datetime:
    """The date of a survey's first sample."""
    parts = split_since(str(survey["time"].attrs["units"]))
    assert parts is not None
    return parts[1] + timedelta(seconds=float(survey.time[0]))


def ended(survey: Survey) -> datetime:
    """The date of a survey's last sample."""
    return started(survey) + timedelta(seconds=float(survey.time[-1] - survey.time[0]))


def cleaned(
    survey: Survey,
    calibration: ArrayCalibration,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    origins: Mapping[str, Array],
    good: NDArray[np.bool_] | None = None,
) -> Survey:
    """The survey with the adopted effects taken off `b_raw` and `total_field`.

    Args:
        good: (N,) samples in whose field error models may look; the readings of the survey if None.

    Raises:
        DataError: the survey lacks a channel that an effect follows.
    """
    if not adopted:
        return survey
    record = record_of(survey, origins=origins, every=True)
    where = str(survey.attributes.get("source", ""))
    for effect in adopted:
        if effect.component.effect != "site" and (lacking := _lacking(effect, record)):
            raise DataError(
                f"the effect {effect.name} of the calibration cannot be taken off: this survey has no {lacking}",
                where=where,
                hint=f"it logs {', '.join(sorted(channels_of(survey)[0])) or 'no channel'}; "
                "apply a calibration without this effect, or log what it follows",
            )
    try:
        raw = corrected_raw(record, calibration, adopted, theta, survey.readings if good is None else good)
        field = corrected_reference(record, adopted, theta)
    except (KeyError, ValueError) as error:
        names = ", ".join(a.name for a in adopted)
        raise DataError(
            f"the effects of the calibration ({names}) cannot be taken off this survey: {error}", where=where
        ) from error
    changed: dict[str, Variable] = {"b_raw": (("time", "sensor", "axis"), raw, dict(survey["b_raw"].attrs))}
    if field is not None:
        changed["total_field"] = (("time",), field, dict(survey["total_field"].attrs))
    return survey.merged(changed)


def without_unread(survey: Survey, adopted: Sequence[Adopted]) -> Survey:
    """The survey with the samples at its ends taken out of use of which a log that an effect follows, being late or
    early as a whole, tells nothing."""
    shifted = unread(adopted, survey.time)
    if not shifted.any():
        return survey
    good = survey.good_by_sensor & ~shifted[:, None]
    given: dict[str, Variable] = {"good": (("time", "sensor"), good, {"long_name": "may be used"})}
    return survey.merged(given, flag_ranges(survey.time, shifted, by="apply", reason=SHIFTED))


def _lacking(effect: Adopted, record: Record) -> str:
    """The channel that an effect follows and a survey does not log; "" where it logs all."""
    x = record.excitation(record.raw, record.raw)
    for name, mark in profiled(effect.component).items():
        if isinstance(mark, AnyChannel):
            channel = str(effect.settings.get(name, ""))
            if channel and channel not in record.logged:
                return f"channel {channel}"
            if not channel and not mark.values(x):
                return f"channel {mark.pattern}"
    known = {"attitude": record.attitude is not None, "position": record.position is not None}
    marked = {m.pattern for m in profiled(effect.component).values() if isinstance(m, AnyChannel)}
    for need in effect.component.declared({}).needs:
        options = [o for o in need.split("|") if o not in marked]
        if options and not any(known.get(o, o in FACTS) or x.channels_like(o) for o in options):
            return " or ".join(options)
    return ""


def bridged(survey: Survey, adopted: Sequence[Adopted]) -> str:
    """Which effects follow a channel that is missing for a while, and when: it is taken to go straight there; "" where
    none is."""
    time = np.asarray(survey.time, dtype=float)
    words = []
    for effect in (a for a in adopted if a.component.effect != "site"):
        for name, mark in profiled(effect.component).items():
            channel = str(effect.settings.get(name, "")) if isinstance(mark, AnyChannel) else ""
            if channel not in survey or len(survey.values(channel)) != len(time):
                continue
            values = np.asarray(survey.values(channel), dtype=float).reshape(len(time), -1)
            read = time[np.isfinite(values).all(axis=1)]
            if len(read) < 2:
                continue
            known = np.concatenate([time[:1], read, time[-1:]]) - time[0]
            first = int(np.argmax(np.diff(known)))
            begin, end = known[first : first + 2]
            if end - begin > max(MISSES * float(np.median(np.diff(read))), LONG_PART * known[-1]):
                words.append(f"{effect.name}: {channel} is missing from {begin:.4g} to {end:.4g} s after the start")
    return "; ".join(dict.fromkeys(words))


def left_in(survey: Survey, adopted: Sequence[Adopted]) -> str:
    """Which effects of a calibration a survey does not let be taken off, and why; "" where there are none."""
    words = []
    names = {a.name for a in adopted}
    if NAME in names:
        why = ""
        if "position" not in survey or not np.isfinite(survey.values("position")).all():
            why = "the sensors' positions are not known"
        elif len(survey.sensors) < 3:
            why = "with fewer than three sensors it cannot be told from a gradient"
        if why:
            words.append(f"{NAME}: {why}")
    if TONE in names and len(survey.sensors) < 2:
        words.append(f"{TONE}: its phase on this survey is not known from a single sensor")
    return "; ".join(words)
