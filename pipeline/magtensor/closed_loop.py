"""The loop from Python: `magtensor.close_loop(survey)` does what `magtensor run recipes/closed_loop.yaml` does."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtensor import provenance, result
from magtensor.accuracy import figure
from magtensor.applying import apply_and_refine, fit_in_words
from magtensor.preparing import empty_survey
from magtensor.provenance import Provenance, plan_again
from magtensor.recipe.plan import Plan, plan
from magtensor.recipe.source import Document, load_yaml
from magtensor.refusal import picture_named
from magtensor.session import Computed, Finished, compute, require_verifying
from magtensor.survey.in_memory import Held, SurveyLike, given_survey
from magtensor.survey.model import Survey
from magtensor.verdict import survey_block
from magtensor.verdict_words import lines, sentence

if TYPE_CHECKING:
    import xarray as xr

RECIPE = Path(__file__).with_name("closed_loop.yaml")
STAGE = "close_loop"


def close_loop(
    survey: SurveyLike,
    *,
    verify: SurveyLike | None = None,
    plugins: Sequence[str | Path] = (),
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> ClosedLoop:
    """Calibrate all sensors, trace what is left to the effects that the linear model lacks, and refit with them.

    The same code and, bit for bit, the same result as `magtensor run recipes/closed_loop.yaml --input survey`.

    Args:
        survey: a path, a Survey, or xarray data in the canonical layout (`magtensor.survey.in_memory.given_survey`).
        verify: a second survey in a uniform field; its error goes into the verdict.
        plugins: folders of single-file plugins, or such files.
        progress: called with each stage's name.
        options: of the stage `close_loop` (`magtensor plugins close_loop`): declared, search, false_alarm,
            most_effects, reference_noise_nT, worst_error, ...

    Raises:
        UsageError: an option is wrong.
        DataError, NotEnoughData: the survey is wrong, or not enough to calibrate.
    """
    given = given_survey(survey)
    verified = None if verify is None else given_survey(verify)
    planned = planned_loop(given, options, plugins, verified)
    if verified is not None:
        require_verifying(planned, verified, planned.source().files() if isinstance(given, Path) else ())
    source = planned.source() if isinstance(given, Path) else given
    held = verified if isinstance(verified, Held) else None
    with picture_named(given) if isinstance(given, Path) else nullcontext():
        return ClosedLoop(compute(planned, empty_survey(source), verify=held, progress=progress))


def planned_loop(
    given: Path | Held, options: dict[str, Any], plugins: Sequence[str | Path] = (), verify: Path | Held | None = None
) -> Plan:
    """The recipe that closes the loop, with options of its stage, on a survey, verified by another."""
    survey, verify = (None if isinstance(one, Held) else one for one in (given, verify))
    return plan(loop_document(options), plugin_folders=[Path(p) for p in plugins], survey=survey, verify=verify)


def loop_document(options: dict[str, Any]) -> Document:
    """The recipe that closes the loop, as a document, with options of its stage."""
    document = load_yaml(RECIPE)
    value = copy.deepcopy(document.value)
    place = value["stages"].index(STAGE)
    if options:
        value["stages"][place] = {STAGE: copy.deepcopy(options)}
    # relative paths are the caller's, and a line of this file says nothing to him
    return Document(value, f"magtensor.{STAGE}", {}, Path())


@dataclass(frozen=True)
class Calibration:
    """A calibration that can be applied to other surveys, with the effects that were adopted.

    Attributes:
        stored: a survey whose node `calibration` holds it.
        planned: the recipe that made it.
        made_by: its provenance.
    """

    stored: Survey
    planned: Plan
    made_by: Provenance

    @classmethod
    def open(cls, path: str | Path) -> Calibration:
        """Read a `calibration.nc` or `result.nc`.

        Raises:
            DataError, UsageError: it is no such file, or needs a plugin that is not installed.
        """
        stored, made_by = result.open_result(Path(path)), provenance.read(Path(path))
        return cls(stored, plan_again(Path(path), made_by), made_by)

    @property
    def dataset(self) -> xr.Dataset:
        """The group `calibration`: matrix, offset, covariance, effects, ..."""
        return self.stored.tree["calibration"].to_dataset()

    def apply(self, survey: SurveyLike) -> xr.DataTree:
        """Another survey of the same sensors, calibrated.

        Returns:
            What `magtensor apply` writes: `/calibrated` (b nT, tensor nT/m, ..., good) and `/qc`; the attribute `fit`
            says how well the calibration fits.

        Raises:
            DataError: the survey has other sensors, or lacks a channel that an effect follows.
        """
        found, _ = apply_and_refine(
            self.stored, given_survey(survey), self.planned, tolerant=True, refine_rotation=False
        )
        tree = result.only(result.result_tree(found), "calibrated", "qc")
        tree.attrs["fit"] = fit_in_words(survey_block(found))
        return tree

    def save(self, path: str | Path) -> Path:
        """Write it as the `calibration.nc` that `magtensor apply` reads."""
        result.write_calibration(Path(path), self.stored, self.made_by)
        return Path(path)

    def __repr__(self) -> str:
        known = self.stored.values("calibration/effects") if "calibration/effects" in self.stored else ()
        effects = ", ".join(json.loads(str(text))["error_model"] for text in known)
        return f"<Calibration of {', '.join(result.sensors_of(self.stored))}; linear{effects and f', {effects}'}>"


@dataclass(frozen=True, repr=False)
class ClosedLoop:
    """What the loop found on a survey.

    Attributes:
        computed: the run: its plan, the survey after the last stage, the verdict.
    """

    computed: Computed

    @property
    def verdict(self) -> dict[str, Any]:
        """The content of `verdict.json`."""
        found: dict[str, Any] = result.finite(self.computed.outcome)
        return found

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        return sentence(self.computed.outcome)

    @property
    def steps(self) -> list[dict[str, Any]]:
        """The rounds of the search in order: what was looked at with which evidence, what was adopted, what refused."""
        return list(self.verdict["steps"])

    @property
    def calibration(self) -> Calibration:
        """C, o and the adopted effects, to be saved or applied to another survey."""
        return Calibration(self.computed.survey, self.computed.planned, self.computed.provenance())

    @property
    def dataset(self) -> xr.DataTree:
        """The groups of `result.nc`: calibrated, calibration, residual, qc, detrended."""
        return result.result_tree(self.computed.survey)

    def save(self, directory: str | Path) -> Finished:
        """Write result.nc, calibration.nc, verdict.json and report.html into a folder, all or none."""
        return self.computed.write(Path(directory))

    def summary(self) -> str:
        """The verdict in a few lines."""
        return summary(self.verdict)

    def __repr__(self) -> str:
        return f"<ClosedLoop>\n{self.summary()}"


def summary(verdict: dict[str, Any]) -> str:
    """A verdict in a few lines of text."""
    told = lines(verdict)
    for one in verdict["adopted"]:
        evidence = one["evidence"]
        settings = ", ".join(f"{k} {_short(v)}" for k, v in one["settings"].items() if not isinstance(v, list))
        rivals, others = one["indistinguishable_from"], one.get("channels_as_good", [])
        bends = one["settings"].get("bends", [])
        before, after = evidence["held_out_rms_before_nT"], evidence["held_out_rms_after_nT"]
        words = [
            *([settings] if settings else []),
            *([f"by a curve that bends at {', '.join(f'{b:.3g}' for b in bends)}"] if bends else []),
            *([one["means"]] if "means" in one else []),
            *([f"most like channel {one['most_like_channel']}"] if "most_like_channel" in one else []),
            f"on {', '.join(one['sensors'])}" if one["sensors"] else "on all sensors alike",
            f"held-out residual {figure(before)} -> {figure(after)} nT",
            *([f"z {evidence['z']:.3g}"] if evidence["z"] is not None else []),
            *([f"not told from {', '.join(rivals)}"] if rivals else []),
            *([_other_channels(one, ", ".join(others))] if others else []),
        ]
        told.append(f"  adopted {one['error_model']}: {'; '.join(words)}")
    looked_at = {c["error_model"] for step in verdict.get("steps", []) for c in step["looked_at"]}
    if rejected := [
        r["error_model"] for r in verdict["rejected"] if r["error_model"] in looked_at or r.get("by") == "person"
    ]:
        told.append(f"  looked at and not adopted: {', '.join(rejected)}")
    if verdict["not_tested"]:
        missing = ", ".join(f"{n['error_model']} ({' and '.join(n['missing'])})" for n in verdict["not_tested"])
        told.append(f"  not tested for want of channels: {missing}")
    return "\n".join(told)


def _other_channels(one: dict[str, Any], names: str) -> str:
    """That other channels would do as well, or have the line of a tone."""
    return f"its channel not told from {names}" if "channel" in one["settings"] else f"a line of {names} too"


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
