"""The recipe's `survey` section: which files, which reader, and what their columns mean."""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator

from magtensor.survey.times import parse_instant, split_since
from magtensor.units import canonical_unit, dimension


def _fraction(value: Any) -> Any:
    """`1/75` is how data sheets state a sensitivity, and exact."""
    if isinstance(value, str) and "/" in value:
        try:
            return float(Fraction(value.replace(" ", "")))
        except (ValueError, ZeroDivisionError):
            return value
    return value


def _unit(value: str) -> str:
    canonical_unit(value)
    return value


def _epoch(value: str) -> str:
    if value != "unix":
        parse_instant(value)
    return value


def _time_unit(value: str) -> str:
    if split_since(value) is None and dimension(value) != "time":
        raise ValueError(f"'{value}' is not a unit of time")
    return value


def _dimension_check(wanted: str) -> BeforeValidator:
    def check(value: Any) -> Any:
        if isinstance(value, str) and dimension(value) != wanted:
            raise ValueError(f"'{value}' is not a unit of {wanted}")
        return value

    return BeforeValidator(check)


Number = Annotated[float, BeforeValidator(_fraction)]
Units = Annotated[str, BeforeValidator(lambda v: _unit(v) if isinstance(v, str) else v)]
Ref = int | str
Axis = Literal["x", "y", "z", "-x", "-y", "-z", "+x", "+y", "+z"]


class Section(BaseModel):
    """Strict: unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid", strict=True, populate_by_name=True, frozen=True)


class TimeSection(Section):
    """Where the times are: a column, or a rate."""

    from_: Ref | list[Ref] | None = Field(
        None,
        alias="from",
        description="column with the time; several text columns (date, clock) are joined by a space",
    )
    units: Annotated[str, BeforeValidator(lambda v: _time_unit(v) if isinstance(v, str) else v)] | None = Field(
        None,
        description="unit of the numbers (s, ms, ...) or `seconds since <ISO 8601>`; default: the file's, else s",
    )
    epoch: Annotated[str, BeforeValidator(lambda v: _epoch(v) if isinstance(v, str) else v)] | None = Field(
        None, description="what the numbers count from: an ISO 8601 time, or `unix`; for a time of day, its first day"
    )
    format: str | None = Field(None, description="strptime pattern of clock text; default: ISO 8601")
    rate_Hz: Number | str | None = Field(
        None,
        description="samples per second where there is no time column, or the file attribute that states it",
    )
    counter: int | None = Field(
        None, gt=1, description="the number at which a time counter starts again from 0 (65536, ...)"
    )
    shift_s: float = Field(0.0, description="added to the times, s (a clock known to be wrong)")

    @model_validator(mode="after")
    def _one_way(self) -> TimeSection:
        if (self.from_ is None) == (self.rate_Hz is None):
            raise ValueError("give either `from` (a column) or `rate_Hz`")
        if isinstance(self.rate_Hz, float) and self.rate_Hz <= 0:
            raise ValueError("`rate_Hz` must be positive")
        if self.units and split_since(self.units) is not None and self.epoch:
            raise ValueError("`units` already name the epoch; leave `epoch` out")
        return self


class FileSection(Section):
    """Files and how to read them."""

    file: str | None = Field(None, description="one file, relative to the recipe")
    files: str | list[str] | None = Field(
        None, description="files that follow each other: a list, or a pattern with * and ? (sorted by name)"
    )
    reader: str | None = Field(None, description="reader plugin; default: by the file name's ending")
    options: dict[str, Any] = Field(default_factory=dict, description="options of the reader")
    time: TimeSection | None = Field(None, description="the time base; default: the reader's column `time`")
    order: Literal["given", "time"] = Field("given", description="files in the order given, or by their first time")

    @model_validator(mode="after")
    def _one_of(self) -> FileSection:
        if self.file is not None and self.files is not None:
            raise ValueError("give `file` or `files`, not both")
        return self

    @property
    def names(self) -> list[str]:
        """The files and patterns as written."""
        if self.file is not None:
            return [self.file]
        return [self.files] if isinstance(self.files, str) else list(self.files or [])


class QuantitySection(FileSection):
    """Numbers from the file: value = number * scale + offset, in `units`.

    In this order: `missing` and `valid` (on the numbers as recorded), `wrap`, `scale`, `offset`, units, `axes`.
    With a `file` of its own the values are taken at the survey's times by linear interpolation.
    """

    from_: Ref | list[Ref] = Field(
        alias="from",
        description="column name or number (from 0), dataset path, a part of one (`mag[1]`, `mag[0:3]`); or several",
    )
    units: Units | None = Field(None, description="units after scale and offset; default: what the file says")
    scale: Number | list[Number] = Field(
        1.0, description="units per count; one number or one per column; `1/75` is allowed"
    )
    offset: Number | list[Number] = Field(
        0.0, description="added after the scale, in `units`; one number or one per column"
    )
    missing: list[float] = Field(default_factory=list, description="numbers that stand for a missing value")
    valid: tuple[Number, Number] | None = Field(
        None, description="range of believable numbers; others are taken as missing"
    )
    wrap: int | None = Field(
        None,
        gt=1,
        description="a signed register read as unsigned: numbers from wrap/2 up are negative (4096 for 12 bits)",
    )
    axes: tuple[Axis, Axis, Axis] | None = Field(
        None, description="for three columns: which of them, with which sign, is the platform's x, y, z ([y, x, -z])"
    )
    max_gap_s: float = Field(2.0, gt=0, description="with a file of its own: no interpolation across a longer gap, s")

    @field_validator("axes")
    @classmethod
    def _each_once(cls, axes: tuple[str, str, str] | None) -> tuple[str, str, str] | None:
        if axes is not None and {a[-1] for a in axes} != {"x", "y", "z"}:
            raise ValueError("`axes` must name x, y and z once each")
        return axes


class SensorSection(QuantitySection):
    """One three-axis sensor."""

    units: Annotated[Units, _dimension_check("magnetic flux density")] | None = Field(
        None, description="units after scale and offset (nT, uT, mG, ...); default: what the file says"
    )
    position: tuple[float, float, float] | None = Field(None, description="sensor centre in the platform frame, m")


class ChannelSection(QuantitySection):
    """A logged channel; those whose names the canonical layout knows are converted to its units."""

    per: Literal["sensor", "axis"] | None = Field(
        None, description="what several columns are; default: axis for three, except for temperature"
    )


class EulerSection(Section):
    """Attitude as roll, pitch and yaw: the aerospace sequence, from the world about z, then y, then x."""

    roll: Ref = Field(description="column of roll")
    pitch: Ref = Field(description="column of pitch")
    yaw: Ref = Field(description="column of yaw (heading)")
    units: Annotated[Units, _dimension_check("angle")] = Field("deg", description="deg or rad")


class AttitudeSection(FileSection):
    """The platform's attitude."""

    from_: Ref | list[Ref] | None = Field(None, alias="from", description="four columns or one dataset of quaternions")
    euler: EulerSection | None = Field(None, description="roll, pitch and yaw instead of quaternions")
    scalar: Literal["first", "last"] | None = Field(None, description="where the quaternion's scalar part is")
    maps: Literal["platform to world", "world to platform"] = Field(
        "platform to world", description="what the rotation does to a vector's coordinates"
    )
    world: str = Field("", description="the world frame (ENU, NED, ...), kept as an attribute")
    max_gap_s: float = Field(0.5, gt=0, description="with a file of its own: no interpolation across a longer gap, s")

    @model_validator(mode="after")
    def _one_way(self) -> AttitudeSection:
        if (self.from_ is None) == (self.euler is None):
            raise ValueError("give either `from` (quaternions) or `euler`")
        if self.from_ is not None and self.scalar is None:
            raise ValueError("say where the quaternion's scalar part is: `scalar: first` or `scalar: last`")
        return self


class VectorSection(Section):
    """A vector known beforehand."""

    value: tuple[float, float, float] = Field(description="its components in the world frame")
    units: Annotated[Units, _dimension_check("magnetic flux density")] = Field(description="nT, uT, ...")

    @field_validator("value", mode="before")
    @classmethod
    def _three(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)) or len(value) != 3:
            raise ValueError("must be three numbers, the components x, y and z in the world frame")
        return tuple(value)


class ConstantSection(Section):
    """A total field that is taken as constant."""

    value: float = Field(gt=0, description="the total field")
    units: Annotated[Units, _dimension_check("magnetic flux density")] = Field(description="nT, uT, ...")
    why: str = Field("", description="where the number comes from; kept with the result")


class AltitudeSection(Section):
    """A total field that falls with height as that of a dipole: F0 ((R + h0) / (R + h))^3."""

    value: float = Field(gt=0, description="the total field F0 at the height h0")
    units: Annotated[Units, _dimension_check("magnetic flux density")] = Field(description="nT, uT, ...")
    at_m: float = Field(0.0, description="the height h0 above sea level, m")
    pressure: QuantitySection | None = Field(
        None, description="air pressure, from which the standard atmosphere gives h (to 47 km)"
    )
    height: QuantitySection | None = Field(None, description="the height above sea level itself")
    why: str = Field("", description="where F0 comes from; kept with the result")

    @model_validator(mode="after")
    def _one_way(self) -> AltitudeSection:
        if (self.pressure is None) == (self.height is None):
            raise ValueError("give either `pressure` or `height`")
        return self


REFERENCE_KINDS = ("total_field", "components", "constant", "altitude_model")


class ReferenceSection(FileSection):
    """The total field to calibrate against; without a `file` its columns are in the survey's own files."""

    total_field: QuantitySection | None = Field(
        None, description="column with the total field of a scalar magnetometer"
    )
    components: QuantitySection | None = Field(
        None, description="three columns of a vector instrument; their magnitude is the total field"
    )
    constant: ConstantSection | None = Field(None, description="a total field that does not change")
    altitude_model: AltitudeSection | None = Field(None, description="a total field modelled from the height")
    world_field: VectorSection | None = Field(
        None, description="the field vector in the attitude's world frame, where attitude serves as a vector reference"
    )

    @model_validator(mode="after")
    def _one_way(self) -> ReferenceSection:
        given = [k for k in REFERENCE_KINDS if getattr(self, k) is not None]
        if len(given) > 1 or (not given and self.world_field is None):
            raise ValueError(f"give one of {', '.join(REFERENCE_KINDS)} (or a `world_field`)")
        if self.names and not {"total_field", "components"} & set(given):
            raise ValueError("a `file` here needs `total_field` or `components`")
        return self


class ConditionSection(Section):
    """Samples at which a column lies in a range."""

    from_: Ref = Field(alias="from", description="the column")
    above: float | None = Field(None, description="true where the number is greater")
    below: float | None = Field(None, description="true where the number is smaller")

    @model_validator(mode="after")
    def _some(self) -> ConditionSection:
        if self.above is None and self.below is None:
            raise ValueError("give `above` or `below` or both")
        return self


class SegmentSection(Section):
    """What is contiguous: postures, lines or manoeuvres."""

    from_: Ref | None = Field(None, alias="from", description="column with the segment's number")
    gaps_s: float | None = Field(None, gt=0, description="a longer gap in time starts a new segment, s")
    condition: ConditionSection | None = Field(
        None, description="each run of samples that fulfils it, and each that does not, is a segment"
    )

    @model_validator(mode="after")
    def _one_way(self) -> SegmentSection:
        if sum(v is not None for v in (self.from_, self.gaps_s, self.condition)) != 1:
            raise ValueError("give one of `from`, `gaps_s`, `condition`")
        return self


class SurveySection(FileSection):
    """The survey. Without `sensors` the file must be in the canonical layout."""

    sensors: dict[str, SensorSection] | None = Field(None, description="the three-axis sensors by name")
    channels: dict[str, ChannelSection] = Field(default_factory=dict, description="logged channels by name")
    reference: ReferenceSection | None = Field(None, description="the total field to calibrate against")
    attitude: AttitudeSection | None = Field(None, description="the platform's attitude")
    segment: SegmentSection | None = Field(None, description="what is contiguous")
    with_: str | list[str] | None = Field(
        None,
        alias="with",
        description="further surveys of the same instrument, read and prepared as this one, that calibrate_joint fits "
        "together with it: files, or patterns with * and ?",
    )

    @model_validator(mode="after")
    def _consistent(self) -> SurveySection:
        if not self.names:
            raise ValueError("needs `file` or `files`")
        if self.sensors is not None:
            if not self.sensors:
                raise ValueError("`sensors` is empty")
            placed = [n for n, s in self.sensors.items() if s.position is not None]
            if placed and len(placed) < len(self.sensors):
                lacking = ", ".join(n for n in self.sensors if n not in placed)
                raise ValueError(f"`position` is given for some sensors but not for {lacking}")
            taken = [n for n in self.channels if n in RESERVED or "/" in n]
            if taken:
                raise ValueError(f"a channel cannot be called {' or '.join(taken)}")
        elif self.channels or self.attitude or self.segment or self.time:
            raise ValueError("a mapping needs `sensors`; without one the file must be in the canonical layout")
        elif (
            self.reference is not None
            and (self.reference.total_field or self.reference.components)
            and not self.reference.names
        ):
            raise ValueError("with a canonical survey the `reference` must name its own `file`, or be constant")
        elif self.reference is not None and self.reference.altitude_model is not None:
            raise ValueError("an `altitude_model` needs a mapping with `sensors`")
        return self


RESERVED = (
    "time",
    "sensor",
    "axis",
    "quaternion",
    "b_raw",
    "position",
    "attitude",
    "segment",
    "good",
    "total_field",
    "diurnal",
)
