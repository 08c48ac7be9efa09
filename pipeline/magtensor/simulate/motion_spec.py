"""What a scenario says of a motion.

World frame: x east, y north, z up. Attitudes are quaternions, scalar last, platform to world.
"""

from __future__ import annotations

from math import ceil
from typing import Annotated, Literal

from pydantic import Field

from magtensor.simulate.spec import Spec, Vector3

Sequence3 = Literal["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"]


class TumblingSpec(Spec):
    """A smooth random rotation in all directions; the body's angular rate is Gaussian."""

    type: Literal["tumbling"]
    duration_s: float = Field(gt=0, description="length of the survey, s")
    rate_rms_deg_s: float = Field(25.0, gt=0, description="rms of each component of the angular rate, deg/s")
    rate_time_s: float = Field(4.0, gt=0, description="correlation time of the angular rate, s")


class LimitedTiltSpec(Spec):
    """Roll and pitch swing smoothly within a limit while the yaw wanders freely."""

    type: Literal["limited_tilt"]
    duration_s: float = Field(gt=0, description="length of the survey, s")
    tilt_deg: float = Field(20.0, gt=0, lt=90, description="largest roll and largest pitch, deg")
    tilt_time_s: float = Field(6.0, gt=0, description="correlation time of the swing, s")
    yaw_rate_rms_deg_s: float = Field(20.0, ge=0, description="rms yaw rate, deg/s")
    yaw_time_s: float = Field(30.0, gt=0, description="correlation time of the yaw, s")


class PosturesSpec(Spec):
    """The array rests in one attitude after the other and turns smoothly in between."""

    type: Literal["postures"]
    random_count: int = Field(100, ge=0, description="number of random attitudes")
    turntable_steps: int = Field(
        0, ge=0, description="before them: one full turn about the platform's z axis in this many steps"
    )
    tilt_deg: float | None = Field(
        None,
        gt=0,
        le=180,
        description=("largest angle between platform z and up in the random attitudes, deg; null: any attitude"),
    )
    rest_s: float = Field(10.0, gt=0, description="rest in each attitude, s")
    turn_s: float = Field(5.0, gt=0, description="time to turn to the next attitude, s; not recorded")
    average: bool = Field(False, description="true: one averaged sample for each attitude")

    @property
    def duration_s(self) -> float:
        """Length of the survey, s."""
        return (self.turntable_steps + self.random_count) * (self.rest_s + self.turn_s) - self.turn_s


class EulerSpec(Spec):
    """What three successive rotations mean."""

    sequence: Sequence3 = Field(
        "yxz",
        description=(
            "order of the three rotations from the world to the platform frame, the last one first: yxz means Ry Rx Rz"
        ),
    )
    zero_frame: Literal["ENU", "NED"] = Field(
        "NED", description="world axes the platform axes lie along at zero angles"
    )


class EulerGridSpec(EulerSpec):
    """One sample in each attitude of a full grid of three angles (Li 2018 section 4)."""

    type: Literal["euler_grid"]
    step_deg: float = Field(
        20.0, gt=0, le=180, description="step of each of the three angles over the full circle, deg"
    )

    @property
    def count(self) -> int:
        """Number of attitudes."""
        return ceil(360.0 / self.step_deg - 1e-9) ** 3


class RandomAttitudesSpec(EulerSpec):
    """One sample in each of a number of independent random attitudes."""

    type: Literal["random_attitudes"]
    count: int = Field(gt=0, description="number of attitudes")
    euler_limits_deg: Vector3 | None = Field(
        None,
        description=(
            "null: uniform over all attitudes; else the angles about x, y, z are uniform within +- these limits, deg"
        ),
    )


class OneAxisSpec(Spec):
    """A rotation about one platform axis that stays fixed in the world: what no calibration can live on."""

    type: Literal["one_axis"]
    duration_s: float = Field(gt=0, description="length of the survey, s")
    axis: Vector3 = Field(default=[0.0, 0.0, 1.0], description="axis in the platform frame")
    rate_deg_s: float = Field(10.0, description="angular rate, deg/s")
    tilt_deg: Vector3 = Field(default=[0.0, 0.0, 0.0], description="attitude at the start, as a rotation vector, deg")


class SurveyLinesSpec(Spec):
    """Straight parallel passes to and fro, with small movements of the attitude; the turns are not recorded."""

    type: Literal["survey_lines"]
    lines: int = Field(gt=0, description="number of lines")
    length_m: float = Field(gt=0, description="length of a line, m")
    spacing_m: float = Field(1.0, ge=0, description="distance between lines, m")
    speed_m_s: float = Field(1.0, gt=0, description="speed, m/s")
    height_m: float = Field(1.0, description="height of the platform origin in the world frame, m")
    azimuth_deg: float = Field(0.0, description="direction of the first line, deg east of north")
    start_m: Vector3 = Field(
        default=[0.0, 0.0, 0.0], description="point below the begin of the first line: east, north, up, m"
    )
    turn_s: float = Field(10.0, gt=0, description="time of a turn, s; not recorded")
    turn_round: bool = Field(
        True,
        description=("true: the platform's x axis follows the direction of travel; false: it keeps the first line's"),
    )
    wobble_deg: float = Field(2.0, ge=0, description="rms of roll, pitch and yaw about the line's direction, deg")
    wobble_time_s: float = Field(2.0, gt=0, description="correlation time of that, s")

    @property
    def duration_s(self) -> float:
        """Length of the survey, s."""
        return self.lines * (self.length_m / self.speed_m_s + self.turn_s) - self.turn_s


MotionSpec = Annotated[
    TumblingSpec | LimitedTiltSpec | PosturesSpec | EulerGridSpec | RandomAttitudesSpec | OneAxisSpec | SurveyLinesSpec,
    Field(discriminator="type"),
]


def length_s(spec: MotionSpec, rate_Hz: float) -> float:
    """Length of the survey, s."""
    if isinstance(spec, EulerSpec):
        return spec.count / rate_Hz
    return spec.duration_s
