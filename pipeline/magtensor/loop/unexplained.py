"""What is left when the search has ended: is it noise, and if not, what does it look like?

Independent sensors have independent noise, white or slow. So what is left is called unexplained only where noise
cannot make it: a waveform that the sensors share, a line in the spectrum, or an error model that is significant and
yet does not predict held-out data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.excitation import Excitation
from magtensor.loop.model import Record, State
from magtensor.loop.screening import WHITE, Candidate
from magtensor.loop.search import Search
from magtensor.loop.spectrum import spectral_lines
from magtensor.loop.terms import Terms

ALPHA = 0.001  # of each of the tests
SURROGATES = 1999
BINS = 120  # the common waveform is looked for in means of so many stretches
NOISE = "what is left is noise: white, and slow noise of each sensor alone"
LEAST_T = 4.5  # one in a thousand by chance: paired t over folds of what the direction predicts
LEAST_FOR_DIRECTION = 60  # samples for each output, at least, before its own polynomial can be asked for
MOST_LAG = 0.1  # of the survey, in which a channel is compared with the waveform


@dataclass(frozen=True)
class Waveform:
    """The strongest waveform the sensors share.

    Attributes:
        time: (K,) s; values: (K,) of unit rms; direction: (S, 3) nT per unit at each sensor, off the common plane.
        share: of the slow residual's variance; p: of a share as large among independent noise.
    """

    time: Array
    values: Array
    direction: Array
    share: float
    p: float


def unexplained(found: Search, record: Record) -> dict[str, Any]:
    """The `unexplained` block of the contract."""
    state = found.last
    residual = state.residual
    excess = float(np.sqrt(max(residual.square() - 1.0, 0.0)) * residual.scale)
    waveform = common_waveform(state, record)
    line = strongest_line(state, record)
    turning = predictable_from_direction(state)
    last = found.steps[-1].candidates if found.steps else ()
    suspects = [c for c in last if c.adjusted_p < c.alpha and not c.of_the_log]
    words: list[str] = []
    if waveform is not None and waveform.p <= ALPHA:
        words.append(_waveform_words(waveform, record))
    if line is not None:
        words.append(f"a line at {line[0]:.4g} Hz (period {1 / line[0]:.4g} s), {line[1]:.3g} nT rms")
    if turning > 0:
        words.append(f"{turning:.3g} nT rms of it can be predicted from the direction of the field and how it turns")
    if suspects:
        names = ", ".join(c.model.name for c in suspects)
        words.append(f"significant but of no use on held-out blocks: {names}")
    present = bool(words)
    if present:
        words.insert(0, f"{excess:.3g} nT rms above the white noise, mostly on {_sensors(state)}")
    return {
        "present": present,
        "excess_rms_nT": excess,
        "description": "; ".join(words) if present else NOISE,
        "looks_like": _looks_like(last) if present else [],
    }


def predictable_from_direction(state: State) -> float:
    """nT rms of the residual that follows the field's direction and its rate of change, whatever the law; 0 if none.

    Any smooth effect of attitude, named or not, is a polynomial of the direction to first order: second and third
    degree and the rate of change, with coefficients of every output's own, are fitted on some blocks and judged on
    others. Noise makes such a model worse than none.
    """
    from magtensor.loop.assessment import Colours, block_count
    from magtensor.loop.evidence import grams
    from magtensor.loop.statistics import Gain, held_out_gain
    from magtensor.loop.terms import joined

    residual, x = state.residual, state.excitation
    if len(residual.affine) < LEAST_FOR_DIRECTION * 3 * len(x.sensors):
        return 0.0
    terms = _direction_terms(x).at(residual.samples)
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
    return float(np.sqrt(max(before**2 - after**2, 0.0)) * residual.scale)


def _direction_terms(x: Excitation) -> Terms:
    """Every output's own coefficients of monomials of the field's direction and of its rate of change."""
    b = x.field[:, 0]
    u = b / np.linalg.norm(b, axis=1, keepdims=True)
    rate = x.derivative(u)
    spread = rate.std()
    columns = [u[:, i] * u[:, j] for i in range(3) for j in range(i, 3) if (i, j) != (2, 2)]
    thirds = [(i, j, k) for i in range(3) for j in range(i, 3) for k in range(j, 3) if (i, j, k) != (2, 2, 2)]
    columns += [u[:, i] * u[:, j] * u[:, k] for i, j, k in thirds]
    if spread > 0:
        columns += [rate[:, i] / spread for i in range(3)]
    series = np.column_stack(columns)
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


def common_waveform(state: State, record: Record) -> Waveform | None:
    """The first principal component of the slow residual over the sensors, judged against shifted copies.

    Every coordinate off the plane is shifted in time by a random amount, which keeps its own spectrum and breaks what
    it has in common with the others.
    """
    residual = state.residual
    if residual.across is None or len(residual.affine) < 4 * BINS:
        return None
    values, vectors = np.linalg.eigh(residual.projector)
    basis = vectors[:, values > 0.5]
    n = len(residual.affine) // BINS * BINS
    coordinates = residual.across @ basis
    slow = coordinates[:n].reshape(BINS, -1, basis.shape[1]).mean(axis=1)
    slow = slow / np.maximum(slow.std(axis=0), 1e-300)
    share = _leading(slow)
    rng = np.random.default_rng(20171)
    surrogate = np.empty(SURROGATES)
    for k in range(SURROGATES):
        shifts = rng.integers(0, BINS, slow.shape[1])
        surrogate[k] = _leading(np.column_stack([np.roll(c, s) for c, s in zip(slow.T, shifts, strict=True)]))
    p = float((1 + np.sum(surrogate >= share)) / (SURROGATES + 1))
    raw = coordinates[:n].reshape(BINS, -1, basis.shape[1]).mean(axis=1)
    u, s, vt = np.linalg.svd(raw - raw.mean(axis=0), full_matrices=False)
    wave = u[:, 0] * np.sqrt(BINS)
    direction = (basis @ vt[0] * s[0] / np.sqrt(BINS)) * residual.noise
    time = record.time[residual.samples[:n]].reshape(BINS, -1).mean(axis=1)
    return Waveform(time, wave, direction.reshape(-1, 3), share, p)


def _leading(slow: Array) -> float:
    s = np.linalg.svd(slow - slow.mean(axis=0), compute_uv=False)
    return float(s[0] ** 2 / np.sum(s**2))


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


def _waveform_words(waveform: Waveform, record: Record) -> str:
    strength = np.sqrt(np.sum(waveform.direction**2, axis=1))
    each = ", ".join(f"{s} {a:.2g} nT" for s, a in zip(record.sensors, strength, strict=True))
    words = f"the sensors share one waveform ({waveform.share:.0%} of the slow residual; {each})"
    followed = _followed(waveform, record)
    if followed is not None:
        name, lag, power, correlation = followed
        to_the = "" if power == 1 else f" to the power {power}"
        words += f", most like channel {name}{to_the} with a lag of {lag:.3g} s (correlation {correlation:+.2f})"
    else:
        words += ", which follows no logged channel"
    return words


def _followed(waveform: Waveform, record: Record) -> tuple[str, float, int, float] | None:
    """The channel, lag, power and correlation that come nearest to the waveform, if they come near."""
    step = float(np.median(np.diff(waveform.time)))
    most = max(1, int(MOST_LAG * len(waveform.time)))
    best: tuple[str, float, int, float] | None = None
    for name, values in record.logged.items():
        for column in values.reshape(len(values), -1).T:
            sampled = np.interp(waveform.time, record.time, column)
            for power in (1, 2, 3):
                series = sampled**power
                if series.std() == 0:
                    continue
                for shift in range(most + 1):
                    a = waveform.values[shift:]
                    b = series[: len(series) - shift]
                    if b.std() == 0:
                        continue
                    c = float(np.corrcoef(a, b)[0, 1])
                    if best is None or abs(c) > abs(best[3]) + 0.01:
                        best = (name, shift * step, power, c)
    return best if best is not None and abs(best[3]) > 0.7 else None


def _looks_like(candidates: Sequence[Candidate]) -> list[str]:
    """The models that come nearest to explaining it, most significant first."""
    near = sorted((c for c in candidates if c.adjusted_p < 0.05), key=lambda c: c.adjusted_p)
    return [c.model.name for c in near[:5]]
