"""What is left when the search has ended: is it noise, and if not, what does it look like?

Independent sensors have independent noise, white or slow. So what is left is called unexplained only where noise
cannot make it: a waveform that the sensors share, a line in the spectrum, what follows the direction of the field, a
sensor whose matrix is not constant, or an error model that is significant and was not adopted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from magtensor.calibration.types import Mask
from magtensor.loop.assessment import WHITE, Colours, assess, block_count
from magtensor.loop.changing_matrix import changing_matrices
from magtensor.loop.direction import attitude_series, direction_series
from magtensor.loop.excitation import Excitation
from magtensor.loop.gradient_shape import MODEL, gradient_share
from magtensor.loop.latent import shared_words
from magtensor.loop.model import Record, State, without
from magtensor.loop.residual import residual_of
from magtensor.loop.screening import Candidate
from magtensor.loop.search import Search
from magtensor.loop.spectrum import spectral_lines
from magtensor.loop.statistics import Gain, held_out_gain
from magtensor.loop.terms import Terms, joined

LONGEST_SPIKE = 2  # samples: what lasts longer is no accident of the recording
UNCOVERED = 2.0  # steps between samples
ALPHA = 0.001  # of each of the tests
NOISE = "what is left is noise: white, and slow noise of each sensor alone or of the reference"
LEAST_T = 4.5  # one in a thousand by chance: paired t over folds of what the direction predicts
MOSTLY = 0.9  # of what outputs of their own explain: if the total field alone does that, it is the total field
LEAST_FOR_DIRECTION = 60  # samples for each output, at least, before its own polynomial can be asked for


def unexplained(found: Search, record: Record) -> dict[str, Any]:
    """The `unexplained` block of the contract."""
    state = found.last
    excess = excess_rms(state)
    line = strongest_line(state, record)
    last = found.steps[-1].candidates if found.steps else ()
    seen = [c for c in last if c.passes or (c.adjusted_p < c.alpha and c.adjusted_null_p < ALPHA)]
    flagged = lasting(~state.fit.keep, beyond_the_reference(state, record))
    if flagged.any():  # while effects were sought, what lasts was believed
        seen = [c for c in seen if _still_significant(c, state)]
    suspects = [c for c in seen if not c.of_the_log]
    words: list[str] = []
    if found.shared is not None and found.shared.significant:
        words.append(shared_words(found.shared, record.sensors))
    if line is not None:
        words.append(f"a line at {line[0]:.4g} Hz (period {1 / line[0]:.4g} s), {line[1]:.3g} nT rms")
    words.extend(attitude_words(state))
    words.extend(one.words for one in changing_matrices(state, ALPHA))
    gradient = gradient_share(state, record.position)
    if open_ := [c.model.name for c in suspects if c.passes]:
        words.append(f"significant, passes the first two gates of the loop and is not adopted: {', '.join(open_)}")
    if useless := [c.model.name for c in suspects if not c.passes]:
        words.append(f"significant but of no use on held-out blocks: {', '.join(useless)}")
    shaped = bool(words) and gradient > 0
    if shaped:
        lacks = " and ".join(found.not_tested.get(MODEL, ()))
        words.append(
            f"{gradient:.0%} of what differs between the sensors has the shape of a uniform gradient of the field"
            + (f": {MODEL}, which cannot be tested without {lacks}, would look like this" if lacks else "")
        )
    if words:
        words.insert(0, f"{excess:.3g} nT rms above the white noise, mostly on {_sensors(state)}")
    if flagged.any():
        words.append(flagged_words(flagged, state, record))
    present = bool(words)
    untested = [MODEL] if shaped and MODEL in found.not_tested else []
    return {
        "present": present,
        "excess_rms_nT": excess,
        "description": "; ".join(words) if present else noise_words(state),
        "looks_like": untested + _looks_like(last) if present else [],
    }


def attitude_words(state: State) -> list[str]:
    """What of the residual the attitude predicts: in the outputs, or in the total field alone where that does."""
    turning, moving = predictable_from_direction(state), predictable_in_the_total_field(state)
    if moving > 0 and moving > MOSTLY * turning:
        spread = np.sqrt(state.residual.freedom * np.mean(state.residual.reference_gain**-2.0))  # nT, of |b| - F
        return [
            f"{moving * spread:.3g} nT rms of |b| - F, in all sensors alike, can be predicted from the attitude: the "
            "field may change as the array moves"
        ]
    amount = turning * state.residual.scale
    words = f"{amount:.3g} nT rms of it can be predicted from the direction of the field and how it turns"
    return [words] if turning > 0 else []


def noise_words(state: State) -> str:
    """What is left where nothing is unexplained, and how much of it is no white noise where that is the larger part."""
    across, along = state.residual.across, state.residual.along
    words = [NOISE]
    if across is not None:
        beyond = float(np.sum(across**2)) / (len(across) * (state.residual.freedom - (along is not None))) - 1.0
        if beyond > 1.0:
            words.append(
                f"{np.sqrt(beyond) * state.residual.scale:.3g} nT rms is not white, mostly on {_sensors(state)}"
            )
    if along is not None and np.mean(along**2) > 2.0:
        rms = np.sqrt(np.mean((along**2 - 1.0) / state.residual.reference_gain**2))
        words.append(f"{rms:.3g} nT rms of |b| - F is not white")
    return "; ".join(words)


def excess_rms(state: State) -> float:
    """nT rms of the residual above the white noise."""
    return float(np.sqrt(max(state.residual.square() - 1.0, 0.0)) * state.residual.scale)


def lasting(bad: Mask, excused: Mask | None = None) -> Mask:
    """(N,) samples in runs of bad ones that are longer than a spike and its neighbour and hold none that is excused."""
    out = np.zeros(len(bad), dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], bad.astype(int), [0]))))
    for start, stop in zip(edges[0::2], edges[1::2], strict=True):
        out[start:stop] = stop - start > LONGEST_SPIKE and (excused is None or not excused[start:stop].any())
    return out


def beyond_the_reference(state: State, record: Record) -> Mask:
    """(N,) samples for which a base station whose stamps are late or early has no reading within the survey."""
    out = np.zeros(len(record.time), dtype=bool)
    if len(record.time) < 2:
        return out
    step = float(np.median(np.diff(record.time)))
    for model in state.adopted:
        if model.component.effect == "reference" and (lag := float(model.settings.get("lag_s", 0.0))):
            at = record.time + lag
            after = np.clip(np.searchsorted(record.time, at), 1, len(record.time) - 1)
            nearest = np.minimum(np.abs(at - record.time[after - 1]), np.abs(at - record.time[after]))
            out |= nearest > UNCOVERED * step
    return out


def _still_significant(candidate: Candidate, state: State) -> bool:
    """Whether a model is asked for by the samples that are still in use."""
    from magtensor.loop.evidence import Whitened

    terms = candidate.model.terms(state.excitation).at(state.residual.samples)
    white = Whitened.of(state.residual, state.colours.across, state.colours.along, state.terms)
    now = assess(white, terms)
    return now.p * candidate.tried < candidate.alpha and now.null_p * candidate.tried < ALPHA


def flagged_words(flagged: Mask, state: State, record: Record) -> str:
    """How many samples were taken out of use because nothing explains them, when, how large, on which sensors."""
    raw, reference = without(record, [a.terms(state.excitation) for a in state.adopted], state.theta)
    every = residual_of(replace(state.fit, keep=np.ones(len(flagged), dtype=bool)), raw, reference)
    runs = int(np.sum(np.diff(np.concatenate(([0], flagged.astype(int)))) == 1))
    after = record.time[flagged] - record.start
    where, amount = "", 0.0
    if every.across is not None:
        each = (every.across[flagged] * every.noise).reshape(int(flagged.sum()), -1, 3)
        size = np.sqrt(np.mean(each**2, axis=(0, 2)))
        amount, where = float(size.max()), f", mostly on {state.excitation.sensors[int(np.argmax(size))]}"
    elif every.along is not None:
        amount = float(np.sqrt(np.mean(every.along[flagged] ** 2)) * every.scale)
    stretches = f"{runs} stretch{'es' * (runs > 1)}"
    return (
        f"{int(flagged.sum())} samples in {stretches} ({after[0]:.4g} to {after[-1]:.4g} s after the start) fit no "
        f"calibration, by {amount:.3g} nT rms{where}: they are flagged and have no part in the calibration"
    )


def predictable_from_direction(state: State) -> float:
    """The part of the whitened residual, rms, that follows the field's direction and its rate of change; 0 if none.

    Any smooth effect of attitude, named or not, is a polynomial of the direction to first order: second and third
    degree and the rate of change, with coefficients of every output's own, are fitted on some blocks and judged on
    others. Noise makes such a model worse than none.
    """
    if len(state.residual.affine) < LEAST_FOR_DIRECTION * 3 * len(state.excitation.sensors):
        return 0.0
    return _predictable(state, _direction_terms(state.excitation))


def predictable_in_the_total_field(state: State) -> float:
    """The part of the whitened residual, rms, that the attitude predicts as a change of the total field; 0 if none.

    The same for what no sensor feels alone: polynomials of the direction, and of attitudes and accelerations where they
    are logged, added to the reference.
    """
    series = attitude_series(state.excitation)
    if state.residual.along is None or len(state.residual.affine) < LEAST_FOR_DIRECTION * series.shape[1]:
        return 0.0
    each = [state.excitation.on_reference(column, "nT", str(number)) for number, column in enumerate(series.T)]
    return _predictable(state, joined(each))


def _predictable(state: State, terms: Terms) -> float:
    """The part of the whitened residual, rms over all its values, that terms at all samples predict on blocks that they
    were not fitted to; 0 if none."""
    from magtensor.loop.evidence import grams

    residual = state.residual
    terms = terms.at(residual.samples)
    given = 0
    if state.terms is not None:
        given = state.terms.count
        terms = joined([state.terms, terms])
    blocked = np.arange(terms.count) < given

    def gain_in(colours: Colours) -> Gain:
        blocks = grams(residual, terms, colours.across, colours.along, block_count(len(residual.affine)))
        return held_out_gain(blocks, residual.freedom, blocked)

    gain = gain_in(state.colours)
    if gain.total <= 0 or gain.t < LEAST_T:
        return 0.0
    before, after = gain_in(WHITE).rms  # seen through the filter the amount would be too small
    return float(np.sqrt(max(before**2 - after**2, 0.0)))


def _direction_terms(x: Excitation) -> Terms:
    """Every output's own coefficients of monomials of the field's direction and of its rate of change."""
    series = direction_series(x)
    outputs, k = 3 * len(x.sensors), series.shape[1]
    part_output, part_series = np.repeat(np.arange(outputs), k), np.tile(np.arange(k), outputs)
    return Terms(
        tuple(f"direction {s}" for s in part_series),
        tuple(x.sensors[o // 3] for o in part_output),
        ("nT",) * (outputs * k),
        series,
        np.arange(outputs * k),
        part_output,
        part_series,
    )


def strongest_line(state: State, record: Record) -> tuple[float, float] | None:
    """Frequency in Hz and rms in nT of a spectral line that noise does not make; None without one."""
    lines = spectral_lines(state.residual, record.time[state.residual.samples])
    return (lines[0][0], lines[0][1]) if lines and lines[0][2] < ALPHA else None


def _sensors(state: State) -> str:
    across = state.residual.across
    if across is None:
        return ", ".join(state.excitation.sensors)
    each = np.mean(across.reshape(len(across), -1, 3) ** 2, axis=(0, 2))
    order = np.argsort(-each)
    top = [i for i in order if each[i] > 0.7 * each[order[0]]]
    return "all sensors" if len(top) == len(each) else ", ".join(state.excitation.sensors[i] for i in sorted(top))


def _looks_like(candidates: Sequence[Candidate]) -> list[str]:
    """The models that come nearest to explaining it, most significant first."""
    near = sorted((c for c in candidates if c.adjusted_p < 0.05), key=lambda c: c.adjusted_p)
    return [c.model.name for c in near[:5]]
