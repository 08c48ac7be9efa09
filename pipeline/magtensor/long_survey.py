"""Surveys longer than the memory: read, prepared, calibrated and written in windows.

A run reads the survey twice. First each window is prepared by the recipe's own stages and its raw outputs and total
field are kept in a file beside the result, from which the calibration reads them in pieces; an even selection of the
samples stays in memory, stands for the survey in all later stages (noise, tensor gains, QC) and is what the report
shows. Then each window is prepared again, calibrated and appended to the result.

What a stage finds out of a whole record (runs of repeated values, the end of a sensor's range) it finds here in each
window. A calibration with effects that look back in time (a lag, hysteresis, a drift) needs the whole record and is
refused.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from magtensor import provenance, result
from magtensor.applying import Applied, apply_to, fit_in_words, verified
from magtensor.atomic import atomic_path, atomic_set
from magtensor.calibrated import contrasts, left_open
from magtensor.calibration.recording import even_blocks
from magtensor.dated import RATE, date_of
from magtensor.errors import DataError, UsageError
from magtensor.preparing import load_as, preparing_stages
from magtensor.provenance import Provenance
from magtensor.qc import told
from magtensor.recipe.plan import Plan
from magtensor.runner import StageRecord, run_stage
from magtensor.session import Finished
from magtensor.survey.flags import Flag, flag_ranges
from magtensor.survey.model import Survey, without_variables
from magtensor.survey.source import Source
from magtensor.verdict import survey_block, verdict
from magtensor.verdict_words import sentence

if TYPE_CHECKING:
    import xarray as xr

RESERVED_GiB = 0.4  # of memory that the program takes before it has read a sample
BYTES_PER_VALUE = 250  # of memory for each raw value of a window, all stages and the result's groups included
LEAST_ROWS = 10_000
SELECTED = 65_536  # samples that stand for the survey


def windows(source: Source, memory_GiB: float) -> list[slice]:
    """The rows of a survey in windows that the memory holds.

    Raises:
        UsageError: the survey cannot be read in windows.
    """
    samples, sensors = source.shape()
    most = max(int((memory_GiB - RESERVED_GiB) * 2**30 / _bytes_per_row(sensors)), LEAST_ROWS)
    count = -(-samples // most)
    edges = np.linspace(0, samples, count + 1).astype(int)
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]


def _bytes_per_row(sensors: int) -> int:
    return BYTES_PER_VALUE * 3 * sensors


def too_little(source: Source, memory_GiB: float) -> tuple[str, ...]:
    """What there is to say of a memory that not even the smallest windows keep to."""
    samples, sensors = source.shape()
    least = RESERVED_GiB + min(samples, LEAST_ROWS) * _bytes_per_row(sensors) / 2**30
    if memory_GiB >= least:
        return ()
    return (f"--memory {memory_GiB:g} cannot be kept to: the program and its smallest windows take {least:.2g} GiB",)


@dataclass(frozen=True)
class Spool:
    """A recording in a file of float64 rows: raw outputs of every sensor, then the total field.

    Attributes:
        file: open for reading; count, sensors, usable: as in `Recording`.
    """

    file: BinaryIO
    count: int
    sensors: int
    usable: NDArray[np.bool_]

    def read(self, start: int, stop: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        width = 3 * self.sensors + 1
        self.file.seek(8 * width * start)
        rows = np.frombuffer(self.file.read(8 * width * (stop - start))).reshape(-1, width)
        return np.ascontiguousarray(rows[:, :-1]).reshape(-1, self.sensors, 3), rows[:, -1].copy()


@dataclass(frozen=True)
class Prepared:
    """What the first reading leaves.

    Attributes:
        selection: an even choice of the samples, as a survey; index: (n,) where they are in the recording.
        recording: all of it; time: (N,) s.
    """

    selection: Survey
    index: NDArray[np.intp]
    recording: Spool
    time: NDArray[np.float64]


def run_long(
    planned: Plan,
    output: Path,
    memory_GiB: float,
    *,
    progress: Callable[[str], None] | None = None,
) -> Finished:
    """Run a plan on a survey longer than the memory, and write the files of the contract.

    Raises:
        UsageError: the recipe has a stage that needs the whole survey at once.
        DataError: as in a run.
    """
    say = progress or (lambda _: None)
    source, rest = planned.source(), planned.stages[len(preparing_stages(planned)) :]
    _require_windows(planned)
    survey_file = source.paths(source.section)[0]
    where = windows(source, memory_GiB)
    beside = next(folder for folder in (output, *output.absolute().parents) if folder.is_dir())
    with tempfile.TemporaryFile(dir=beside) as file:
        prepared = _prepared(planned, survey_file, where, file, say)
        survey, doubted, records = _calibrated(rest, prepared, say)
        blocks: list[tuple[int, dict[str, Any] | None]] = []

        def parts() -> Iterator[xr.DataTree]:
            done = 0
            for k, rows in enumerate(where, 1):
                say(f"writing window {k} of {len(where)}")
                found = apply_to(survey, survey_file, planned, rows=rows, judge=False)  # the fit has judged them
                found = found.merged(contrasts(found.values("calibrated/b")) if len(found.sensors) > 1 else {})
                bad = found.made_from(doubted[done : done + len(found.time)])
                done += len(found.time)
                good = found.good_by_sensor & ~bad[:, None]
                found = found.merged({"good": (("time", "sensor"), good, {"long_name": "may be used"})})
                block = survey_block(found)
                blocks.append((int(block["samples"]) if block else 0, block))
                # a variation counted from each window's own base would be none of the survey's
                found = without_variables(found, *({"diurnal"} & set(found)))
                yield result.only(result.result_tree(found), "calibrated", "residual", "detrended")

        made_by = provenance.collect(planned, records, source.files(), planned.verify)
        made_by = replace(made_by, notes={**made_by.notes, "memory_GiB": f"{memory_GiB:g}"})
        with atomic_set(output, last=result.RESULT) as folder:
            whole = result.only(result.result_tree(survey), "calibration", "qc")
            made_by = _appended(folder / result.RESULT, whole, parts(), made_by)
            result.save(result.only(whole, "calibration"), made_by, folder / result.CALIBRATION)
            checked = None if planned.verify is None else verified(survey, planned.verify, planned)
            outcome = verdict(survey, verify=checked)
            outcome["error"]["fit"] = combined(blocks)
            result.write_verdict(folder, outcome)
            say("report")
            _report(folder, output, survey, made_by)
    notes = (*(f"not determined: {words}" for words in left_open(survey)), *told(survey))
    return Finished(output, outcome, sentence(outcome), made_by, survey, (*too_little(source, memory_GiB), *notes))


def apply_long(
    stored: Survey, planned: Plan, survey: Path, target: Path, made_by: Provenance, memory_GiB: float
) -> Applied:
    """Apply a calibration to a survey longer than the memory; as `applying.apply`."""
    _require_no_memory(stored)
    blocks: list[tuple[int, dict[str, Any] | None]] = []
    flags: list[Flag] = []
    date: datetime | None = None
    scatter: float | None = None  # the first window tells whose survey it is

    source = replace(planned, survey=planned.survey_for(survey)).source()

    def parts() -> Iterator[xr.DataTree]:
        nonlocal date, scatter
        for rows in windows(source, memory_GiB):
            found = apply_to(stored, survey, planned, tolerant=True, rows=rows, date=date, scatter=scatter)
            date = date_of(found) if date is None and RATE in stored else date
            scatter = float(found["calibrated/b"].attrs.get("offset_scatter_nT", 0.0))
            block = survey_block(found)
            blocks.append((int(block["samples"]) if block else 0, block))
            flags.extend(found.flags)
            yield result.only(result.result_tree(found), "calibrated")

    with atomic_path(target) as temporary:
        _appended(temporary, None, parts(), made_by, flags)
    return Applied(target, fit_in_words(combined(blocks)), notes=too_little(source, memory_GiB))


def _require_windows(planned: Plan) -> None:
    rest = planned.stages[len(preparing_stages(planned)) :]
    if planned.survey is not None and planned.survey.with_:
        raise UsageError(f"{planned.file}: several surveys cannot be fitted together with --memory")
    for stage in preparing_stages(planned):
        if stage.options.get("window_s") is not None:
            raise UsageError(f"{planned.file}: {stage.name}: window_s cannot be used with --memory")
    if not rest or rest[0].component.long is None:
        able = sorted(c.name for c in planned.registry.components.values() if c.long is not None)
        name = f"the stage {rest[0].name} needs" if rest else "the recipe calibrates nothing; it needs"
        raise UsageError(
            f"{planned.file}: {name} the whole survey at once; with --memory calibrate with {', '.join(able)}"
        )
    if "total_field" not in rest[0].declares.needs:
        how = "without a measured total field (total_field: constant and the like)"
        if "reference/world_field" in rest[0].declares.needs:
            how = "with a vector reference"
        raise UsageError(f"{planned.file}: {rest[0].name} {how} needs the whole survey at once; leave --memory away")
    for stage in rest[1:]:
        if any(p.startswith("calibration/matrix") for p in stage.declares.gives):
            raise UsageError(
                f"{planned.file}: the stage {stage.name} needs the whole survey at once; not with --memory"
            )


def _require_no_memory(stored: Survey) -> None:
    if "calibration/effects" in stored:
        raise UsageError(
            "this calibration holds effects that may look back in time and need the whole survey at once; "
            "leave --memory away"
        )


def _prepared(
    planned: Plan, path: Path, where: Sequence[slice], file: BinaryIO, say: Callable[[str], None]
) -> Prepared:
    import xarray as xr

    chosen: list[xr.Dataset] = []
    index, times, usable = [], list[NDArray[np.float64]](), []
    flags: list[Flag] = []
    attributes: dict[str, Any] = {}
    reference, done = None, 0
    for k, rows in enumerate(where, 1):
        say(f"preparing window {k} of {len(where)}")
        found = load_as(planned, path, rows=rows)
        if "total_field" not in found:
            raise DataError(
                "there is no total field at its samples", where=str(found.attributes.get("source", "")),
                hint="give a reference, and the stage detrend_diurnal",
            )  # fmt: skip
        if times and len(found.time) and found.time[0] <= times[-1][-1]:
            raise DataError(
                f"the time of sample {done}, {found.time[0]:.3f} s, does not move on",
                where=f"{found.attributes.get('source', '')}: time",
            )
        raw, total_field = found.values("b_raw"), found.values("total_field")
        usable.append(found.readings & np.isfinite(total_field) & np.isfinite(raw).all(axis=(1, 2)))
        np.column_stack([raw.reshape(len(raw), -1), total_field]).astype(np.float64).tofile(file)
        pick = even_blocks(len(raw), SELECTED // len(where))
        nodes = {name: node.to_dataset() for name, node in found.tree.children.items()}
        shown_rows = nodes["array"].isel(time=pick)  # some windows may hold rows that were filled in, others not
        chosen.append(shown_rows.assign(is_reading=(("time", "sensor"), found.readings_by_sensor[pick])))
        reference = reference if reference is not None else nodes.get("reference")
        attributes = attributes or dict(found.attributes)
        index.append(done + pick)
        flags += [*found.flags]
        times.append(found.time)
        done += len(raw)
    array = xr.concat(chosen, dim="time", data_vars="minimal", coords="minimal", compat="override", join="override")
    shown = sum(len(i) for i in index)
    attributes["shown"] = f"{shown} samples, spread evenly over the {done} of the survey"
    tree = xr.DataTree.from_dict({"/array": array, **({"/reference": reference} if reference is not None else {})})
    selection = Survey(tree, tuple(flags), attributes)
    spool = Spool(file, done, array.sizes["sensor"], np.concatenate(usable))
    return Prepared(selection, np.concatenate(index), spool, np.concatenate(times))


def _calibrated(
    rest: Sequence[Any], prepared: Prepared, say: Callable[[str], None]
) -> tuple[Survey, NDArray[np.bool_], list[StageRecord]]:
    """The selection after all stages, the samples of the recording that the calibration doubts, and the records."""
    survey, records = prepared.selection, []
    doubted = np.zeros(prepared.recording.count, dtype=bool)

    def calibrate(view: Survey, **options: Any) -> dict[str, Any]:
        given, bad = rest[0].component.long(view, prepared.recording, **options)
        doubted[:] = bad
        if bad.any():
            good = view.good_by_sensor & ~bad[prepared.index, None]
            given["good"] = (("time", "sensor"), good, {"long_name": "may be used"})
            reason = "no calibration and no noise explain it"
            given["flags"] = flag_ranges(prepared.time, bad, by=rest[0].name, reason=reason)
        return dict(given)

    for stage in rest:
        say(stage.name)
        survey, record = run_stage(stage, survey, calibrate if stage is rest[0] else None)
        records.append(record)
    return survey, doubted, records


def combined(blocks: Sequence[tuple[int, dict[str, Any] | None]]) -> dict[str, Any] | None:
    """The error block of a survey from those of its windows, squares weighted by their samples in use."""
    known = [(n, b) for n, b in blocks if b is not None and n]
    if not known:
        return None
    samples = sum(n for n, _ in known)
    found: dict[str, Any] = {"samples": samples}
    for key in known[0][1]:
        parts = [(n, b[key]) for n, b in known if isinstance(b[key], dict)]
        if key == "samples":
            continue
        found[key] = {name: _together([(n, p[name]) for n, p in parts]) for name in parts[0][1]} if parts else None
    return found


def _together(parts: Sequence[tuple[int, float | None]]) -> float | None:
    figures = [(n, v) for n, v in parts if v is not None]
    total = sum(n for n, _ in figures)
    return float(np.sqrt(sum(n * v**2 for n, v in figures) / total)) if total else None


def _appended(
    path: Path,
    whole: xr.DataTree | None,
    parts: Iterator[xr.DataTree],
    made_by: Provenance,
    flags: list[Flag] | None = None,
) -> Provenance:
    """Write groups that are whole and the windows of those that are not; the provenance with the content's hash."""
    import json

    import h5py
    import xarray as xr

    done = 0
    for tree in parts:
        groups = {name: node.to_dataset() for name, node in tree.children.items()}
        count = next(iter(groups.values())).sizes["time"]
        if not done:
            first = dict(groups)
            if whole is not None:
                first |= {name: node.to_dataset() for name, node in whole.children.items()}
            if flags is not None:
                first["qc"] = xr.Dataset(attrs={"flag_record": "[]"})
            begun = xr.DataTree.from_dict({f"/{name}": dataset for name, dataset in first.items()})
            begun.attrs.update((whole if whole is not None else tree).attrs)
            growing = {f"/{name}": ("time",) for name in groups}
            result.save(begun, made_by, path, growing)
        else:
            with h5py.File(path, "r+") as file:
                for name, dataset in groups.items():
                    for key, variable in dataset.variables.items():
                        if variable.dims[:1] == ("time",):
                            stored = file[f"{name}/{key}"]
                            stored.resize(done + count, axis=0)
                            stored[done:] = variable.values
        done += count
    with xr.open_datatree(path, engine="h5netcdf", decode_times=False) as opened:
        made_by = replace(made_by, content_sha256=provenance.content_sha256(opened))
    with h5py.File(path, "r+") as file:
        file[provenance.GROUP].attrs["content_sha256"] = made_by.content_sha256
        if flags is not None:
            file["qc"].attrs["flag_record"] = json.dumps([f.as_dict() for f in flags])
    return made_by


def _report(folder: Path, output: Path, survey: Survey, made_by: Provenance) -> None:
    """The report of the selection, moved beside the files of the whole."""
    with tempfile.TemporaryDirectory(dir=output) as name:
        small = Path(name)
        result.save(result.result_tree(survey), made_by, small / result.RESULT)
        (small / result.VERDICT).write_bytes((folder / result.VERDICT).read_bytes())
        result.report(small)
        if (small / result.REPORT).is_file():
            (small / result.REPORT).replace(folder / result.REPORT)
