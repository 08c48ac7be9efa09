"""The search as `verdict.json` tells it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Beginning, Bends, EventTimes, Forms, Frequencies, Range, profiled
from magtensor.error_models.waveform import NAME
from magtensor.loop.correcting.another_survey import WARM_UP
from magtensor.loop.fitting.model import CHANNEL, Adopted, Record, State
from magtensor.loop.fitting.refit import everywhere
from magtensor.loop.searching.beginnings import lags
from magtensor.loop.searching.contribution import happens_once
from magtensor.loop.searching.found import Search, Step, without_and_with
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.likeness import course_words, followed_by_a_product, followed_in_part
from magtensor.loop.searching.on_fewer_sensors import named

AS_FAST = 0.15  # of a time constant


def described(found: Search, record: Record, declared: int) -> dict[str, Any]:
    """`adopted`, `rejected` and `not_tested` of the contract, and `steps`: each round of the search.

    Args:
        found: the search.
        record: its samples.
        declared: how many of the error models were declared and are no discovery.
    """
    return {
        "adopted": [_adopted(found, record, i) for i in range(declared, len(found.last.adopted))],
        "rejected": _rejected(found),
        "not_tested": [
            {"error_model": name, "missing": list(missing)} for name, missing in sorted(found.not_tested.items())
        ],
        "steps": [_step(number, step) for number, step in enumerate(found.steps, 1)],
    }


def _step(number: int, step: Step) -> dict[str, Any]:
    return {
        "round": number,
        "adopted": None if step.adopted is None else step.adopted.model.name,
        "indistinguishable_from": list(step.rivals),
        "dropped": list(step.dropped),
        "refused": dict(step.refused),
        **({"among": list(step.among)} if step.among else {}),
        "looked_at": [
            judgement(c) | {"why": "adopted" if c is step.adopted else why(c, step.adopted)} for c in step.candidates
        ],
    }


def judgement(candidate: Candidate) -> dict[str, Any]:
    """What was found of one error model, and whether the first two gates let it pass."""
    gain, focused = candidate.assessment.gain, candidate.assessment.focused
    return {
        "error_model": candidate.model.name,
        "settings": _settings(candidate.model),
        "p": candidate.adjusted_p,
        "held_out_gain": float(gain.total),
        "t": float(gain.t),
        "t_where_it_acts": None if focused is None else float(focused.t),
        "passes": bool(candidate.passes),
        "why": why(candidate, None),
    }


def _step_of(found: Search, model: Adopted) -> Step | None:
    """The round in which a model was adopted; its form, what it began with and its settings on a range were moved
    since: of several rounds the one with the nearest."""
    grids = profiled(model.component)
    ranges = [name for name, grid in grids.items() if isinstance(grid, (Range, Frequencies))]
    free = {*ranges, *(name for name, grid in grids.items() if isinstance(grid, (Forms, Beginning)))}
    free.update(*(grid.instead for grid in grids.values() if isinstance(grid, Bends)))

    def apart(adopted: Adopted) -> float:
        pairs = [(float(adopted.settings.get(name, 0.0)), float(model.settings.get(name, 0.0))) for name in ranges]
        return sum(abs(a - b) / (abs(a) + abs(b)) for a, b in pairs if a != b)

    fitting = [
        (apart(step.adopted.model), number)
        for number, step in enumerate(found.steps)
        if step.adopted is not None
        and step.adopted.model.name == model.name
        and all(step.adopted.model.settings.get(k) == v for k, v in model.settings.items() if k not in free)
    ]
    return found.steps[min(fitting)[1]] if fitting else None


def _adopted(found: Search, record: Record, index: int) -> dict[str, Any]:
    state = found.last
    model = state.adopted[index]
    edges = np.cumsum([0, *(len(t) for t in state.theta)])
    part = slice(int(edges[index]), int(edges[index + 1]))
    assert state.terms is not None and state.estimate is not None
    std = np.sqrt(np.maximum(np.diag(state.estimate.covariance), 0.0))[part]
    names, sensors = state.terms.names[part], state.terms.sensors[part]
    units = state.terms.units[part]
    step = _step_of(found, model)
    before, after = without_and_with(found, index)
    beside = {a.name for a in state.adopted} - {CHANNEL}  # what was adopted beside it is told apart from it
    rivals = [] if step is None else [name for name in step.rivals if name not in beside]
    p = float("nan") if step is None or step.adopted is None else step.adopted.assessment.p
    meaning = model.component.means
    found_of = dict(zip(zip(sensors, names, strict=True), map(float, state.theta[index]), strict=True))
    means = "" if meaning is None else meaning(_with_what_differs(found, record), model.settings, found_of)
    means = means or _as_another_begins(state, index)
    like = "" if step is None else step.like
    hidden = model.name == NAME and record.waveform is not None
    if hidden and (course := _course_of(np.asarray(record.waveform), record)):
        means, like = means or course, ""
    elif hidden:
        means = means or _told_of_a_source(state, index, record, like)
    return {
        "error_model": model.name,
        "kind": model.component.effect,
        "sensors": list(named(state, index)),
        "settings": _settings(model),
        "coefficients": [
            {"name": n, "sensor": s, "value": float(v), "std": float(d), "units": u}
            for n, s, v, d, u in zip(names, sensors, state.theta[index], std, units, strict=True)
        ],
        "evidence": {"held_out_rms_before_nT": before, "held_out_rms_after_nT": after, "z": z_of(p)},
        "indistinguishable_from": rivals,
        **({"channels_as_good": list(step.channels)} if step is not None and step.channels else {}),
        **({"means": means} if means else {}),
        **({"most_like_channel": like} if like else {}),
    }


def _told_of_a_source(state: State, index: int, record: Record, like: str) -> str:
    """Where a source that nobody logged acts most, when, and that it is like no channel, in words."""
    waveform, theta = np.asarray(record.waveform), state.theta[index]
    owners = np.array(state.adopted[index].terms(state.excitation).sensors)
    each = {str(s): float(np.linalg.norm(theta[owners == s]) * np.std(waveform)) for s in dict.fromkeys(owners)}
    most = max(each, key=lambda s: each[s])
    words = [f"{each[most]:.3g} nT rms on {most}", course_words(record.time - record.start, waveform)]
    return ", ".join([word for word in words if word] + ([] if like else ["like no logged channel"]))


def _course_of(waveform: Array, record: Record) -> str:
    """What of logged channels a source that nobody logged goes as, in words; "" where it is like none of these."""
    if follows := followed_in_part(record.time, waveform, record):
        return f"goes as {follows}, and rests else"
    product = followed_by_a_product(record.time, waveform, record)
    return f"goes as {product}, as what follows one of them and is in proportion to the other" if product else ""


def _as_another_begins(state: State, index: int) -> str:
    """What a warming up may be instead that dies away as fast as another effect lags: that began with one excess for
    all sensors, and each may have had its own."""
    model = state.adopted[index]
    if model.name != WARM_UP:
        return ""
    tau = float(model.settings["tau_s"])
    alike = [other.name for other in state.adopted if abs(lags(other) - tau) < AS_FAST * tau]
    return f"dies away as fast as {alike[0]} lags: what each sensor had left of that at the start" if alike else ""


def _with_what_differs(found: Search, record: Record) -> Excitation:
    """What error models see, and how far the sensors differ at every sample."""
    state = found.last
    left = everywhere(record, state)
    if left.across is None:
        return state.excitation
    apart = np.sum(left.across**2, axis=1) / max(float(np.trace(left.projector)), 1.0)
    return replace(state.excitation, apart=apart)


def _settings(model: Adopted) -> dict[str, Any]:
    """The settings of a model, times in their order."""
    found = {k: _plain(v) for k, v in model.settings.items()}
    times = [name for name, grid in profiled(model.component).items() if isinstance(grid, EventTimes)]
    return found | dict(zip(times, sorted(found[name] for name in times), strict=True))


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value


def z_of(p: float) -> float | None:
    """The normal deviate with that two-sided probability."""
    from scipy.special import ndtri

    return float(-ndtri(max(p, 1e-300) / 2.0)) if np.isfinite(p) else None


def _rejected(found: Search) -> list[dict[str, Any]]:
    """Every model that was tried and not adopted, as it stood in the first round in which the data asked for it, and in
    the last that looked at it closely: what was adopted in between may have taken its place."""
    adopted = {a.name for a in found.last.adopted}
    asked_for: dict[str, str] = {}
    last: dict[str, str] = {}
    looked_at = {c.model.name for step in found.steps for c in step.candidates}
    for number, step in enumerate(found.steps, 1):
        now = {c.model.name: why(c, step.adopted) for c in step.candidates if c is not step.adopted}
        now |= step.refused
        now |= dict.fromkeys(set(step.dropped) - set(step.refused), "dropped, no longer significant beside the others")
        last |= {name: f"round {number}: {reason}" for name, reason in now.items()}
        for name in [c.model.name for c in step.candidates if c.passes and c.model.name in now]:
            asked_for.setdefault(name, last[name])
    for name in {name for step in found.steps for name in step.screened}:
        last.setdefault(name, "screened with every setting: it explains too little to be looked at closely")
    for name, reason in asked_for.items():
        last[name] = reason if last[name] == reason else f"{reason}; {last[name]}"
    if found.shared is not None and found.shared.significant:
        last[NAME] = found.shared.objection or "not among the models that may be adopted"
    last |= {name: f"could not be tried: {reason}" for name, reason in found.failed.items() if name not in looked_at}
    return [{"error_model": n, "why": w} for n, w in sorted(last.items()) if n not in adopted]


def why(candidate: Candidate, winner: Candidate | None) -> str:
    """Why a candidate was not adopted in its round."""
    gain = candidate.assessment.gain
    p = f"p {candidate.adjusted_p:.2g} after correction"
    if candidate.significant and candidate.adjusted_p >= candidate.alpha:
        p += f" by blocks, {candidate.adjusted_own_p:.2g} in noise of each sensor's own spectrum"
    if happens_once(candidate.model):
        p += " in noise of each sensor's own spectrum"
    figures = f"{p}, held-out gain {gain.total:.4g} (t {gain.t:.2g})"
    if not candidate.significant and candidate.adjusted_p < candidate.alpha:
        of_slow = min(candidate.adjusted_null_p, candidate.adjusted_own_p)
        return (
            f"not significant: by short blocks alone, {of_slow:.2g} in noise as slow as the residual's own: {figures}"
        )
    if not candidate.significant:
        return f"not significant: {figures}"
    if candidate.of_the_log and candidate.log_noise > 0:
        return f"noise in the log of a channel, which another model brought in, explains as much: {figures}"
    if candidate.of_second_order:
        return (
            "less than 0.3 % of what is adopted, or than the rate that it follows is known to; its next order would "
            f"explain as much: {figures}"
        )
    if candidate.of_the_law:
        return f"less than 5 % of an adopted effect of the same driver and sensors, whose law may miss it: {figures}"
    if candidate.of_no_shape:
        return f"leaves {candidate.assessment.left_there:.0%} of what there was at its time: {figures}"
    if candidate.of_no_blocks:
        return f"predicts far more than it explains, for what is adopted is not known from the other blocks: {figures}"
    if not candidate.beyond_slow_noise:
        return f"slow noise as strong as the residual's own would explain as much: {figures}"
    if not candidate.passes:
        return f"does not predict held-out blocks: {figures}"
    if winner is not None:
        ahead = winner.assessment.gain.total
        how = "explained more" if ahead > gain.total else "is simpler and not told from it"
        return f"{winner.model.name} {how} (held-out gain {ahead:.4g}): {figures}"
    return figures
