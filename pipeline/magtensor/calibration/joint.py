"""All sensors and the reference in one fit.

The likelihood of C and o of every sensor, the unknown field of every sample eliminated, splits in two: the plane
that the outputs share (`common_field`) holds 3 S - 3 values a sample that no total field can add to, and the
position in that plane is one three-axis sensor, better than any single one, which the total field calibrates
(`maximum_likelihood`). The two parts meet only in products of noise with noise over F, so solving one after the
other is the joint maximum-likelihood estimate; two-step methods lose because they calibrate each sensor against
the total field before they use what the sensors have in common (METHODS A4.8).

Up to `AT_ONCE` samples are fitted together. A longer recording is begun with an even selection of it, which also
tells the noise, and finished in one reading of the whole (`whole_record`): memory does not grow with its length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magtensor.errors import DataError, NotEnoughData

from .agreement import LARGEST_BEFORE_EFFECTS, LARGEST_DISAGREEMENT, require_agreement
from .axes import flat_words, mirrored_words, turned_words
from .blocks import Blocks, blocks_of
from .by_sensor import by_sensor
from .common_field import CommonField
from .coverage import WORST_ERROR, Coverage, coverage, require_coverage
from .joint_covariance import forward_covariance, to_corrections
from .joint_together import Together, fit_together, limits_of, unfolded
from .maximum_likelihood import ScalarFit
from .noise import noise_std
from .recording import InMemory, Recording, even_blocks, selected
from .score_colour import ScoreColour, colour_of_scores
from .types import Array, ArrayCalibration, Mask
from .whole_record import fit_whole

AT_ONCE = 65_536  # samples of a recording that is fitted without a selection
SELECTION = 16_384  # samples that a longer one begins with
LARGEST_SELECTION = 2_000_000  # where the attitudes of smaller ones do not suffice


@dataclass(frozen=True)
class Posterior:
    """What is known of C and o where a prior had to stand in for attitudes (`nominal`).

    Attributes:
        covariance, prior: (12 S, 12 S) of C Q (row by row) and o of each sensor, in the frame of `nearest_frame`;
            with the data, and before them.
        field: (N, 3) nT, the common field of every sample in the axes of C: the point of the sphere of the total field
            that is nearest in the metric of the noise, so that it holds none of what the residual is made of.
    """

    covariance: Array
    prior: Array
    field: Array


@dataclass(frozen=True)
class JointFit:
    """The joint estimate before it is put into a frame.

    Attributes:
        forward: (S, 3, 3), C of m = C b + o; offset: (S, 3) nT.
        plane: the common field; scalar: the calibration within its plane.
        keep: (N,) samples that were used.
        coverage: what their attitudes can determine, judged in the frame of `nearest_frame`.
        colour: of the scores; None where the noise passes for white, or was not asked for (`fit_recording`).
        posterior: of a fit that leans on a prior; None where the attitudes alone determine it.
    """

    forward: Array
    offset: Array
    plane: CommonField
    scalar: ScalarFit
    keep: Mask
    coverage: Coverage
    colour: ScoreColour | None = None
    posterior: Posterior | None = None


def fit_joint(raw: Array, total_field: Array, **options: Any) -> JointFit:
    """Fit C and o of all sensors to their outputs raw (N, S, 3) nT, finite, and the total field (N,) nT, positive.

    The options, and what is refused, are those of `fit_recording`.
    """
    return fit_recording(InMemory(raw, total_field), **options)


def fit_recording(
    recording: Recording,
    *,
    noise: Array | None = None,
    reference_noise: float = 0.0,
    robust: bool = True,
    worst_error: float = WORST_ERROR,
    keep: Mask | None = None,
    complete: bool = True,
    known: Coverage | None = None,
) -> JointFit:
    """Fit C and o of all sensors to a recording of their outputs and the total field.

    Parameters
    ----------
    noise: (S, 3) nT of the raw outputs; when None that of second differences, with few samples of the residual.
    reference_noise: nT, white, of the total field.
    robust: leave out samples that no noise explains.
    worst_error: see `coverage.coverage`.
    keep: (N,) the samples to believe; judged here when None.
    complete: the model is believed to hold all there is, so that a misfit is noise, whose colour is then found
        (later: `with_colour`). Where it is not, an effect that no one has added yet must not pass for a lack of
        attitudes.
    known: what was found of the same attitudes before, which are not judged again then.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the parameters; the message says which are missing.
    DataError: a mirrored sensor, or one that does not see the field of the others.
    """
    judge = robust and keep is None
    given = [mask for mask in (keep, recording.usable) if mask is not None]
    allowed = np.logical_and.reduce(given) if given else None
    among = None if allowed is None else np.flatnonzero(allowed)
    count = recording.count if among is None else len(among)
    samples = count if count <= AT_ONCE else SELECTION
    while True:
        chosen = even_blocks(count, samples)
        chosen = chosen if among is None else among[chosen]
        try:
            part = Together(*selected(recording, chosen), np.cumsum(np.diff(chosen, prepend=-1) != 1))
            begun = fit_together(part, noise=noise, reference_noise=reference_noise, judge=judge, complete=complete)
            level = None if complete else _level(part, begun.plane, begun.scalar, begun.keep)
            if len(chosen) == count:
                used = np.zeros(recording.count, dtype=bool)
                used[chosen] = begun.keep
                raw, total_field = part.raw[begun.keep], part.total_field[begun.keep]
                found = _accepted(begun.plane, begun.scalar, used, raw, total_field, worst_error, level, known)
                return with_colour(found, raw, total_field, reference_noise) if complete else found
            limits = limits_of(begun, part, reference_noise, count) if judge else None
            whole = fit_whole(
                recording, begun.plane, begun.scalar, limits=limits, reference_noise=reference_noise, keep=allowed
            )
            found = _accepted(
                whole.plane, whole.scalar, whole.keep, whole.raw, whole.total_field, worst_error, level, known
            )
            return _coloured(found, whole.blocks) if complete else found
        except NotEnoughData:
            # what a selection lacks, the rest may hold
            if len(chosen) == count or samples >= LARGEST_SELECTION:
                raise
            samples = min(8 * samples, LARGEST_SELECTION)


def _accepted(
    plane: CommonField,
    scalar: ScalarFit,
    keep: Mask,
    raw: Array,
    total_field: Array,
    worst_error: float,
    level: float | None,
    known: Coverage | None,
) -> JointFit:
    """The fit, once the samples raw (n, S, 3) and total_field (n,), an even choice of those used, have been found to
    determine it."""
    forward, offset = unfolded(plane, scalar)
    if known is not None:
        return JointFit(forward, offset, plane, scalar, keep, known)
    # judged on the calibrated field, whose axes are nearest to those of the sensors
    field = scalar.field(plane.coordinates(raw)) @ nearest_frame(forward)
    found = coverage(
        field,
        total_field,
        matrix=np.eye(3),
        offset=np.zeros(3),
        worst_error=worst_error,
        noise=level,
        stands_for=int(keep.sum()),
    )
    require_coverage(found)
    refuse_sensors(forward, offset, raw, total_field, complete=level is None)
    return JointFit(forward, offset, plane, scalar, keep, found)


def with_colour(fit: JointFit, raw: Array, total_field: Array, reference_noise: float = 0.0) -> JointFit:
    """The fit with the colour of its noise, from the samples raw (n, S, 3), total_field (n,) that it used."""
    if fit.posterior is not None:
        return fit
    return _coloured(fit, blocks_of(fit.plane, fit.scalar, raw, total_field, reference_noise))


def _coloured(fit: JointFit, blocks: Blocks) -> JointFit:
    found = colour_of_scores(blocks.at(fit.plane, fit.scalar), fit.plane.chi2, fit.scalar.chi2)
    return replace(fit, colour=found)


def _level(part: Together, plane: CommonField, scalar: ScalarFit, keep: Mask) -> float:
    """nT, the noise of the calibrated field at the highest frequencies."""
    field = scalar.field(plane.coordinates(part.raw[keep]))
    return float(noise_std(field[:, None], part.total_field[keep])[0, 0])


def refuse_sensors(forward: Array, offset: Array, raw: Array, total_field: Array, *, complete: bool = True) -> None:
    """Sensors that are mirrored, or flat, and those that have nothing in common with the others, whose C is next to
    singular; what is not complete may lack an effect by which a sensor differs so much."""
    some = slice(None, None, max(1, len(raw) // 20_000))
    correction = np.asarray(np.linalg.pinv(forward, rcond=1e-9), dtype=np.float64)
    largest = LARGEST_DISAGREEMENT if complete else LARGEST_BEFORE_EFFECTS
    require_agreement(by_sensor(correction, raw[some] - offset), total_field[some], largest)
    if complete and (words := flat_words(forward)):
        raise DataError("; ".join(words), hint="b_raw is samples, sensors, axes: are two of these exchanged?")
    if words := mirrored_words(correction):
        raise DataError(
            "; ".join(words), hint="correct the sign or the order of the named axes when loading the survey"
        )


def nearest_frame(forward: Array) -> Array:
    """The rotation Q (3, 3) that brings all C_s Q together as near to the identity as they get.

    The frame nearest to the raw axes of the whole array: of all frames that scalar data allow, the one that leaves
    the corrections smallest. It is the platform's frame only as far as the sensors are mounted along it.
    """
    u, _, vt = np.linalg.svd(forward.sum(axis=0))
    q: Array = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    return q


def diagnostics(
    keep: Mask, chi2_along: float, plane: CommonField, found: Coverage, matrix: Array
) -> dict[str, float | str]:
    """What every joint fit reports; chi2_along: mean square of the whitened residuals along the field."""
    return {
        "samples": float(keep.sum()),
        "rejected": float((~keep).sum()),
        "chi2_total_field": chi2_along,
        "chi2_contrasts": plane.chi2,
        "noise_nT": float(np.sqrt(np.mean(plane.noise**2))),
        "condition_number": found.condition_number,
        "missing_attitudes": found.missing,
        "further_postures": str(found.further),
        "axes": "; ".join(turned_words(matrix)),
    }


def widening(covariance: Array, white: Array) -> dict[str, float | str]:
    """By how much noise that is not white widened the standard deviations, rms over the elements of all sensors."""
    ratio = (np.diag(covariance) / np.diag(white)).reshape(-1, 12)
    return {
        "widened_offsets": float(np.sqrt(ratio[:, 9:].mean())),
        "widened_matrices": float(np.sqrt(ratio[:, :9].mean())),
    }


def calibrated(fit: JointFit) -> ArrayCalibration:
    """The fit as corrections in the frame nearest to the raw axes, with the covariance of all 12 S parameters."""
    q = nearest_frame(fit.forward)
    forward = fit.forward @ q
    matrix = np.asarray(np.linalg.inv(forward), dtype=np.float64)
    chain = to_corrections(matrix)
    if fit.posterior is None:
        covariance = chain @ forward_covariance(fit.plane, fit.scalar, forward, q, fit.colour) @ chain.T
    else:
        covariance = chain @ fit.posterior.covariance @ chain.T
    told = diagnostics(fit.keep, fit.scalar.chi2, fit.plane, fit.coverage, matrix)
    if fit.colour is not None:
        told |= widening(covariance, chain @ forward_covariance(fit.plane, fit.scalar, forward, q) @ chain.T)
    return ArrayCalibration(
        matrix,
        fit.offset,
        covariance,
        "array (nearest to the raw axes)",
        ("one rotation of the whole array: the frame nearest to the raw axes was chosen",),
        told,
    )
