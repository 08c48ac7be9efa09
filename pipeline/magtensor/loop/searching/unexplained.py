"""What is left when the search has ended: is it noise, and if not, what does it look like?

Independent sensors have independent noise, white or slow. So what is left is called unexplained only where noise
cannot make it: a waveform that the sensors share, a line in the spectrum, what follows the direction of the field, a
sensor whose matrix is not constant, or an error model that is significant and was not adopted.
"""

from __future__ import annotations

from dataclasses import replace
from operator import itemgetter
from typing import Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.evidence.residual import Residual, taken_off
from magtensor.loop.evidence.spectrum import line_of_the_station, spectral_lines
from magtensor.loop.fitting.model import Record, State
from magtensor.loop.fitting.refit import disturbed
from magtensor.loop.fitting.separation import SECOND_ORDER
from magtensor.loop.remainder.along_an_effect import along_an_effect_words
from magtensor.loop.remainder.changing_matrix import changing_matrices, changing_words
from magtensor.loop.remainder.excess import excess_rms
from magtensor.loop.remainder.flagged import (
    ALIKE,
    MANY_FLAGGED,
    after_pauses,
    before_the_memory,
    flagged_words,
    lasting,
    unread_words,
)
from magtensor.loop.remainder.gradient_shape import MODEL, gradient_share
from magtensor.loop.remainder.jitter import jitter_words
from magtensor.loop.remainder.limited_band import Band, limited_band
from magtensor.loop.remainder.loud import Loud, louder_words
from magtensor.loop.remainder.outlying import Outlying, outlying_words, spike_words
from magtensor.loop.remainder.popcorn import popcorn_words
from magtensor.loop.remainder.predictable import attitude_words, converter_words, shortened_words
from magtensor.loop.remainder.sparse_readings import SparseReadings, sparse_readings
from magtensor.loop.remainder.tones import channels_of_the_line, of_the_turning
from magtensor.loop.remainder.turned_too_far import turned_too_far_words
from magtensor.loop.remainder.with_the_field import with_the_field
from magtensor.loop.searching.along_one_vector import switching_words
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.gates import explained_by
from magtensor.loop.searching.latent import LEFT_BY_LAWS, shared_words
from magtensor.loop.searching.like_a_station import (
    channels_of_the_total_field,
    only_a_constant,
    turns_with_the_platform,
)
from magtensor.loop.searching.suspects import Suspects
from magtensor.sharing import shared_out

ALPHA = 0.001  # of each of the tests
OF_A_LINE = 0.1  # of the square of what is left above the noise: less than that says nothing of its cause
MUCH = 3.0  # times the white noise of an output: no base station beside a site differs by so much unnoticed
TWICE = 2.0  # what the slow noise of the sensors, known from few frequencies, makes of it
NO_NOISE = 5.0  # times the white noise: of noise whose power goes with 1/f the slow part has three at most
OF_A_LAW = 0.02  # of what an effect makes of |b| - F, that the next order of its law may be
NOISE = "what is left is noise: white, and slow noise of each sensor alone or of the reference"


def unexplained(found: Search, record: Record) -> dict[str, Any]:
    """The `unexplained` block of the contract."""
    state = found.told
    excess = excess_rms(state)
    sparse = sparse_readings(state, record)
    bad = disturbed(record, state, found.how)
    starts, paused = after_pauses(bad, state.excitation)
    unknown_yet, began = before_the_memory(bad, state)
    flagged = lasting(bad, unknown_yet) | starts
    loud = Loud.of(state, record, found.how)
    suspects = Suspects.of(found, flagged, unknown_yet, sparse, loud.stretches, _seen_alike(state.residual))
    outlying = Outlying.of(state, record)
    too_often, theirs = outlying_words(outlying, ~np.asarray(state.fit.keep))
    shows = _what_shows(found, record, excess, sparse)
    if not shows and not _of_second_order(state):
        shows = along_an_effect_words(state) or popcorn_words(state)
    words = [*shows, *suspects.words, *too_often]
    band = None if words else limited_band(state.residual)
    times = _slow(state, record) / state.residual.scale
    if not words and (times if band is None else band.slow) > NO_NOISE:
        words.append(
            f"it is slow, and {times:.2g} times the white noise, where noise with a power of 1/f has three at most: "
            "what moved there follows nothing that is logged"
        )
    elif band is not None:
        excess = max(excess**2 + state.residual.scale**2 - band.rms_nT**2, 0.0) ** 0.5
    beside = [*loud.words, *louder_words(state, record), *unread_words(state, record)]
    if excess < state.residual.scale and words == _left_by_a_law(found, record):
        words, beside = [], [*words, *beside]
    gradient = gradient_share(state, record.position)
    shaped = bool(words) and gradient > 0
    if shaped:
        lacks = " and ".join(found.not_tested.get(MODEL, ()))
        words.append(
            f"{gradient:.0%} of what differs between the sensors has the shape of a uniform gradient of the field"
            + (f": {MODEL}, which cannot be tested without {lacks}, would look like this" if lacks else "")
        )
    if words:
        in_use = " at the samples in use" if bad.mean() > MANY_FLAGGED else ""
        size = f"{excess:.3g} nT rms above the white noise{in_use}, {_where(state)}"
        words.insert(0, size if excess else "in all no more than white noise leaves, but not at random")
    beside += [sparse.words] if sparse is not None else suspects.noise_words
    beside += [*suspects.small_words, *([began] if began else [])]
    beside += switching_words(state, len(found.first.adopted))
    beside += spike_words(outlying, bad & ~(lasting(bad) | starts | unknown_yet | theirs))
    if record.absent:
        beside.append(f"not searched, for most of the survey lacks it: {', '.join(record.absent)}")
    if flagged.any():
        left_out, noise = flagged_words(flagged, state, record, sparse)
        (beside if noise and not paused else words).append(left_out + paused)
    present = bool(words)
    findings = words if present else noise_words(state, record, band)
    untested = [MODEL] if shaped and MODEL in found.not_tested else []
    return {
        "present": present,
        "excess_rms_nT": excess,
        "description": "; ".join([*findings, *beside]),
        "findings": findings,
        "notes": beside,
        "looks_like": untested + suspects.nearest if present else [],
    }


def _what_shows(found: Search, record: Record, excess: float, sparse: SparseReadings | None) -> list[str]:
    """What no noise makes of what is left, whatever model may explain it."""
    state, words = found.told, []
    shared = found.shared
    # noise that grows louder makes a small one by chance, which predicts nothing
    if shared is not None and shared.significant and (shared.gain.consistent or shared.share > OF_A_LINE):
        words.append(shared_words(shared, record))
    line = strongest_line(state, record, between=sparse is not None)
    # where the platform turns steadily, what is no tone has a small line too
    if line is not None and line[1] ** 2 >= OF_A_LINE * excess**2:
        theirs = list(channels_of_the_line(state.excitation, line[0]))
        theirs += ["the platform's turning"] * of_the_turning(state.excitation, line[:1], line[1:])[0]
        too = f", where {' and '.join(theirs)} {'has' if len(theirs) == 1 else 'have'} one too" if theirs else ""
        words.append(f"a line at {line[0]:.4g} Hz (period {1 / line[0]:.4g} s), {line[1]:.3g} nT rms{too}")
    elif _seen_alike(state.residual):
        alone = line_of_the_station(state.residual, record.time[state.residual.samples])
        least = max(OF_A_LINE * excess**2, sparse.between**2 if sparse is not None else 0.0)  # or made between readings
        if alone is not None and alone[2] < ALPHA and alone[1] ** 2 >= least:
            words.append(f"a line of |b| - F at {alone[0]:.4g} Hz (period {1 / alone[0]:.4g} s), {alone[1]:.3g} nT rms")
    following, changing = shared_out(
        lambda of: of(state), [attitude_words, lambda state: changing_words(changing_matrices(state, ALPHA))]
    )
    predictable = following or converter_words(state)
    words.extend(predictable)
    words.extend([] if predictable else turned_too_far_words(state))
    words.extend(shortened_words(state))
    # a field that turns sweeps through a law that it lacks, and what trembles has a line and not another time
    scattered = [] if predictable or line is not None else jitter_words(state)
    words.extend([*scattered, *changing])
    words.extend([] if predictable or changing else with_the_field(state, stamps=not scattered))
    noise = noise_along(state, record, sparse)
    slow, alike = slow_along(state), _seen_alike(state.residual)
    turning = slow > TWICE * noise and alike and turns_with_the_platform(state)
    no_station = turning and state.residual.across is not None  # what one sensor wanders by turns as well
    if slow > TWICE * noise and (no_station or slow > MUCH * state.residual.scale):
        where = "in all sensors alike" if alike else "in their mean"
        cause = ""
        largest, made = _largest_of_the_total_field(state)
        if slow < OF_A_LAW * made:
            cause = f": less than {OF_A_LAW:.0%} of what {largest} makes of it, whose law may leave as much"
        elif turning:
            cause = ": it turns with the platform, as the field of something on it that no channel logs"
        elif alike:
            cause = ": an error of the base station, or a field that it does not see, of the site or of the platform"
            if only_a_constant(state.excitation):
                cause = ": the field, of which only a constant is known, or one of the platform"
            if names := channels_of_the_total_field(state, ALPHA):
                cause += f"; it follows {' and '.join(names)}"
        words.append(f"{slow:.3g} nT rms of |b| - F, {where}, is more than their white noise makes{cause}")
    return words


def _of_second_order(state: State) -> bool:
    """Whether what is left above the white noise is no more than the next order of what is adopted may be."""
    residual = state.residual
    above = (residual.square() - 1.0) * len(residual.affine) * residual.freedom
    return above < SECOND_ORDER * explained_by(state, range(len(state.adopted)))


def _left_by_a_law(found: Search, record: Record) -> list[str]:
    """Words for a waveform that the laws of what is adopted may leave, an attitude's error in a gradient above all, and
    that is less than the noise of a sample, and for what of the same the attitude predicts; none of another one."""
    shared, noise = found.shared, found.told.residual.noise
    if shared is None or shared.objection != LEFT_BY_LAWS:
        return []
    small = np.all(np.sum(shared.direction**2, axis=1) < np.sum(noise.reshape(-1, 3) ** 2, axis=1))
    return [shared_words(shared, record), *attitude_words(found.told)] if small else []


def _largest_of_the_total_field(state: State) -> tuple[str, float]:
    """The adopted model that makes most of |b| - F, and how much, nT rms; 0 of none."""
    residual, found = state.residual, ("", 0.0)
    assert residual.along is not None
    none = replace(residual, across=None, along=np.zeros_like(residual.along), sighted=None)
    for model, theta in zip(state.adopted, state.theta, strict=True):
        terms = model.terms(state.excitation)
        if terms.delay is None:
            made = taken_off(none, terms.at(residual.samples), theta).along
            assert made is not None
            found = max(
                found, (model.name, float(np.sqrt(np.mean((made / residual.reference_gain) ** 2)))), key=itemgetter(1)
            )
    return found


def noise_words(state: State, record: Record, band: Band | None) -> list[str]:
    """What is left where nothing is unexplained, and what of it is not white where that is more than what is."""
    residual, white, words = state.residual, state.residual.scale, [NOISE]
    if band is not None:
        highest = band.part / (2.0 * state.excitation.spacing)
        return [f"what is left is noise of a limited band, as behind a filter: up to {highest:.2g} Hz"]
    if residual.across is not None:
        slow = slow_across(residual)
        if slow > white:
            words.append(f"{slow:.3g} nT rms of what is left is not white, {_on_sensors(state)}")
        else:
            sensors, axis = state.excitation.sensors, np.sqrt(np.mean(residual.noise.reshape(-1, 3) ** 2, axis=1))
            each = zip(sensors, np.sqrt(np.maximum(_beyond_white(residual), 0.0)), axis, strict=True)
            slower = [f"{slow:.2g} nT rms on {name}" for name, slow, least in each if slow > least]
            if 0 < len(slower) < len(sensors):
                words.append(f"not white, in the components of the field: {', '.join(slower)}")
    if (slow := slow_along(state)) > white:
        station = of_the_station(state, record)
        makes = "may make all" if station > slow else f"makes {station:.2g} nT"  # known from how its readings scatter
        theirs = f": the base station's own noise {makes} of it" if TWICE * station > slow else ""
        words.append(f"{slow:.3g} nT rms of |b| - F is more than the white noise of the sensors makes{theirs}")
    return words


def of_the_station(state: State, record: Record) -> float:
    """nT rms of the total field that the base station's own white noise makes between its readings; 0 without one."""
    if record.total_field is None or record.quiet_field is None:
        return 0.0
    loud = (record.total_field - record.quiet_field)[state.residual.samples]
    return float(np.sqrt(np.mean((loud - loud.mean()) ** 2)))


def noise_along(state: State, record: Record, sparse: SparseReadings | None) -> float:
    """nT rms of |b| - F that the sensors' own slow noise makes, the base station's, and what it misses in between."""
    own, station = OwnNoise(state.residual, None).slow_along(), of_the_station(state, record)
    return float(np.hypot(np.hypot(own, station), sparse.between if sparse is not None else 0.0))


def restless(state: State, record: Record) -> float:
    """nT rms of |b| - F, where that is far beyond noise: something moves it that has no name; else 0."""
    slow = slow_along(state)
    if slow <= MUCH * state.residual.scale:
        return 0.0
    return slow if slow > TWICE * noise_along(state, record, sparse_readings(state, record)) else 0.0


def slow_along(state: State) -> float:
    """nT rms of |b| - F beyond white noise; 0 without a total field."""
    residual = state.residual
    if residual.along is None:
        return 0.0
    return max(float(np.mean((residual.along**2 - 1.0) / residual.reference_gain**2)), 0.0) ** 0.5


def slow_across(residual: Residual) -> float:
    """nT rms beyond white noise of what the sensors differ by; 0 of a single one."""
    if residual.across is None:
        return 0.0
    values = len(residual.across) * (residual.freedom - (residual.along is not None))
    return residual.scale * max(float(np.sum(residual.across**2)) / values - 1.0, 0.0) ** 0.5


def _slow(state: State, record: Record) -> float:
    """nT rms beyond white noise of what the sensors differ by; of a single one of |b| - F, the base station's own
    noise taken off."""
    if state.residual.across is not None:
        return slow_across(state.residual)
    return max(slow_along(state) ** 2 - of_the_station(state, record) ** 2, 0.0) ** 0.5


def strongest_line(state: State, record: Record, *, between: bool = False) -> tuple[float, float] | None:
    """Frequency in Hz and rms in nT of a spectral line that noise does not make; None without one. If asked for, of
    what differs between the sensors alone."""
    residual = replace(state.residual, along=None) if between else state.residual
    lines = spectral_lines(residual, record.time[residual.samples])
    return (lines[0][0], lines[0][1]) if lines and lines[0][2] < ALPHA else None


def _where(state: State) -> str:
    """Words for where most of what is left is."""
    residual = state.residual
    if residual.along is None or len(state.excitation.sensors) == 1:
        return _on_sensors(state)
    count, between = len(residual.along), 0.0
    if residual.across is not None:
        between = float(np.sum(residual.across**2)) - count * (residual.freedom - 1)
    if float(np.sum(residual.along**2)) - count > max(between, 0.0):
        return f"mostly in |b| - F{', alike in all sensors' * _seen_alike(state.residual)}"
    return _on_sensors(state)


def _seen_alike(residual: Residual) -> bool:
    """Whether what a residual holds above the white noise is seen by all sensors alike, as far as they could differ."""
    if residual.along is None:
        return False
    if residual.across is None:  # of one sensor
        return True
    shared = np.mean((residual.along**2 - 1.0) / residual.reference_gain**2)
    return bool(_beyond_white(residual).max() < ALIKE * shared)


def _beyond_white(residual: Residual) -> Array:
    """(S,) nT2, mean square of the vectors of each sensor across the plane, less that of white noise."""
    assert residual.across is not None
    own = np.mean((residual.across**2 - np.diagonal(residual.projector)) * residual.noise**2, axis=0)
    out: Array = own.reshape(-1, 3).sum(axis=1)
    return out


def _on_sensors(state: State) -> str:
    """Words for the sensors that hold most of what is left."""
    across = state.residual.across
    if across is None:
        return f"on {', '.join(state.excitation.sensors)}"
    each = np.mean(across.reshape(len(across), -1, 3) ** 2, axis=(0, 2))
    order = np.argsort(-each)
    top = [i for i in order if each[i] > 0.7 * each[order[0]]]
    if len(top) == len(each):
        return "on all sensors"
    return f"mostly on {', '.join(state.excitation.sensors[i] for i in sorted(top))}"
