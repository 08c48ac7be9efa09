"""Between the mathematics of the common rotation and the survey's variables: reads sources, turns calibrations."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from magtensor.attitude import to_world
from magtensor.calibrated import B, contrasts, stored
from magtensor.calibration.noise import noise_std
from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.errors import DataError, NotEnoughData
from magtensor.frame.attitude import Attitude, attitude, mirrored_axis, require_consistent, require_unmirrored
from magtensor.frame.calibration_errors import CalibrationErrors, errors_of
from magtensor.frame.delay import Delay, attitude_delay
from magtensor.frame.earlier import earlier
from magtensor.frame.estimate import WORST, CommonRotation, carried, common_rotation, in_words
from magtensor.frame.mounting import mounting
from magtensor.frame.sources import Source
from magtensor.frame.symmetry import symmetry
from magtensor.frame.turning import turning
from magtensor.misread import require_following
from magtensor.survey.model import AXES, Survey, Variable

PLATFORM = "platform"  # how the name of a frame begins that is tied to the platform
MIRROR = (
    "half a turn about {axis} was taken, as of sensors mounted upside down; if axis {axis} of all sensors is inverted "
    "instead, field and tensor have the other sign, which only the direction of the field in the world "
    "(reference/world_field) would tell"
)
GAUGE = "one rotation"  # how the words begin that name the common rotation as unobservable
_OF_A_FRAME = ("units", "frame", "unobservable", "diagnostics", "long_name", "common_rotation", "attitude_refuted")
SIGNIFICANT = 0.01  # chance that a rotation which is none passes for one


@dataclass(frozen=True)
class Declared:
    """What is known of the platform beside the survey's data.

    Attributes:
        sensor: name of one whose axes are the platform's; sensor_axis: "x", "y" or "z" where only that axis is.
        mounted_to: rad, how well.
        turns: axis -> numbers of the segments in which the platform turned about it; none means all samples.
        segments: of the survey in which the symmetry of the tensor is used; None means all.
    """

    sensor: str | None = None
    sensor_axis: str | None = None
    mounted_to: float = float(np.radians(0.5))
    turns: Mapping[str, Sequence[int]] = field(default_factory=dict)
    segments: Sequence[int] | None = None


@dataclass(frozen=True)
class Tied:
    """A calibration in the platform's frame, and in words what brought it there, and of an attitude that brought it by
    how much it is late."""

    calibration: ArrayCalibration
    found: CommonRotation
    words: str
    late: str = ""


def tied(calibration: ArrayCalibration) -> bool:
    """Whether a calibration's frame is the platform's."""
    return calibration.frame.startswith(PLATFORM)


def tie(
    survey: Survey, calibration: ArrayCalibration, sources: Sequence[str], declared: Declared, worst: float
) -> Tied:
    """Turn a calibration into the platform's frame by what a survey offers.

    Args:
        survey: with `calibrated/b` made by this calibration.
        sources: of "attitude", "sensor", "axis", "symmetry".
        declared: see there.
        worst: rad, accepted standard deviation about any axis.

    Raises:
        NotEnoughData: the rotation is not determined, or a source lacks what it needs.
        DataError: the attitude is not that of the sensors.
    """
    errors = errors_of(calibration)
    read: list[Source] = [earlier(errors)] if tied(calibration) else []
    for name in sources:
        read += _read(name, survey, calibration, errors, declared)
    attitudes = [source for source in read if isinstance(source, Attitude)]
    for source in attitudes:
        require_unmirrored(source)
    found = common_rotation(read, errors, worst=worst)
    late = _attitude_delay(survey) if attitudes else None
    for source in attitudes:
        require_consistent(source, found.rotation)
    frame = f"{PLATFORM} ({in_short(found)})"
    turned = carried(calibration, errors, found, frame)
    left = [w for w in turned.unobservable if not w.startswith(GAUGE)]
    words = told(found)
    axis = mirrored_axis(found.rotation)
    if axis is not None and not any(source.world is not None for source in attitudes):
        left.append(MIRROR.format(axis=axis))
        words += f"; {left[-1]}"
    return Tied(replace(turned, unobservable=tuple(left)), found, words, "" if late is None else late.words)


def refined(survey: Survey, calibration: ArrayCalibration, worst: float) -> tuple[Tied, bool]:
    """What the symmetry of a survey's tensor says of the frame, together with what the calibration knew of it.

    Returns:
        The calibration turned accordingly; and whether that turn is significant, more than the errors explain.

    Raises:
        NotEnoughData: the survey and what was known do not determine the rotation.
    """
    from scipy.special import chdtrc

    done = tie(survey, calibration, ("symmetry",), Declared(), worst)
    if not tied(calibration):
        return done, done.found.significance < SIGNIFICANT
    # of two estimates of which the second holds the first, the difference has the difference of their covariances
    before, after = (errors_of(c).common for c in (calibration, done.calibration))
    values, vectors = np.linalg.eigh(before @ before.T - after @ after.T)
    scale = float(np.trace(before @ before.T))
    seen = values > 1e-6 * scale
    turn = vectors[:, seen].T @ done.found.vector
    return done, bool(chdtrc(max(int(seen.sum()), 1), float(np.sum(turn**2 / values[seen]))) < SIGNIFICANT)


def in_short(found: CommonRotation) -> str:
    """`by attitude: turned by 10.2 deg, known to 0.011 deg`."""
    return f"by {' and '.join(found.sources)}: turned by {np.degrees(found.angle):.3g} deg, known to {_known_to(found)}"


def _known_to(found: CommonRotation) -> str:
    return f"{np.degrees(np.sqrt(np.sum(found.std**2))):.2g} deg"


def told(found: CommonRotation) -> str:
    """The rotation, its uncertainty, what determined it, and what else would fit, in one sentence or two."""
    std = ", ".join(f"{v:.2g}" for v in np.degrees(found.std))
    shares = " and ".join(
        name if len(found.sources) == 1 else f"{name} ({share:.0%})"
        for name, share in zip(found.sources, found.shares, strict=True)
    )
    words = f"turned by {in_words(found.vector)}, to {std} deg about x, y, z, determined by {shares}"
    if found.alternatives:
        others = "; ".join(in_words(w) for w in found.alternatives)
        words += f". Further turns fit as well ({others}); the frame nearest to that of the calibration was taken"
    return words


def calibration_variables(survey: Survey, sensors: list[str], done: Tied) -> dict[str, Variable]:
    """What a turned calibration changes in the group `calibration` of a survey or of a calibration file.

    `calibration/common_rotation` leads from the frame of the fit to the platform's.
    """
    found, calibration = done.found, done.calibration
    facts = {k: v for k, v in survey["calibration/matrix"].attrs.items() if k not in _OF_A_FRAME}
    given = stored(calibration, sensors, **facts, common_rotation=done.words)
    if "calibration/rotation" in survey:
        own = survey["calibration/rotation"]
        attributes = dict(own.attrs) | {"frame": calibration.frame}
        given["calibration/rotation"] = ([str(d) for d in own.dims], found.rotation @ own.values, attributes)
    rotation = found.rotation
    if "calibration/common_rotation" in survey:
        rotation = rotation @ survey.values("calibration/common_rotation")
    outcome = {
        "units": "1",
        "long_name": "from the frame of the fit to the platform",
        "sources": json.dumps(list(found.sources)),
        "shares": np.array(found.shares),
        "noise_over_nominal": np.array(found.spreads),
        "turned_by_deg": float(np.degrees(found.angle)),
        "rotation_vector_deg": np.degrees(found.vector),
        "std_deg": np.degrees(found.std),
        "alternatives_deg": json.dumps([np.degrees(w).round(3).tolist() for w in found.alternatives]),
        "words": done.words,
        **({"attitude_delay": done.late} if done.late else {}),
    }
    return given | {"calibration/common_rotation": (("axis", "fitted_axis"), rotation, outcome)}


def as_platform(survey: Survey, done: Tied) -> dict[str, Variable]:
    """All that a turned calibration changes in the survey it was made from; an assembled tensor is not among it."""
    found, given = done.found, calibration_variables(survey, survey.sensors, done)
    b = survey["calibrated/b"]
    field = np.asarray(b.values, dtype=float) @ found.rotation.T
    given["calibrated/b"] = (B, field, dict(b.attrs) | {"frame": done.calibration.frame})
    if "declared/matrix" in survey:  # what was fitted before effects were adopted is compared in the same frame
        alone = survey["declared/matrix"]
        given["declared/matrix"] = ([str(d) for d in alone.dims], found.rotation @ alone.values, dict(alone.attrs))
    if len(survey.sensors) > 1:
        given |= contrasts(field)
    return given


def as_fitted(survey: Survey, calibration: ArrayCalibration) -> ArrayCalibration:
    """The calibration in the frame it was fitted in, in which the coefficients of adopted effects hold."""
    if "calibration/common_rotation" not in survey:
        return calibration
    back = np.asarray(survey.values("calibration/common_rotation"), dtype=float).T
    return replace(calibration, matrix=np.einsum("ij,sjk->sik", back, calibration.matrix))


def _read(
    name: str, survey: Survey, calibration: ArrayCalibration, errors: CalibrationErrors, declared: Declared
) -> list[Source]:
    """The sources of one kind that a survey and the declarations hold."""
    if name == "sensor":
        if declared.sensor is None:
            raise DataError("no sensor is declared", hint="give `sensor`, the one whose axes are the platform's")
        number = survey.sensors.index(declared.sensor)
        label = f"sensor {declared.sensor}" if declared.sensor_axis is None else (
            f"axis {declared.sensor_axis} of sensor {declared.sensor}"
        )  # fmt: skip
        return [mounting(calibration, errors, number, declared.sensor_axis, declared.mounted_to, label)]
    b = np.asarray(survey.values("calibrated/b"), dtype=float)
    use = survey.good & np.isfinite(b).all(axis=(1, 2))
    if name == "attitude":
        if "attitude" not in survey:
            raise NotEnoughData("the survey has no attitude")
        turns = to_world(survey.values("attitude"))
        use &= np.isfinite(turns).all(axis=(1, 2))
        world = survey.values("reference/world_field") if "reference/world_field" in survey else None
        require_following(survey.values("attitude")[use], b[use].mean(axis=1), world)
        return [attitude(b[use], turns[use], errors, world)]
    if name == "axis":
        if not declared.turns:
            raise DataError("no turns are declared", hint="give `turns`, e.g. {z: [3]} for segment 3 about z")
        return [_turning(axis, list(parts), survey, b, use, errors) for axis, parts in declared.turns.items()]
    if "position" not in survey:
        raise NotEnoughData("the symmetry of the tensor needs the sensors' positions", where="position")
    if declared.segments is not None:
        wanted = list(declared.segments)
        use &= np.isin(_segments(survey, wanted, "segments are named for the symmetry"), wanted)
    noise = _noise(survey, b, use)
    return [symmetry(b[use], np.asarray(survey.values("position"), dtype=float), noise, errors)]


def _attitude_delay(survey: Survey) -> Delay | None:
    b, q = (np.asarray(survey.values(name), dtype=float) for name in ("calibrated/b", "attitude"))
    use = survey.good & np.isfinite(b).all(axis=(1, 2)) & np.isfinite(q).all(axis=1)
    world = survey.values("reference/world_field") if "reference/world_field" in survey else None
    most = np.median(b[use], axis=1)  # one sensor that is late by itself says nothing of the attitude
    return attitude_delay(survey.time[use], q[use], most, world)


def _noise(survey: Survey, b: Array, use: NDArray[np.bool_]) -> Array:
    """(S, 3) nT: the noise that the calibration found, or that of these samples."""
    if "calibration/noise_std" in survey:
        stored = np.asarray(survey.values("calibration/noise_std"), dtype=float)
        if np.isfinite(stored).all():
            return stored
    return noise_std(b[use])


def _turning(
    axis: str, parts: list[int], survey: Survey, b: Array, use: NDArray[np.bool_], errors: CalibrationErrors
) -> Source:
    what = f"turns about {axis} are declared in segment {', '.join(map(str, parts))}"
    number = _segments(survey, parts, what) if parts or "segment" in survey else np.zeros(len(b), dtype=int)
    among = use & np.isin(number, parts) if parts else use
    return turning(b[among], number[among], np.eye(3)[AXES.index(axis)], errors, f"turns about {axis}")


def _segments(survey: Survey, wanted: list[int], what: str) -> NDArray[np.int_]:
    if "segment" not in survey:
        raise DataError(
            f"{what}, but the survey has no segment",
            where=str(survey.attributes.get("source", "")),
            hint="`segment` (time) numbers the postures, lines or manoeuvres",
        )
    number = np.asarray(survey.values("segment"), dtype=int)
    missing = [s for s in wanted if s not in number]
    if missing:
        known = ", ".join(str(s) for s in np.unique(number)[:20])
        raise DataError(f"the survey has no segment {missing[0]}", hint=f"its segments are {known}")
    return number


def with_refined_rotation(
    survey: Survey, stored_one: Survey, calibration: ArrayCalibration, worst: float = WORST
) -> tuple[Survey, Tied | None]:
    """A survey that a stored calibration was applied to, turned if the symmetry of its own tensor asks for it.

    Args:
        survey: with `calibrated/b`; stored_one: the calibration's file; calibration: the same, restored.
        worst: rad, accepted standard deviation about any axis.

    Returns:
        The survey, with what was done as attribute `rotation_refined` of `calibrated/b`; and the calibration turned
        likewise, None where no turn is significant.

    Raises:
        NotEnoughData: the survey and what was known before do not determine the rotation.
    """
    held = [p for p in ("calibration/noise_std", "calibration/position") if p in stored_one]
    seen = survey.merged({p: stored_one[p] for p in held})
    if "calibration/position" in held:
        seen = seen.merged({"position": stored_one["calibration/position"]})
    done, significant = refined(seen, calibration, worst)
    variable = survey["calibrated/b"]
    b, attributes = np.asarray(variable.values, dtype=float), dict(variable.attrs)
    if significant:
        b = b @ done.found.rotation.T
        attributes |= {"frame": done.calibration.frame, "rotation_refined": f"the frame was {done.words}"}
    else:
        attributes["rotation_refined"] = (
            f"left as it was: the tensor of this survey asks for no significant turn ({in_words(done.found.vector)}, "
            f"known to {_known_to(done.found)})"
        )
    return survey.merged({"calibrated/b": (B, b, attributes)}), done if significant else None
