"""Which pictures a result gives, in the order one looks at them, and in words which it cannot give."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array
from magtensor.report import attitude_pictures, flag_pictures, noise_pictures, time_pictures
from magtensor.report.content import Content, decoded
from magtensor.report.drawing import MOST_SENSORS, Picture, picture
from magtensor.report.tables import pretty
from magtensor.sharing import shared_out


@dataclass(frozen=True)
class Gap:
    """A picture that this result does not give, and why."""

    title: str
    words: str


@dataclass(frozen=True)
class Arrays:
    """What the pictures are drawn from, cut down to the sensors that fit on them.

    Attributes:
        sensors, shown: names and numbers of the sensors shown; left_out: how many are not.
        residual, before: (N, S) nT; b, contrast: (N, S, 3) nT; None where the result has none.
        noise: (S,) nT of an axis of each sensor; contrast_noise: (S,) nT, what it makes of an axis of the contrast.
    """

    sensors: list[str]
    shown: Sequence[int]
    left_out: int
    residual: Array | None
    before: Array | None
    b: Array | None
    contrast: Array | None
    noise: Array
    contrast_noise: Array


def arrays(content: Content) -> Arrays:
    """The arrays over time with flagged samples taken out; of many sensors those with the largest residual."""
    residual = content.in_use("residual/total_field")
    found = {
        "residual": residual,
        "before": content.in_use("residual/total_field_before"),
        "b": content.in_use("calibrated/b"),
        "contrast": content.in_use("residual/contrast"),
    }
    count = len(content.sensors)
    keep = np.arange(count)
    if count > MOST_SENSORS:
        size = residual if residual is not None else found["contrast"]
        if size is not None:
            power = np.nansum(size**2, axis=tuple(k for k in range(size.ndim) if k != 1))
            keep = np.sort(np.argsort(-power, kind="stable")[:MOST_SENSORS])
        keep = keep[:MOST_SENSORS]
    return Arrays(
        [content.sensors[k] for k in keep],
        [int(k) for k in keep],
        count - len(keep),
        noise=content.noise[keep],
        contrast_noise=_contrast_noise(content.noise)[keep],
        **{name: None if v is None else v[:, keep] for name, v in found.items()},
    )


def _contrast_noise(noise: Array) -> Array:
    """(S,) nT of b_s - mean(b) for independent noise of (S,) nT: (1 - 2/S) of the own variance, and all over S^2."""
    count = max(len(noise), 1)
    return np.asarray(np.sqrt((1 - 2 / count) * noise**2 + np.sum(noise**2) / count**2)) if count > 1 else 0 * noise


NO_TOTAL_FIELD = "The result holds no |b| − F: the survey has no total field, or nothing was calibrated against one."
NO_TENSOR = (
    "The result holds no tensor: it takes three or more sensors with known positions, and the stage assemble_tensor."
)


def gallery(content: Content) -> list[Picture | Gap]:
    """Every picture of the result, or the reason why there is none."""
    if not len(content.time):
        return [Gap("Pictures over time", "The result holds nothing over time: no stage calibrated the survey.")]
    use = arrays(content)
    import matplotlib.backends.backend_svg  # noqa: F401  here once, rather than in every process

    parts: list[Callable[[], list[Picture | Gap]]] = [
        lambda: _residual_pictures(content, use),
        lambda: _tensor_pictures(content),
        lambda: _attitude_pictures(content, use),
        lambda: _noise_pictures(content, use),
        lambda: [_reference(content)],
        lambda: _flag_pictures(content, use),
    ]
    return [shown for part in shared_out(lambda part: part(), parts) for shown in part]


def _residual_pictures(content: Content, use: Arrays) -> list[Picture | Gap]:
    time, units = content.time, content.time_units
    found: list[Picture | Gap] = []
    residual, contrast = use.residual, use.contrast
    title = "What is left of the total field"
    if residual is None:
        found.append(Gap(title, NO_TOTAL_FIELD))
    else:
        caption = (
            "|b| − F of each sensor; the band is twice the noise of the sensor's axes, found from the data and not "
            "from the fit. Where samples are many the pale line reaches every extreme and the dark one is their mean. "
            "At the right the same before calibration, on its own scale."
        )
        found.append(
            picture(title, caption + _left_out(use), lambda: time_pictures.total_field_residual(
                time, units, residual, use.before, use.noise, use.sensors
            ))
        )  # fmt: skip
    if contrast is not None and len(use.sensors) > 1:
        caption = (
            "Each sensor's calibrated field less the mean of all, along x, y and z; zero in a uniform field. The band "
            "is twice what the sensors' noise alone makes of it."
        )
        found.append(
            picture("Contrasts between the sensors", caption + _left_out(use), lambda: time_pictures.contrast(
                time, units, contrast, use.contrast_noise, use.sensors
            ))
        )  # fmt: skip
    return found


def _tensor_pictures(content: Content) -> list[Picture | Gap]:
    time, units = content.time, content.time_units
    tensor, std = content.in_use("calibrated/tensor"), content.variable("calibrated/tensor_std")
    if tensor is None:
        return [Gap("Gradient tensor", NO_TENSOR)]
    caption = "The components; the band is one standard deviation each side, of noise and calibration."
    found: list[Picture | Gap] = [
        picture("Gradient tensor", caption, lambda: time_pictures.tensor(time, units, tensor, std))
    ]
    names, values = _zero_by_maxwell(content)
    if values is None:
        found.append(Gap("Trace and asymmetry", "The array's geometry measures none of them independently."))
    else:
        caption = "Zero for a true gradient tensor; what shows here is error, of whatever source."
        found.append(picture("Trace and asymmetry", caption, lambda: time_pictures.closure(time, units, values, names)))
    invariants = content.in_use("calibrated/invariants")
    if invariants is not None and invariants.ndim == 2:
        entries = content.names("calibrated/invariant") or [str(k) for k in range(invariants.shape[1])]
        each = decoded(content.attributes("calibrated/invariant").get("units_of_each")) or {}
        spread = content.variable("calibrated/invariants_std")
        caption = "They do not depend on how the array is turned; the band is one standard deviation each side."
        words = [e.replace("_", " ") for e in entries]
        of = [pretty(str(each.get(e, ""))) for e in entries]
        found.append(
            picture("Invariants", caption, lambda: time_pictures.invariants(time, units, invariants, spread, words, of))
        )
    return found


def _zero_by_maxwell(content: Content) -> tuple[list[str], Array | None]:
    values, names = content.in_use("residual/closure"), content.names("residual/identity")
    if values is not None and values.ndim == 2 and values.shape[1] == len(names):
        return names, values
    single = [(n, v) for n in ("trace", "asymmetry") if (v := content.in_use(f"residual/{n}")) is not None]
    flat = [(n, v) for n, v in single if v.ndim == 1]
    return [n for n, _ in flat], np.stack([v for _, v in flat], axis=1) if flat else None


def _attitude_pictures(content: Content, use: Arrays) -> list[Picture | Gap]:
    if use.b is None:
        return [Gap("Attitudes", "The result holds no calibrated field.")]
    unit = attitude_pictures.directions(use.b)
    residual, frame = use.residual, f" Frame: {content.frame}." if content.frame else ""
    caption = (
        "Where the field pointed in the array's frame: the two halves of the sphere, each seen from +z, in equal area; "
        "rings at 30 and 60 deg. What a fit cannot know lies in the empty parts: dashed are the widest cones without a "
        "sample."
    )
    found_of = [content.coverage[k] for k in use.shown] if content.coverage else []
    if any(c is not None and len(c.further.directions) for c in found_of):
        caption += " Numbers: the field along these directions would help most, in this order; the table has the gain."

    coloured = " Colour: the mean of what is left there." if residual is not None else ""
    found: list[Picture | Gap] = [
        picture("Attitudes", caption + coloured + frame + _left_out(use), lambda: attitude_pictures.coverage(
            unit, residual, use.sensors, found_of
        ))
    ]  # fmt: skip
    if residual is not None:
        caption = (
            "Means over slices of direction, with two standard errors that take the samples as independent. Noise "
            "has no direction: what stands off zero by more than its bar is an error that goes with the attitude, or "
            "one that was there while the field pointed so."
        )
        found.append(
            picture("What is left against direction", caption + _left_out(use), lambda: (
                attitude_pictures.against_direction(unit, residual, use.sensors)
            ))
        )  # fmt: skip
    return found


def _noise_pictures(content: Content, use: Arrays) -> list[Picture | Gap]:
    found: list[Picture | Gap] = []
    title = "Spectrum of what is left"
    curves = noise_pictures.curves(
        content.time, use.residual, use.contrast if len(use.sensors) > 1 else None, use.noise, use.contrast_noise
    )
    if use.residual is None and (use.contrast is None or len(use.sensors) < 2):
        found.append(Gap(title, NO_TOTAL_FIELD))
    elif not curves:
        found.append(Gap(title, "No stretch in use is long enough for a spectrum."))
    else:
        caption = (
            "Welch's method on the stretches without a gap or a flag. Dashed: the white noise of each sensor. What "
            "stands above it is not white noise: a rise to the left is drift or 1/f, a line is interference."
        )
        step = float(np.median(np.diff(content.time)))
        found.append(
            picture(title, caption + _left_out(use), lambda: noise_pictures.spectra(curves, step, use.sensors))
        )
    residual = use.residual
    if residual is not None:
        caption = (
            "Logarithmic counts; the curve is the normal distribution with the same median and median absolute "
            "deviation. Tails above it are outliers or an effect that comes and goes."
        )
        found.append(
            picture("Distribution of what is left", caption + _left_out(use), lambda: noise_pictures.histograms(
                residual, use.sensors
            ))
        )  # fmt: skip
    return found


def _reference(content: Content) -> Picture | Gap:
    total_field, diurnal = content.variable("detrended/total_field"), content.variable("detrended/diurnal")
    title = "Reference"
    if total_field is None and diurnal is None:
        return Gap(title, "The result holds no total field at the samples of the array: no stage made one.")
    varies = "" if diurnal is None else ", and how far it lies from its base value. A scalar is not taken off a vector"
    caption = f"The total field at the samples of the array, against which |b| of each sensor is held{varies}."
    return picture(
        title, caption, lambda: time_pictures.reference(content.time, content.time_units, total_field, diurnal)
    )


def _flag_pictures(content: Content, use: Arrays) -> list[Picture | Gap]:
    if not content.flags:
        return []  # the table of flags says that there is none
    return [
        picture(
            "Samples taken out of use",
            "Flagged samples keep their values in the result; they enter no fit, no figure and no other picture here.",
            lambda: flag_pictures.ribbon(content.time, content.time_units, content.flags, use.sensors),
        )
    ]


def _left_out(use: Arrays) -> str:
    if not use.left_out:
        return ""
    shown = len(use.sensors)
    return f" Of {shown + use.left_out} sensors the {shown} with the most left are shown."
