"""A source nobody logged: one waveform, a vector at each sensor.

What lies across the plane that all sensors share is noise of each sensor, unless something moves several of them in
step. The test is one of factor analysis (`factor`): does the covariance of the residual, in bands of the lowest
frequencies, ask for a factor beside noise of the sensors, of any level and correlation within one? Its proof is
prediction: in a stretch of time each sensor's residual from that of the others, through a direction found in the other
stretches. Two sensors have one contrast: which of them was disturbed cannot be told, so nothing is adopted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from magtensor.accuracy import figure
from magtensor.calibration.joint import calibrated
from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.direction import attitude_series, curve_series
from magtensor.error_models.independent import independent
from magtensor.error_models.terms import joined
from magtensor.error_models.waveform import NAME, Course, course_of, free_directions
from magtensor.loop.correcting.correction import hidden_objection
from magtensor.loop.evidence.assessment import Assessment, estimated
from magtensor.loop.evidence.colour import beside_the_field
from magtensor.loop.evidence.factor import Groups, noise_alone, with_factor
from magtensor.loop.evidence.folds import FOLDS, Blocks
from magtensor.loop.evidence.gains import Gain
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.evidence.shared_waveform import (
    ALPHA,
    LEAST_BAND,
    by_output,
    lowest,
    predicted,
    second_factor,
    strongest,
)
from magtensor.loop.fitting.log_noise import brought_in
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State, generic
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.trial import per_sample
from magtensor.loop.remainder.flagged import forgotten_at
from magtensor.loop.searching.contribution import happens_once, possible_without
from magtensor.loop.searching.gates import OF_THE_LAW, Candidate, explained_before, explained_by, gained_of_a_log
from magtensor.loop.searching.likeness import (
    FEW,
    Likeness,
    effect_along,
    followed,
    followed_by_a_curve,
    followed_by_a_product,
    held_out_losses,
    of_an_unseen_path,
    with_the_turn_before,
)

LEAST_SENSORS = 3  # from here on noise of single sensors does not imitate a factor
QUIET = 5.0  # times the median square of a step: of a few dozen values none is as large by chance
ASKED = 5  # times of one survey: in each round, and once more without the samples or the effects that are left out
LEVEL_ROUNDS = 3
MOSTLY = 0.5  # of the samples
MOST_RENEWALS = 10
SETTLED = 0.1  # of the noise of a sample, along the vectors of a source
LEAST_NOISE = 0.1  # of what the fit believes
MOST_OF_A_SAMPLE = 50.0  # log likelihood: half of the largest squared residual of a sample that noise may explain
IMPROPER = 1 / 3  # of the noise of a sensor's usual axis
SINGLE_STRETCH = "it acts in a single short stretch, which no other can confirm"
ONCE = 0.9  # of a waveform's power in a stretch as long as one that is held out
OF_A_CHANNEL = "its waveform goes as"
LEFT_BY_LAWS = "it is less than 5 % of what is adopted, whose laws may leave it"
SECOND = 0.1  # a second factor this strong beside the first: not one waveform


@dataclass(frozen=True)
class Sought:
    """The strongest waveform that the sensors share, and what speaks for it and against it.

    Attributes:
        time: (N,) s; values: (N,) of unit rms; std: of a value.
        direction: (S, 3) nT per unit at each sensor, as far as it shows off the common plane.
        period_s: the shortest period in it.
        p: that noise of the sensors alone gives so strong a one, all bands considered.
        share: of the variance across that it explains, within 0 and 1: what C and o have taken of it is not there.
        gain: on held-out stretches, of each sensor's whitened residual predicted from the others.
        like: the channel it follows; None where it follows none.
        switches: whether it has two levels.
        of_the_log: whether noise in the logs of adopted channels explains it.
        objection: why it is not adopted; "" where nothing stands against it.
        left_by: the adopted effect that may leave it, or have taken a part of it; "" where there is none.
    """

    time: Array
    values: Array
    std: float
    direction: Array
    period_s: float
    p: float
    share: float
    gain: Gain
    like: Likeness | None
    switches: bool
    of_the_log: bool
    objection: str
    left_by: str = ""

    @property
    def significant(self) -> bool:
        """Whether it is there."""
        return self.p * ASKED < ALPHA and not self.of_the_log


def sought(state: State, record: Record, *, may_follow: bool = False) -> Sought | None:
    """Look for a waveform that the sensors share; None where there are too few sensors or samples to ask.

    Parameters
    ----------
    may_follow: whether the waveform may resemble a logged channel, one that was tried and does not explain it.
    """
    state = _with_known_memories(state.unabridged)
    residual = state.residual
    if residual.across is None:
        return None
    held = np.eye(len(residual.noise)) - residual.projector
    adopted = _put_back(state)
    if adopted is not None:  # its own noise went with it
        held = np.column_stack([held, residual.projector @ adopted[1]])
    basis = free_directions(held)
    n, m = len(residual.across), basis.shape[1]
    if n <= LEAST_BAND * m:
        return None
    sensors = len(residual.noise) // 3
    told = sensors >= LEAST_SENSORS
    groups: Groups = [np.arange(3 * s, 3 * s + 3) for s in range(sensors)] if told else by_output(basis)
    z, colour = beside_the_field(residual.across @ basis, residual.affine)
    test = strongest(colour.whiten(z), basis, groups)
    factors = with_factor(test.covariance, basis, groups, test.alone)
    course = _told_from_the_field(residual, held, factors.direction)
    if course.rms == 0:
        return None
    seen = basis.T @ factors.direction * course.rms
    time = record.time[residual.samples]
    values = course.values / course.rms
    inside = lowest(z, test.band)
    gain = predicted(inside, z - inside, basis, groups)
    like = followed(time, values, record)
    against = _against(state, basis, seen, values, gain, None if may_follow else like, told=told)
    objection, left_by = next(against, ("", ""))
    if not objection and second_factor(test, basis, factors) > SECOND:
        objection = "one waveform does not explain what the sensors share"
    return Sought(
        time=time,
        values=values,
        std=course.std / course.rms,
        direction=(basis @ seen * residual.noise).reshape(-1, 3),
        period_s=float(np.median(np.diff(time))) / max(course.band, 0.5 / n),
        p=test.p,
        share=_share(residual, z, values, seen),
        gain=gain,
        like=like,
        switches=course.switches,
        of_the_log=gain.total <= gained_of_a_log(brought_in(state), len(seen)),
        objection=objection,
        left_by=left_by,
    )


def _with_known_memories(state: State) -> State:
    """The same without the samples at the start in which the state that adopted effects began with, a play's or a
    filter's, still shows: nobody knows it, and what it leaves there all sensors may share. All of them where these are
    half of the survey."""
    forgotten = max((forgotten_at(model, state.excitation) for model in state.adopted), default=0)
    known = np.flatnonzero(state.residual.samples >= forgotten)
    if len(known) == len(state.residual.samples) or len(known) < MOSTLY * len(state.residual.samples):
        return state
    terms = None if state.terms is None else state.terms.at(known)
    return replace(state, residual=state.residual.smaller(known), terms=terms)


def _against(
    state: State, basis: Array, seen: Array, values: Array, gain: Gain, like: Likeness | None, *, told: bool
) -> Iterator[tuple[str, str]]:
    """What speaks against a source of this waveform (N,), the first above all, and the adopted effect that may leave
    it.

    Parameters
    ----------
    seen: (m,) how the sensors feel it, in the directions (3 S, m) of the basis.
    like: the logged channel that it may not follow; told: whether it is told from a disturbance of one sensor.
    """
    power = len(values) * float(seen @ seen)
    if not told:
        yield "with two sensors it cannot be told from a disturbance of one of them", ""
    if power <= OF_THE_LAW * explained_before(state, between=True):
        yield LEFT_BY_LAWS, ""
    if (unseen := of_an_unseen_path(state)) and power <= explained_by(state, unseen):
        name = state.adopted[unseen[0]].name
        yield f"it is less than {name} explains, which remembers the field on the way between the samples", ""
    if with_the_turn_before(state.excitation, state.residual.samples, values):
        yield "it goes with how far the field turned since the sample before, as what is quicker would make it", ""
    if not gain.consistent:
        yield "the sensors do not predict each other with it on held-out stretches", ""
    if like is not None:
        yield f"{OF_A_CHANNEL} {like.words}", ""
    if left_by := effect_along(state, basis, seen):
        yield f"the sensors feel it as they feel {left_by}, which may leave it", left_by
    if _acts_once(values):
        yield SINGLE_STRETCH, ""


def _acts_once(values: Array) -> bool:
    """Whether a waveform (N,) is hardly more than one burst: a few bad rows of a recorder are one to all sensors."""
    power = np.cumsum((values - np.median(values)) ** 2)
    length = max(len(values) // FOLDS, 1)
    return bool(np.max(power[length:] - power[:-length], initial=power[length - 1]) > ONCE * power[-1])


@dataclass(frozen=True)
class Source:
    """An adopted source.

    Attributes:
        record: with its waveform; after: the calibration with it; evidence: for it.
        like: the logged channel that its waveform is like, or any curve of which predicts it; "" where there is none.
    """

    record: Record
    after: State
    evidence: Candidate
    like: str


def tried_source(
    component: Component, record: Record, state: State, found: Sought, how: Fitting, alpha: float
) -> tuple[Sought, Source | None]:
    """What was found, with a last objection if there is one, and the calibration with it if there is none.

    Parameters
    ----------
    component: the error model.
    alpha: family-wise false-alarm probability.
    """
    if found.objection or not found.significant or found.p >= alpha:
        return found, None
    record = replace(record, waveform=np.interp(record.time, found.time, found.values))
    model = Adopted(component, {})
    every = model.terms(replace(state.excitation, waveform=record.waveform))
    terms = every.at(state.residual.samples)
    together = terms if state.terms is None else joined([terms, state.terms])
    estimate = estimated(state.residual, together, state.colours)
    after = joint_state(record, [*state.adopted, model], how, [*state.theta, np.zeros(every.count)])
    record, after = renewed(record, after, how)
    if _turning(record, after):
        return replace(found, objection="its waveform follows the direction of the field"), None
    model = Adopted(component, {"noise_nT": [float(f"{v:.4g}") for v in _own_noise(after)]})
    after = replace(after, adopted=(*after.adopted[:-1], model))
    if why := hidden_objection(record, calibrated(after.fit), after.adopted, after.theta, after.fit.keep):
        return replace(found, objection=f"a correction would not take it off: {why}"), None
    gain = found.gain
    folds, p = Blocks.equal(len(state.residual.affine)), found.p
    evidence = Assessment(estimate, folds, gain, gain, None, None, p, p, p, 0.0, state.colours, estimate.theta)
    like = found.like.course if found.like else followed_by_a_curve(found.time, found.values, record)
    return found, Source(record, after, Candidate(model, 1, terms, evidence, p, p, p, ALPHA), like)


def source_instead(
    component: Component, record: Record, state: State, left: Sought, how: Fitting, fixed: int, alpha: float
) -> Source | None:
    """A source nobody logged in the place of the adopted effect that has the same vectors at the sensors: of something
    that switches now and then a single step is a part, and so is what channels show that feel it late. None where it
    does not do better.

    Parameters
    ----------
    left: what the effect leaves.
    """
    places = [i for i, a in enumerate(state.adopted) if a.name == left.left_by and i >= fixed]
    one_each = [[i] for i in places] if len(places) > 1 else []  # the other may be there
    found: list[Source] = []
    for gone in ([places] if places else []) + one_each:
        less = possible_without(record, state, gone, how)
        if less is None:
            continue
        tried = left.significant and all(generic(state.adopted[i]) or happens_once(state.adopted[i]) for i in gone)
        shared = sought(less, record, may_follow=tried)
        source = None if shared is None else tried_source(component, record, less, shared, how, alpha)[1]
        if source is not None:
            lost = max(int(state.fit.keep.sum() - source.after.fit.keep.sum()), 0) / len(state.residual.affine)
            if per_sample(source.after) > per_sample(state) + MOST_OF_A_SAMPLE * lost:
                found.append(source)
    return max(found, key=lambda source: per_sample(source.after), default=None)


def of_every_sensor(model: Adopted, theta: Array, state: State) -> tuple[Adopted, Array]:
    """A source that was found among some sensors, and its coefficients, of all sensors of a state: of the others
    nothing yet, and their noise is that of the state."""
    among = [state.excitation.sensors.index(s) for s in model.sensors]
    vectors, noise = np.zeros((len(state.excitation.sensors), 3)), state.residual.noise.reshape(-1, 3).copy()
    vectors[among] = theta.reshape(-1, 3)
    noise[among] = np.reshape(model.settings["noise_nT"], (-1, 3))
    known = [float(f"{v:.4g}") for v in noise.ravel()]
    return replace(model, sensors=(), settings={**model.settings, "noise_nT": known}), vectors.ravel()


def _own_noise(state: State) -> Array:
    """(3 S,) nT, white noise of the outputs beside an adopted source.

    From differences of neighbouring samples in which the source is left: its waveform, one value a sample, has taken
    with it the most of the noise of those outputs that feel it most. Where it is so fast that they share it, it is the
    factor beside that noise. A factor that is one output and hardly more leaves it next to no noise (a Heywood case):
    then that output has as much as the sensor's others.
    """
    put_back = _put_back(state)
    assert put_back is not None
    basis = free_directions(np.eye(len(state.residual.noise)) - state.residual.projector)
    steps = np.diff(put_back[0] @ basis, axis=0) / np.sqrt(2.0)
    size = np.sum(steps**2, axis=1)
    quiet = steps[size < QUIET * np.median(size)]  # where it does not switch
    covariance, groups = quiet.T @ quiet / len(quiet), by_output(basis)
    found = noise_alone(covariance, basis, groups)
    if found.log_p(len(quiet)) < np.log(ALPHA):
        found = with_factor(covariance, basis, groups, found)
    noise = state.residual.noise * np.sqrt(np.maximum(np.diag(found.noise), LEAST_NOISE**2))
    axes = noise.reshape(-1, 3)
    usual = np.median(axes, axis=1, keepdims=True)
    out: Array = np.where(axes < IMPROPER * usual, usual, axes).ravel()
    return out


def _told_from_the_field(residual: Residual, held: Array, direction: Array) -> Course:
    """The waveform in a residual whose fit took some of it for the field.

    Where the source is strong, C and o have followed it along its direction. What of it goes with the field is told
    apart by its colour: generalised least squares, the colour found anew when that part has gone.
    """
    assert residual.across is not None
    free = free_directions(held)
    seen = free @ (free.T @ direction)
    series = residual.across @ seen / (seen @ seen)
    left, _ = beside_the_field(series, residual.affine)
    return course_of(residual.across + np.outer(left - series, seen), held, direction)


def renewed(record: Record, state: State, how: Fitting) -> tuple[Record, State]:
    """The waveform once more, from a calibration that knows the source or another effect better, and a refit; again and
    again beside an effect that lasts, for of that the waveform has what lies along the source's vectors, and the
    effect's coefficients have not, until both are known. What happens once may be a part of the source, and would
    share its waveform with it."""
    lasting = any(a.name != NAME and not happens_once(a) for a in state.adopted)
    for _ in range(MOST_RENEWALS if lasting else 1):
        every = state.unabridged
        found = _put_back(every)
        if found is None:
            break
        across, direction = found
        course = _course_beside_the_field(across, np.eye(len(direction)) - every.residual.projector, direction, every)
        if course.rms == 0:
            break
        waveform = np.interp(record.time, record.time[every.residual.samples], course.values / course.rms)
        moved = waveform if record.waveform is None else waveform - record.waveform
        record = replace(record, waveform=waveform)
        state = joint_state(record, state.adopted, how, state.theta, state.lines)
        if float(np.std(moved) * np.linalg.norm(direction)) < SETTLED:
            break
    return record, state


def _course_beside_the_field(across: Array, held: Array, direction: Array, state: State) -> Course:
    """The waveform as in `course_of`; if it is one of two levels once what goes with the field has gone, that.

    What C lacks along the source's vectors is in its waveform, where one that may be anything keeps it. The levels of
    one that switches tell it: then C takes it back.
    """
    course = course_of(across, held, direction)
    if course.switches or course.rms == 0:
        return course
    free = free_directions(held)
    seen = free.T @ direction
    series, affine = across @ free @ seen / float(seen @ seen), state.residual.affine
    on = course.values > 0.5 * (course.values.min() + course.values.max())
    part = np.zeros(len(series))
    for _ in range(LEVEL_ROUNDS):
        *field, step = np.linalg.lstsq(np.column_stack([affine, on]), series, rcond=1e-12)[0]
        part = affine @ np.array(field)
        on = (series - part) / step > 0.5 if step else on
    levels = course_of(across - np.outer(part - part.mean(), direction), held, direction)
    return levels if levels.switches else course


def _share(residual: Residual, z: Array, values: Array, direction: Array) -> float:
    """The part of the variance of z (N, m) that a waveform (N,) explains along a direction (m,)."""
    left = values - residual.affine @ np.linalg.lstsq(residual.affine, values, rcond=1e-12)[0]
    along = z @ direction
    whole = float(left @ left) * float(direction @ direction) * float(np.sum(z**2))
    return float(left @ along) ** 2 / whole if whole else 0.0


def _put_back(state: State) -> tuple[Array, Array] | None:
    """The whitened residual across (N, 3 S) with the adopted source left in it, and its direction (3 S,)."""
    which = next((i for i, a in enumerate(state.adopted) if a.name == NAME), None)
    if which is None:
        return None
    residual, theta = state.residual, state.theta[which]
    assert residual.across is not None
    size = len(residual.noise)
    added = state.adopted[which].terms(state.excitation).at(residual.samples).contribution(theta, size)
    return residual.across + added / residual.noise @ residual.projector, theta / residual.noise


def _turning(record: Record, state: State) -> bool:
    """Whether the attitude predicts an adopted source in stretches that its coefficients have not seen, by a law of low
    degree or by any curve of the field along each axis, which is what a sensor that is not linear makes of it.

    Beyond the field itself, whose part C has taken. Asked when the source is known, for until then it is in the field
    too, and what differs between that and a logged attitude follows the source.
    """
    found = _put_back(state)
    assert found is not None
    across, direction = found
    series, affine = across @ direction, state.residual.affine
    n = len(series)
    laws = [made(state.excitation)[state.residual.samples] for made in (attitude_series, curve_series)]
    edges = np.linspace(0, n, FOLDS + 1).round().astype(int)
    before = held_out_losses(series, affine, edges)
    return any(
        Gain(before, held_out_losses(series, columns, edges), np.diff(edges).astype(float)).consistent
        for columns in (np.column_stack([affine, *laws[:k]]) for k in (1, 2))
        if n >= 4 * columns.shape[1]
    )


def shared_words(found: Sought, record: Record) -> str:
    """A waveform that the sensors share, in words."""
    strength = np.sqrt(np.sum(found.direction**2, axis=1))
    each = ", ".join(f"{s} {a:.2g} nT" for s, a in zip(record.sensors, strength, strict=True))
    course = "switches between two levels" if found.switches else f"has periods from {figure(found.period_s)} s on"
    part = f"{found.share:.0%}" if found.share >= 0.01 else "less than 1%"
    words = (
        f"the sensors share one waveform ({each}; {part} of the variance of what differs between them), which {course}"
    )
    if found.like is not None:
        like, correlation = found.like, abs(found.like.correlation)
        words += f" and is most like {like.words} with a lag of {like.lag_s:.3g} s (correlation {correlation:.2f})"
        if independent(found.values) < FEW:
            words += ", as one of several channels, powers and lags is of anything that swings so seldom"
    else:
        product = followed_by_a_product(found.time, found.values, record)
        words += f" and goes as {product}, for which there is no model" if product else " and follows no logged channel"
    said = found.like is not None and found.objection.startswith(OF_A_CHANNEL)
    return words + (f"; not adopted: {found.objection}" if found.objection and not said else "")
