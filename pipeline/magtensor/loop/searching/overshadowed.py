"""What a search adopted, weighed against what it left.

Any law of the attitude resembles any other one a little. Where something large that follows the attitude has no name
(a gradient of the site, and no attitude logged to know it by), a named law that is a small part of it is significant,
predicts held-out blocks, and is wrong elsewhere: of the five components of a gradient one looks exactly like a
quadratic nonlinearity. So an adopted effect that follows the attitude and explains less than what stays unexplained is
taken out again. So is a tone that may be a harmonic of how the platform turns; and so is what happened once, where more
of the kind beside it is significant and predicts nothing, as where a sensor wanders, or where the sensors share a
waveform that has no name and is larger, or switches along the same vectors: a step or a passage may be a part of it,
or where nearly all that is left out of the calibration lies along its vector; so is a jump or a drift of a scale factor
beside which the gain goes on to wander; so are tones close to each other along
one vector, the sidebands of one whose strength or frequency changes; so is an error of the base station that is less
than what stays of |b| - F;
and a source that nobody logged, whose waveform may be a small part of any law that has no name. And whatever is larger,
an effect with which held-out blocks are predicted worse than without it, once no noise is weighed against another, was
one of a few samples that the colour of the noise made much of.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.joint_together import ABOUT
from magtensor.calibration.types import Array
from magtensor.error_models.direction import turning_Hz
from magtensor.error_models.settings import Frequencies, profiled
from magtensor.error_models.terms import joined
from magtensor.error_models.waveform import NAME
from magtensor.loop.evidence.assessment import estimated
from magtensor.loop.evidence.jumps import jumpiness
from magtensor.loop.evidence.residual import taken_off
from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.fitting.refit import everywhere
from magtensor.loop.remainder.limited_band import TOLD_APART
from magtensor.loop.remainder.predictable import (
    MOST_OF_IT,
    attitude_part,
    enough_for_the_total_field,
    predictable_in_the_total_field,
)
from magtensor.loop.searching.along_one_vector import ALONG, along_one_vector, events, is_along, vector_of
from magtensor.loop.searching.contribution import happens_once, moments, slices
from magtensor.loop.searching.found import Search, without_and_with
from magtensor.loop.searching.suspects import unlikely
from magtensor.loop.searching.unexplained import restless, unexplained
from magtensor.loop.searching.wandering_gain import of_a_wandering_gain

WORSE = 1.01  # times the held-out rms without an effect, all noise alike: noise of a colour does not make up for that
NAMELESS = 2.0  # times what stays, that a response to a logged vector explains if it is the law
LONE = 2  # events along one vector may be all that happened, where nothing stays
MUCH_OF_IT = 0.5  # of what an event explains, that is left out of the calibration
FACTOR = 2.0  # of its size, that this may differ by: what is far larger is another thing
AS_MUCH = 0.25  # of an event, that it may differ by from what it is at another time
JUMPS = 2.5  # standard errors of the kurtosis, which steady noise has in less than one series of a hundred
STANDS_OUT = 5.0  # times the rms of what goes in jumps: one of these has as much
SLOW = 0.5  # of the white noise, that what goes in jumps has at least
NOTHING = 1e-3  # of an event, that C and o leave
SIDEBANDS = 3  # tones along one vector, and no two of them harmonics of what is between them
CLOSE = 1.5  # times the lowest of their frequencies; the second and third harmonic are as far apart
HARMONICS = 16  # of the turning, that a law of the attitude with a corner shows


def overshadowed(found: Search, fixed: int) -> tuple[list[int], str] | None:
    """The weakest effect that explains less than what stays and may be a part of it, by its places among what is
    adopted, and why it is doubted."""
    state, left = found.told, staying(found)
    weakest: tuple[float, list[int], str] | None = None
    part = (
        of_nothing(state, fixed)
        or _of_an_adopted_source(state, fixed)
        or of_what_is_left_out(found, fixed)
        or _of_one_tone(state, fixed)
    )
    part = part or of_a_restless_station(found, fixed) or of_what_jumps(state, fixed)
    part = part or of_a_wandering_gain(state, fixed)
    if part is not None:
        return part
    for places in _of_one_name(state, fixed):
        before, after = without_and_with(found, *places)
        if after > WORSE * before:
            return (
                places,
                f"held-out blocks are predicted better without it ({before:.3g} nT rms) than with ({after:.3g})",
            )
        amount = float(np.sqrt(max(before**2 - after**2, 0.0)))
        if amount >= left * (NAMELESS if _follows_a_vector(state, places) else 1.0) or (
            weakest is not None and amount >= weakest[0]
        ):
            continue
        why = _of_any_law(state, places) or _of_the_attitude(state, places)
        if why := why or _of_what_wanders(found, state, places):
            weakest = amount, places, why
    several = _of_one_that_switches(state, fixed)
    if several is not None and len(several[0]) > LONE:
        return several
    present = (weakest or several) is not None and bool(unexplained(found, found.record)["present"])
    if weakest is None or not present:
        return _part_of_a_source(found, fixed) or (several if present else None)
    amount, places, why = weakest
    size = "less than" if amount < left else "hardly more than"
    return places, f"it {why} and explains {amount:.3g} nT rms, {size} the {left:.3g} nT that stay"


def _of_one_name(state: State, fixed: int) -> list[list[int]]:
    """The places of the adopted models, those of one name together, but each tone by itself."""
    named: dict[str, list[int]] = {}
    for place, model in enumerate(state.adopted[fixed:], start=fixed):
        named.setdefault(f"{model.name} {place}" if _frequency(model) else model.name, []).append(place)
    return list(named.values())


def _frequency(model: Adopted) -> float:
    """Hz, of a tone; else 0."""
    marks = profiled(model.component).items()
    return next((float(model.settings[name]) for name, mark in marks if isinstance(mark, Frequencies)), 0.0)


def _of_any_law(state: State, places: Sequence[int]) -> str:
    """That a source which nobody logged may be a part of what has another law: a waveform may be anything."""
    return "has a waveform that may be any law's" if state.adopted[places[0]].name == NAME else ""


def _of_the_attitude(state: State, places: Sequence[int]) -> str:
    """In which way adopted models may be a part of a law of the attitude; "" if in none."""
    frequency = _frequency(state.adopted[places[0]])
    if frequency and frequency < HARMONICS * (turning := turning_Hz(state.excitation)):
        return f"may be a harmonic of the platform's turning ({turning:.3g} Hz)"
    follows = _follows_a_vector(state, places) or attitude_share(state, places) > MOST_OF_IT
    return "follows the attitude" if follows else ""


def _follows_a_vector(state: State, places: Sequence[int]) -> bool:
    """Whether adopted models follow a logged vector, through whatever lag: each component with coefficients of its own,
    they imitate most of what the attitude does."""
    x = state.excitation
    return any(x.is_vector(name) for place in places for name in state.adopted[place].channels(x))


def _of_what_wanders(found: Search, state: State, places: Sequence[int]) -> str:
    """Whether something that happened once may be a stretch of what wanders: more of the kind is significant beside it
    and predicts nothing."""
    last = found.steps[-1].candidates if found.steps else ()
    if not happens_once(state.adopted[places[0]]):
        return ""
    more = [c.model.name for c in last if happens_once(c.model) and unlikely(c) and not c.passes]
    others = f"{' and '.join(more)} beside it would be significant, and predict nothing"
    return f"is not the only such event ({others})" if more else ""


def of_nothing(state: State, fixed: int) -> tuple[list[int], str] | None:
    """An event on one side of which no sample has a part in the calibration any more: C and o do what it does."""
    own = np.linalg.qr(state.residual.affine)[0]
    for place, model in enumerate(state.adopted):
        if place < fixed or not happens_once(model):
            continue
        series = model.terms(state.excitation).series[state.residual.samples]
        left = series - own @ (own.T @ series)
        if np.sum(left**2) < NOTHING**2 * np.sum(series**2):
            return [place], "no sample on one side of it has a part in the calibration"
    return None


def _of_an_adopted_source(state: State, fixed: int) -> tuple[list[int], str] | None:
    """An offset that came or went and lies along the vectors of an adopted source that nobody logged."""
    source = next((v for v in (vector_of(state, i) for i, a in enumerate(state.adopted) if a.name == NAME)), None)
    if source is None:
        return None
    for place, model in enumerate(state.adopted):
        own = vector_of(state, place) if place >= fixed and happens_once(model) else None
        if own is not None and is_along(own, source):
            return [place], f"it lies along the vectors of {NAME}, of which it is a part"
    return None


def of_what_is_left_out(found: Search, fixed: int) -> tuple[list[int], str] | None:
    """An offset that came or went, along whose vector nearly all goes that samples without a part in the calibration
    are off by, and more than it explains, or by as much as it is: what it is a part of acts at other times too, by a
    law that has no name."""
    state = found.told
    known = events(state, fixed)
    out = ~np.asarray(state.fit.keep)
    left = everywhere(found.record, state) if known and out.any() else None
    if left is None or left.across is None:
        return None
    off = left.across[out]
    beyond = float(np.sum(off**2) - len(off) * np.trace(left.projector))
    for place, vector in known:
        seen = vector / left.noise @ left.projector
        size = float(np.linalg.norm(seen))
        along = float(np.sum((off @ seen) ** 2)) / size**2 - len(off) if size > 0.0 else 0.0
        (series,) = state.adopted[place].terms(state.excitation).series[~out].T
        explains = size**2 * float(np.sum((series - series.mean()) ** 2))
        if along <= ALONG**2 * beyond:
            if _of_its_sensor(off, vector, left.projector, beyond, size) and beyond > MUCH_OF_IT * explains:
                return [place], (
                    f"what {len(off)} samples that fit no calibration are off by is of the same sensor and as large, "
                    "along other vectors: it does more than such events tell"
                )
            continue
        more = along > explains
        if more or _as_large(off @ seen / size**2, np.flatnonzero(out), state, place):
            return (
                [place],
                f"what {len(off)} samples that fit no calibration are off by lies along its vector, and is "
                f"{'more' if more else 'as large'}: it acts at other times too",
            )
    return None


def _of_its_sensor(off: Array, vector: Array, projector: Array, beyond: float, size: float) -> bool:
    """Whether what samples (n, 3 S) are off by, in sum `beyond` noise, is nearly all of the one sensor that an event
    (3 S,) acts on, and the most of them by as much as the event's `size`. Two sensors do not tell whose it is."""
    acts_on = np.flatnonzero(vector.reshape(-1, 3).any(axis=1))
    if len(acts_on) != 1 or len(vector) < 3 * TOLD_APART:
        return False
    (sensor,) = acts_on
    own = np.linalg.qr(projector[:, 3 * sensor : 3 * sensor + 3])[0]
    of_it = float(np.sum((off @ own) ** 2)) - own.shape[1] * len(off)
    usual = float(np.median(np.linalg.norm(off @ own, axis=1)))
    return of_it > ALONG**2 * beyond and size / FACTOR < usual < FACTOR * size


def of_a_restless_station(found: Search, fixed: int) -> tuple[list[int], str] | None:
    """The least error of the base station, where more than it stays of |b| - F and is no noise: of a station that
    wanders any law is a part, or goes with it for a while."""
    state = found.told
    left = restless(state, found.record)
    sizes = {
        place: float(np.std(model.terms(state.excitation).on_reference(theta)[state.residual.samples]))
        for place, (model, theta) in enumerate(zip(state.adopted, state.theta, strict=True))
        if place >= fixed and model.component.effect == "reference"
    }
    if not sizes or min(sizes.values()) >= left:
        return None
    place = min(sizes, key=lambda p: sizes[p])
    return [place], f"it makes {sizes[place]:.3g} nT rms of |b| - F, less than the {left:.3g} nT that stay of it"


def _as_large(share: Array, samples: NDArray[np.int_], state: State, place: int) -> bool:
    """Whether most samples are off by an event once more, or by it the other way round, at another time: not at those
    beside its own, where it may not have come or gone at once.

    Parameters
    ----------
    share: (n,) of the event, that the samples (n,) are off by.
    """
    x = state.excitation
    at = np.searchsorted(x.elapsed, moments(state.adopted[place]))
    elsewhere = (np.abs(samples[:, None] - at) > ABOUT).all(axis=1)
    if np.count_nonzero(elsewhere) <= ABOUT:
        return False
    return abs(float(np.median(np.abs(share[elsewhere]))) - 1.0) < AS_MUCH


def _of_one_that_switches(state: State, fixed: int) -> tuple[list[int], str] | None:
    """Several offsets that came or went along one vector: something switches, perhaps more often than they tell."""
    several = along_one_vector(state, fixed)
    if not several:
        return None
    places, sensors = several
    return places, (
        f"something in {', '.join(sensors)} switches along one vector more often than such events tell, or goes on "
        "changing"
    )


def of_what_jumps(state: State, fixed: int) -> tuple[list[int], str] | None:
    """Offsets that came or went, along whose vector what stays goes in jumps too, most of which are not much smaller:
    popcorn noise, of which the law of steady noise says that so large a jump is unlikely."""
    residual = state.residual
    if residual.across is None:
        return None
    run = state.excitation.run[residual.samples]
    for place, model in enumerate(state.adopted):
        vector = vector_of(state, place) if place >= fixed and happens_once(model) else None
        if vector is None:
            continue
        seen = vector / residual.noise @ residual.projector
        size = float(np.linalg.norm(seen))
        stays = residual.across @ seen / size if size > 0.0 else np.zeros(len(residual.across))
        beyond = max(float(np.mean(stays**2)) - 1.0, 0.0) ** 0.5
        if beyond > SLOW and size < STANDS_OUT * beyond and jumpiness(stays, run) > JUMPS:
            places = [i for i, v in events(state, fixed) if i == place or is_along(v, vector) or is_along(vector, v)]
            amount = beyond / size * float(np.sqrt(np.mean(vector[vector != 0.0] ** 2)))
            return places, f"what stays along its vector goes in jumps too, of {amount:.3g} nT rms"
    return None


def _of_one_tone(state: State, fixed: int) -> tuple[list[int], str] | None:
    """Several tones close to each other along one vector, and no harmonics: one whose strength or frequency changes, in
    another survey otherwise."""
    x = state.excitation
    tones = [
        (i, f, _phased_vector(state, i)) for i, a in enumerate(state.adopted) if i >= fixed and (f := _frequency(a))
    ]
    for _, lowest, first in tones:
        along = [(i, f) for i, f, v in tones if is_along(v, first)]
        close = [(i, f) for i, f in along if lowest <= f < CLOSE * lowest]
        own = [(i, f) for i, f in close if not any(_harmonic(f, g, float(x.elapsed[-1])) for _, g in along)]
        if len(own) >= SIDEBANDS:
            each = ", ".join(f"{f:.4g}" for f in sorted(f for _, f in own))
            return [
                i for i, _ in own
            ], f"tones at {each} Hz go along one vector: one whose strength or frequency changes"
    return None


def _harmonic(frequency_Hz: float, other_Hz: float, survey_s: float) -> bool:
    """Whether a frequency is a multiple of another one, as well as a survey tells."""
    times = round(frequency_Hz / other_Hz)
    return times > 1 and abs(frequency_Hz - times * other_Hz) * survey_s < 1.0


def _phased_vector(state: State, place: int) -> NDArray[np.complex128]:
    """(3 S,) nT, of an adopted tone: what goes with its cosine, and with its sine as the imaginary part."""
    terms = state.adopted[place].terms(state.excitation)
    vector = np.zeros(3 * len(state.excitation.sensors), dtype=complex)
    each = terms.part_weight * state.theta[place][terms.part_term] * np.where(terms.part_series == 0, 1.0, 1.0j)
    np.add.at(vector, terms.part_output, each)
    return vector


def _part_of_a_source(found: Search, fixed: int) -> tuple[list[int], str] | None:
    """An effect that happened once beside a waveform of no name that is larger, or of which it may be one switching
    among several, and why it is doubted."""
    shared, state = found.shared, found.last
    if shared is None or NAME in {a.name for a in state.adopted}:
        return None
    if not shared.significant or not shared.gain.consistent:
        return None
    amount = float(np.sqrt(np.mean(shared.direction**2)))
    for place, model in enumerate(state.adopted):
        if place < fixed or not happens_once(model):
            continue
        assert state.terms is not None
        theta = np.zeros(state.terms.count)
        theta[slices(state)[place]] = state.theta[place]
        own = float(np.sqrt(np.mean(state.terms.contribution(theta, shared.direction.size) ** 2)))
        if own < amount or (shared.switches and shared.left_by == model.name):
            shared_by = f"the waveform that the sensors share ({amount:.3g} nT)"
            places = [i for i, a in enumerate(state.adopted) if a.name == model.name and i >= fixed]
            return places, f"it explains {own:.3g} nT rms and may be a part of {shared_by}"
    return None


def staying(found: Search) -> float:
    """nT rms above the white noise that stays and may follow the attitude: without what the best of the significant
    effects of something else would explain that a gate refused, as one that happened once and predicts nothing, or
    without what of |b| - F does not follow it, as where the base station is noisy."""
    state, residual = found.told, found.told.residual
    other = _of_the_reference(state)
    for candidate in found.steps[-1].candidates if found.steps else ():
        if max(candidate.adjusted_p, candidate.adjusted_null_p) >= candidate.alpha:
            continue
        terms = candidate.model.terms(state.excitation).at(residual.samples)
        together = terms if state.terms is None else joined([state.terms, terms])
        theta = estimated(residual, together, state.colours).theta
        explained = residual.square() - taken_off(residual, together, theta).square()
        own = terms.contribution(theta[together.count - terms.count :], len(residual.noise))
        if explained > other and attitude_part(state, own) <= MOST_OF_IT:
            other = explained
    return float(np.sqrt(max(residual.square() - 1.0 - other, 0.0)) * residual.scale)


def _of_the_reference(state: State) -> float:
    """Mean square, of the whole whitened residual, that |b| - F adds to its white noise and that the attitude does not
    predict; 0 where there are too few samples to ask."""
    residual = state.residual
    if residual.across is None or residual.along is None or not enough_for_the_total_field(state):
        return 0.0
    beyond = float(np.mean(residual.along**2) - 1.0) / residual.freedom
    return max(beyond - predictable_in_the_total_field(state) ** 2, 0.0)


def attitude_share(state: State, places: Sequence[int]) -> float:
    """How much of the variance of what adopted models add can be predicted from the attitude, whatever the law."""
    assert state.terms is not None
    theta = np.zeros(state.terms.count)
    for place in places:
        part = slices(state)[place]
        theta[part] = state.theta[place]
    return attitude_part(state, state.terms.contribution(theta, len(state.residual.noise)))
