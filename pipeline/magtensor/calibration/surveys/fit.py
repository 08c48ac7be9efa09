"""The joint fit of several surveys of one array: one C, an offset for each survey or one for all.

Whitened outputs of survey k are x = V (U^-1 b + c_k) + mean_k across the plane + noise. The plane V is spanned by the
leading principal axes of the covariance within the surveys, and what lies across it is closed-form as for one survey;
within the plane one matrix U and a centre c_k for each survey are sought together (`sums`). One survey whose total
field is an unknown constant in each of its segments, or whose attitude tells the field's direction, is the same fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.common_field import CommonField, common_field, output_noise
from magtensor.calibration.coverage import WORST_ERROR, Coverage, coverage_alone, require_coverage
from magtensor.calibration.joint import nearest_frame, refuse_sensors
from magtensor.calibration.joint_together import FALSE_REJECTION, LEAST_FOR_REJECTION, told_apart
from magtensor.calibration.maximum_likelihood import along
from magtensor.calibration.types import Array, Mask
from magtensor.errors import DataError, NotEnoughData

from .colour import with_colour
from .design import Design
from .directions import across, attitude_std, disagreement, sighting
from .said import Said, each_of, said, view
from .samples import Samples
from .start import on_ellipsoid, on_known_field
from .sums import Found, InPlane, minimised, with_scale

BY_CHANCE = 0.01  # probability that noise as stated passes for more
LEAST_SPREAD = 0.02  # of F: outputs that vary less saw one attitude
LEAST_PER_SURVEY = 4  # samples: fewer cannot tell an offset
_ROUNDS = 20
_SETTLED = 0.01  # of the attitude's standard deviation
_ROUGH = 1e-2  # rad, an attitude's standard deviation before anything is known of it


@dataclass(frozen=True)
class SurveysFit:
    """The fit, before it is put into a frame and units.

    Attributes:
        forward: (S, 3, 3), C; offset: (K, S, 3) nT, of each survey, or one for all.
        plane: of the outputs less the mean of each survey; data, found: the fit within it, of the samples kept.
        keep: (N,) samples that were used.
        coverage: of all surveys together.
        attitude_std: rad; None without known directions.
        attitude_excess: by how much the variance of what the attitudes tell was widened (`directions.disagreement`).
        said: what every survey says at these parameters, in the calibration's frame (`frame_of`).
    """

    forward: Array
    offset: Array
    plane: CommonField
    data: InPlane
    found: Found
    keep: Mask
    coverage: Coverage
    attitude_std: float | None = None
    attitude_excess: float = 1.0
    said: tuple[Said, ...] = ()

    @property
    def design(self) -> Design:
        """Of C and the offsets."""
        surveys = len(self.said)
        weights = np.eye(surveys) if len(self.offset) > 1 else np.ones((surveys, 1))
        return Design(np.ones((surveys, 1)), weights, self.plane.noise, self.attitude_std is not None)

    @property
    def chi2_along(self) -> float:
        """Mean square of the whitened residuals along the field, per degree of freedom."""
        levels = 0 if self.data.level is None else len(np.unique(self.data.level)) - 1
        freedom = len(self.data.y) - (6 + 3 * self.data.centres) - levels
        return self.found.sums.along / max(freedom, 1)


def fit_surveys(
    samples: Samples,
    *,
    common_offsets: bool = False,
    noise: Array | None = None,
    reference_noise: float = 0.0,
    attitude: float | None = None,
    robust: bool = True,
    worst_error: float = WORST_ERROR,
    mean_field: float | None = None,
    complete: bool = True,
    keep: Mask | None = None,
) -> SurveysFit:
    """Fit C of all sensors and their offsets to several surveys.

    Parameters
    ----------
    samples: finite.
    common_offsets: one offset for all surveys; else one for each.
    noise: (S, 3) nT of the raw outputs; found from the samples when None.
    reference_noise: nT, white, of the total field.
    attitude: rad, standard deviation of the known directions about each axis; found from the samples when None.
    robust: leave out samples that no noise explains.
    worst_error: see `coverage.coverage`.
    mean_field: nT, the mean over the samples of a total field that is an unknown constant of some of them.
    complete: the model holds all there is. Where it does not, what an effect without a model leaves must not pass for
        a lack of attitudes or a broken sensor: neither is asked for, nor what each survey says.
    keep: (N,) samples to believe; judged here when None.

    Raises
    ------
    NotEnoughData: the attitudes do not determine the parameters; the message says which are missing.
    DataError: values that no fit can use, a mirrored sensor, or one that does not see the field of the others.
    """
    require_usable(samples)
    _require_turned_within_levels(samples)
    sensors, count = samples.raw.shape[1], len(samples.raw)
    judge = robust and keep is None and count >= LEAST_FOR_REJECTION
    own_noise = noise is None and sensors > 1 and count >= LEAST_FOR_REJECTION
    keep = np.ones(count, dtype=bool) if keep is None else keep
    given = output_noise(samples.raw, keep, samples.run) if own_noise else noise
    told = 2 if sensors == 2 and own_noise else 0
    one = sensors == 1 and noise is None
    for _ in range(_ROUNDS):
        fit = fitted(samples, keep, given, common_offsets, reference_noise, attitude, worst_error)
        if told > 0 and given is not None:
            given, told = _told_apart(given, fit, samples), told - 1
            continue
        if one:
            given, one = fit.plane.noise.reshape(1, 3) * np.sqrt(fit.chi2_along), False
            continue
        if not judge:
            break
        again = _believed(fit, samples)
        if np.array_equal(again, keep):
            break
        if again.sum() < 0.5 * count:
            raise NotEnoughData(
                "more than half of the samples disagree with any one calibration",
                hint="look for a moving magnetic object, a dead axis or wrong units"
                + ("; C may also change from survey to survey: `matrices: linear`" if samples.surveys > 1 else ""),
            )
        left = np.bincount(samples.survey[again], minlength=samples.surveys)
        if left.min() < LEAST_PER_SURVEY:
            raise NotEnoughData(
                f"nearly all samples of survey {int(left.argmin()) + 1} of {len(left)} disagree with the others",
                hint="leave it out, or calibrate it alone and compare; C may also change slowly: `matrices: linear`",
            )
        keep, one = again, sensors == 1 and noise is None
        if own_noise:
            given = output_noise(samples.raw, keep, samples.run)
            given = _told_apart(given, fit, samples) if sensors == 2 else given
    if complete:
        require_coverage(fit.coverage)
    if mean_field is not None and samples.level is not None:
        fit = _scaled(fit, mean_field / float(np.mean(fit.found.sums.total_field)))
    if not complete:
        return fit
    used = samples.at(fit.keep)
    _refuse(fit, used)
    forward = fit.forward @ frame_of(fit.forward, fit.attitude_std is not None)
    offset = fit.offset if len(fit.offset) > 1 else np.repeat(fit.offset, samples.surveys, axis=0)
    seen = [view(one, forward, o, fit.plane.noise) for one, o in zip(each_of(used, fit.data), offset, strict=True)]
    return replace(fit, said=tuple(with_colour(one, said(one), samples.surveys) for one in seen))


def frame_of(forward: Array, sighted: bool) -> Array:
    """The rotation Q (3, 3) that brings C to the frame of the calibration: the nearest to the raw axes, or its own
    where directions are known."""
    return np.eye(3) if sighted else nearest_frame(forward)


def require_usable(samples: Samples) -> None:
    """Refuse samples that are not finite, and surveys too small for an offset."""
    finite = np.isfinite(samples.raw).all() and np.isfinite(samples.total_field).all()
    if not finite or (samples.direction is not None and not np.isfinite(samples.direction).all()):
        raise DataError("the samples are not all finite", hint="mask the gaps before calibrating")
    if samples.total_field.min() <= 0:
        raise DataError("the reference total field is not positive", hint="the total field must be in nT")
    counts = np.bincount(samples.survey)
    if counts.min() < LEAST_PER_SURVEY:
        raise NotEnoughData(
            f"survey {int(counts.argmin()) + 1} of {len(counts)} has {counts.min()} samples in use, where "
            f"{LEAST_PER_SURVEY} are the least that can tell an offset",
            hint="leave it out, or `offsets: common`",
        )


def _require_turned_within_levels(samples: Samples) -> None:
    """A total field that is unknown anew at every attitude leaves |b| nothing to be compared with."""
    if samples.level is None:
        return
    weight = np.bincount(samples.level).astype(float)
    flat = samples.raw[:, 0] / samples.total_field[0]
    sums = np.stack([np.bincount(samples.level, c) for c in flat.T])
    within = np.sum(flat**2) - np.sum(sums**2 / np.maximum(weight, 1.0))
    spread = float(np.sqrt(within / len(flat)))
    if spread < LEAST_SPREAD:
        raise NotEnoughData(
            f"while the unknown total field is constant the outputs vary by {100 * spread:.2g} % of it only: nothing "
            "tells a change of sensitivity from a change of the field",
            hint="turn the array while the field is constant, or take it for constant over all samples, or measure it",
        )


def fitted(
    samples: Samples,
    keep: Mask,
    noise: Array | None,
    common_offsets: bool,
    reference_noise: float,
    attitude: float | None,
    worst_error: float,
) -> SurveysFit:
    """The fit of samples to keep (N,) with the noise (S, 3) nT of the outputs; the rest as in `fit_surveys`."""
    used = samples.at(keep)
    centre = np.zeros(len(used.raw), dtype=int) if common_offsets else used.survey
    counts = np.bincount(centre)
    means = np.stack([used.raw[centre == k].mean(axis=0) for k in range(len(counts))])
    if len(used.raw) <= 4 + len(counts):
        raise NotEnoughData(f"{len(used.raw)} samples cannot tell the field from the sensors of {len(counts)} surveys")
    centred = used.raw - means[centre]
    plane = common_field(centred, noise)
    # the means of all surveys were taken off, where `common_field` knows of one
    lost = (len(centred) - 4) / max(len(centred) - 3 - len(counts), 1)
    plane = replace(plane, chi2=plane.chi2 * lost)
    if noise is None and used.raw.shape[1] > 1:
        plane = replace(plane, noise=plane.noise * np.sqrt(lost), chi2=plane.chi2 / lost)
    data = InPlane(plane.coordinates(centred), centre, used.total_field, used.level, reference_noise)
    shifts = (means.reshape(len(means), -1) / plane.noise) @ plane.basis
    std: float | None = None
    wider = 1.0
    if used.direction is None:
        try:
            found = on_ellipsoid(data, shifts)
        except NotEnoughData:
            nominal = (centred + means[0])[:, 0]  # the refusal that names the missing attitudes, if they are missing
            require_coverage(coverage_alone(nominal, used.total_field)[0])
            raise
    else:
        data, found, std, wider = _sighted(data, used.direction, attitude)
    forward = (plane.basis @ np.linalg.inv(found.matrix) * plane.noise[:, None]).reshape(-1, 3, 3)
    offset = means + (found.centres @ plane.basis.T * plane.noise).reshape(means.shape)
    from .judged import judged

    seen = judged(data, found, worst_error, len(forward))
    return SurveysFit(forward, offset, plane, data, found, keep, seen, std, wider)


def _sighted(data: InPlane, direction: Array, known_std: float | None) -> tuple[InPlane, Found, float, float]:
    """The fit with known directions; their standard deviation is found from what they leave, unless it is given. They
    weigh less by as much as parts of the record disagree."""
    matrix, centres = on_known_field(data, direction)
    std = _ROUGH if known_std is None else known_std
    for _ in range(_ROUNDS):
        b = data.fields(matrix, centres)
        seen = sighting(matrix, b, direction, std, None if data.level is not None else data.reference_noise)
        data = replace(data, sighting=seen)
        found = minimised(data, matrix, centres)
        moved = np.abs(found.matrix - matrix).max() / np.abs(matrix).max()
        matrix, centres = found.matrix, found.centres
        before = std
        if known_std is None:
            std = attitude_std(seen, data.fields(matrix, centres), found.sums.total_field, 6)
        noise = _reference_noise(data, found) if data.level is None else data.reference_noise
        rested = abs(std - before) <= _SETTLED * std and abs(noise - data.reference_noise) <= _SETTLED * noise
        if rested and moved < 1e-6:
            break
        data = replace(data, reference_noise=noise)
    assert data.sighting is not None
    wider = disagreement(data.sighting, data.fields(matrix, centres), found.sums.total_field)
    if wider > 1.0:
        root, coupling = data.sighting.root / np.sqrt(wider), data.sighting.coupling / np.sqrt(wider)
        data = replace(data, sighting=replace(data.sighting, root=root, coupling=coupling))
        found = minimised(data, matrix, centres)
    return data, found, std, wider


def _reference_noise(data: InPlane, found: Found) -> float:
    """nT: that of the total field where |b| - F scatters by more than it and the outputs do: beside directions it is
    the ratio of both weights that counts. Unchanged where the excess may be chance."""
    from scipy.special import chdtri

    freedom = max(len(data.y) - 6 - 3 * data.centres, 1)
    if found.sums.along <= float(chdtri(freedom, BY_CHANCE)):
        return data.reference_noise
    own = np.trace(found.matrix @ found.matrix.T) / 3.0 + data.reference_noise**2
    return float(np.sqrt(data.reference_noise**2 + own * (found.sums.along / freedom - 1.0)))


def _scaled(fit: SurveysFit, factor: float) -> SurveysFit:
    """The fit of fields that are `factor` times as large."""
    return replace(fit, forward=fit.forward / factor, found=with_scale(fit.data, fit.found, factor))


def _told_apart(noise: Array, fit: SurveysFit, samples: Samples) -> Array:
    used = samples.at(fit.keep)
    offset = fit.offset[fit.data.centre]
    return told_apart(noise, (fit.forward, np.zeros((2, 3))), used.raw - offset, fit.found.sums.total_field)


def _believed(fit: SurveysFit, samples: Samples) -> Mask:
    """(N,) samples whose squared residuals noise explains."""
    from scipy.special import chdtri

    parts = whitened(fit, samples)
    good = np.ones(len(samples.raw), dtype=bool)
    for freedom, residual in parts:
        values = np.sum(residual**2, axis=1)
        level = FALSE_REJECTION / (len(values) * len(parts))
        typical = max(float(np.median(values[np.isfinite(values)])) / float(chdtri(freedom, 0.5)), 1e-300)
        good &= ~(values > float(chdtri(freedom, level)) * typical)
    return good


def whitened(fit: SurveysFit, samples: Samples) -> list[tuple[int, Array]]:
    """The whitened residuals (N, Q) of all samples of a fit, left out or not, along the field, across the plane and
    across known directions, and how many independent values a sample has in each. NaN where the total field is an
    unknown constant of samples that were all left out.
    """
    centre = np.zeros(len(samples.raw), dtype=int) if len(fit.offset) == 1 else samples.survey
    white = (samples.raw - fit.offset[centre]).reshape(len(samples.raw), -1) / fit.plane.noise
    y = white @ fit.plane.basis
    total_field = samples.total_field
    if samples.level is not None:
        known = np.zeros(samples.levels)
        known[samples.level[fit.keep]] = fit.found.sums.total_field
        total_field = np.where(known[samples.level] > 0, known[samples.level], np.nan)
    seen = along(fit.found.matrix, np.zeros(3), y.T, total_field, fit.data.reference_noise)
    parts = [(1, seen.residual[:, None])]
    if white.shape[1] > 3:
        parts.append((white.shape[1] - 3, white - y @ fit.plane.basis.T))
    if samples.direction is not None and fit.attitude_std is not None:
        b = (seen.unit * seen.length).T
        view = sighting(fit.found.matrix, b, samples.direction, fit.attitude_std, fit.data.reference_noise)
        side = across(view, slice(None), b, seen.length - total_field)
        parts.append((2, side.residual))
    return parts


def _refuse(fit: SurveysFit, used: Samples) -> None:
    if fit.data.sighting is not None and (np.linalg.det(fit.forward) < 0).sum() * 2 > len(fit.forward):
        raise DataError(
            "the sensors mirror the known field", hint="an axis is inverted, two are swapped, or the attitude is "
            "world to platform"
        )  # fmt: skip
    centred = used.raw - fit.offset[fit.data.centre]
    refuse_sensors(fit.forward, np.zeros(fit.offset.shape[1:]), centred, fit.found.sums.total_field)
