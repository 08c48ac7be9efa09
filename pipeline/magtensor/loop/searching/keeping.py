"""Whether a candidate is kept once it has been fitted: what it does to every sensor, and what its fit says of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Range, profiled
from magtensor.errors import DataError
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.separation import SEPARATION, fold_gain
from magtensor.loop.fitting.trial import Trial, on_the_folds_of, trial
from magtensor.loop.fitting.wandering import all_noise
from magtensor.loop.remainder.changing_matrix import channel_instead
from magtensor.loop.remainder.curve_of_a_channel import event_of_a_curve, event_of_an_axis
from magtensor.loop.searching.adopting import adopt, on_all_sensors, polished
from magtensor.loop.searching.after_a_pause import left_by_a_pause
from magtensor.loop.searching.beginnings import at_its_limit, began_with_a_vector
from magtensor.loop.searching.between_readings import BETWEEN, between_readings
from magtensor.loop.searching.contribution import (
    a_tone,
    agrees,
    happens_once,
    moments,
    share_of_differences,
    share_of_the_field,
)
from magtensor.loop.searching.course_of_time import one_curve, outweighed
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.left_out import better_left_out, between_its_flanks
from magtensor.loop.searching.like_a_station import as_a_station_would, only_a_constant
from magtensor.loop.searching.likeness import event_along
from magtensor.loop.searching.on_fewer_sensors import narrowed
from magtensor.loop.searching.one_direction import VISCOUS, of_one_direction
from magtensor.loop.searching.profiling import already
from magtensor.loop.searching.rivals import hardly_begun

NOT_AS_ASSUMED = "fitted, its coefficients are none that its law allows"
ONE_OF_A_KIND = "fitted, it comes out the same as one that is adopted already"  # its law is no single one
MOST_OF_DIFFERENCES = 0.1  # positions wrong by a tenth of the array, where its law ends to be of first order
MAYBE_HEAT = (
    "fitted, it goes with one direction of the lagged field: what the sun, or an engine, warms on one side would look "
    "the same"
)
LITTLE = 0.1  # of the error of a sensor: what a law leaves that is another one leaves more
OF_AN_AXIS = "fitted, a curve of what one axis of a sensor reads explains most of it"
UNEARNED = "fitted, it does not earn its place on held-out blocks"


@dataclass(frozen=True)
class Fitted:
    """A candidate that has been fitted together with the others.

    Attributes:
        after: how the fit stands; None where there is none.
        why: it is not kept; "" if it is.
        hurt: sensors whose held-out error rises, where that is why.
    """

    after: Trial | None
    why: str = ""
    hurt: tuple[str, ...] = ()


def fitted(record: Record, before: Trial, chosen: Candidate, how: Fitting) -> Fitted:
    """The fit with a candidate, on fewer sensors where it hurts one that it does not help."""
    try:
        after = trial(record, polished(record, adopt(record, before.state, chosen, how), how), how)
    except DataError as error:  # with coefficients that run away nothing is left to calibrate
        return _cannot(error)
    before = on_the_folds_of(after, record, before, how)
    hurt, which = before.hurt_by(after), len(before.state.adopted)
    if hurt:
        own = after.state.adopted[which].sensors or tuple(record.sensors)
        helped = [s for s in before.helped_by(after) if s in own]
        if helped and set(chosen.terms.sensors) >= set(own):
            fewer = trial(record, narrowed(record, after.state, which, tuple(helped), how), how)
            before = on_the_folds_of(fewer, record, before, how)
            if not before.hurt_by(fewer):
                if not missed_on(fewer.state, which, hurt):
                    after = fewer
                hurt = []
            elif _of_what_it_leaves(record, before, fewer, which, how):
                after, hurt = fewer, []
    if hurt:
        return Fitted(after, f"fitted, it raises the held-out error of {', '.join(hurt)}", tuple(hurt))
    return Fitted(after, why_not(record, before, after, chosen, how))


def _of_what_it_leaves(record: Record, before: Trial, after: Trial, which: int, how: Fitting) -> bool:
    """Whether the sensors that a model does not act on are hurt only by the little that it leaves of a large error on
    those that it acts on: that is no noise, and hurts them no longer where each sensor is weighed by all it has."""
    was, left = before.beside(after)
    own = after.state.adopted[which].sensors
    if not own or any(left[s] > LITTLE * was[s] for s in own):
        return False
    how = replace(how, noise=all_noise(after.state))
    try:
        weighed = joint_state(record, after.state.adopted, how, after.state.theta, after.state.lines)
        again = trial(record, weighed, how)
    except DataError:
        return False
    return not on_the_folds_of(again, record, before, how).hurt_by(again)


def missed_on(state: State, which: int, sensors: Sequence[str]) -> bool:
    """Whether one of the models, taken off some sensors, would predict held-out blocks on them: their |b| - F is worse
    with it by something slow, as an error of the base station is, and all that is known of them is not."""
    own = replace(state.adopted[which], sensors=tuple(sensors)).terms(state.excitation).at(state.residual.samples)
    gain = fold_gain(state, state.colours, own)
    return bool(gain.total >= SEPARATION + own.count and gain.consistent)


def fitted_everywhere(record: Record, before: Trial, chosen: Candidate, how: Fitting) -> Fitted:
    """The same on all its sensors, of which another effect that has no name yet may hide it from some."""
    try:
        after = trial(record, polished(record, on_all_sensors(record, before.state, chosen, how), how), how)
    except DataError as error:
        return _cannot(error)
    return Fitted(after, hurt=tuple(on_the_folds_of(after, record, before, how).hurt_by(after)))


def _cannot(error: DataError) -> Fitted:
    return Fitted(None, f"it cannot be fitted: {error.what.split(':')[0]}")


def why_not(record: Record, before: Trial, after: Trial, chosen: Candidate, how: Fitting) -> str:
    """What a fit without and with a candidate, and perhaps others behind it, says against the candidate; "" if nothing
    does."""
    x, which = after.state.excitation, len(before.state.adopted)
    model = after.state.adopted[which]
    acts_on = model.sensors or x.sensors
    same = [a for a in after.state.adopted[:which] if set(a.sensors or x.sensors) & set(acts_on)]
    two_channels = chosen.moved is None and model.channels(x)
    if not two_channels and already(same, model.component, model.settings):
        return ONE_OF_A_KIND
    slow, channels = hardly_begun(chosen.model, x), sorted(model.channels(x))
    unrecorded = only_a_constant(x)
    if (unrecorded or slow or channels or a_tone(model)) and as_a_station_would(after.state, which):
        drift = "drifts" if slow else f"follows {' and '.join(channels)}" if channels else "has its period"
        other = f"an error of the base station that {drift}"
        if unrecorded:
            other = "the field, of which only a constant is known,"
        return f"fitted, all sensors show it alike: {other} would look the same"
    if hardly_begun(model, x) and ((not slow and chosen.moved is None) or began_with_a_vector(model)):
        # of two of a kind one may be slow, and so may what was so at first sight, unless it is all that dies away
        return "fitted, it lags by more than half of the survey: any drift would do as well"
    if channels and hardly_begun(model, x, share=1.0):
        return (
            f"fitted, it lags by more than the survey lasts: it follows the sum of {' and '.join(channels)} over time"
        )
    if at_its_limit(model.component, model.settings, x):
        return "fitted, it would have begun as far from what it follows as is possible: something else dies away"
    if shorter := _shorter_than_shown(model, x):
        return f"fitted, its {shorter} is shorter than the samples can show: something quicker would do as well"
    if model.name == VISCOUS and of_one_direction(after.state, which):
        return MAYBE_HEAT
    if not agrees(after.state, which):
        return NOT_AS_ASSUMED
    if (share := share_of_differences(after.state, which)) > MOST_OF_DIFFERENCES:
        return f"fitted, it makes {share:.0%} of what differs between the sensors: no small error"
    if how.nominal is not None and (share := share_of_the_field(after.state, which)) > how.nominal.scale:
        # what C takes back of it keeps it from being seen
        return f"fitted, it makes {share:.0%} of the field: more than is assumed of a sensor"
    if chosen.moved is None and (why := outweighed(after.state, which)):
        return why
    if not before.likelier(after):
        return "fitted together with the others, it leaves more than it takes away"
    theta = chosen.assessment.theta[-chosen.terms.count :]
    seen = chosen.before or before.state  # at the samples of its terms
    if between_readings(record, after.state, which):
        return BETWEEN
    if happens_once(model):
        if between_its_flanks(after.state, which):
            return "samples between its times fit no calibration: it is what is seen beside them"
        if name := left_by_a_pause(after.state, which):
            return f"it follows a pause of the record, in which nobody knows what {name} came to"
        # fitted without it the other may have had a part of it, and so its vectors
        if (name := event_along(seen, chosen.terms, theta)) and _along_another(after.state, which):
            return f"it lies along the vectors of {name}, whose law may leave it"
        if channel := event_of_a_curve(seen, chosen.terms, theta, chosen.assessment.colours):
            return f"a curve of {channel} explains most of it: what is adopted may miss its law"
        if why := one_curve(chosen, before.state):
            return why
        if event_of_an_axis(seen, chosen.terms, theta, chosen.assessment.colours):
            return OF_AN_AXIS
        terms = chosen.terms.only(i for i, s in enumerate(chosen.terms.sensors) if s in acts_on)
        if channel := channel_instead(seen, terms, chosen.assessment.colours, min(moments(model))):
            return f"C of {', '.join(acts_on)} going with {channel} would explain more than something that happens once"
        if better_left_out(record, before.state, after.state, which, how):
            return "fitted, its samples are far from its law: the others are fitted better without them"
    return ""


def _along_another(state: State, which: int) -> bool:
    """Whether an adopted event lies along the vectors of one of the models before it, all fitted together."""
    others = replace(state, adopted=state.adopted[:which], theta=state.theta[:which])
    own = state.adopted[which].terms(state.excitation).at(state.residual.samples)
    return bool(event_along(others, own, state.theta[which]))


def _shorter_than_shown(model: Adopted, x: Excitation) -> str:
    """The time constant of a model that is shorter than a survey's samples can show; "" if none is."""
    grids = profiled(model.component)
    ranges = ((name, grid) for name, grid in grids.items() if isinstance(grid, Range) and name in model.settings)
    return next((name for name, grid in ranges if model.settings[name] < grid.least(x)), "")
