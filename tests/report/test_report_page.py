"""The page as a whole: what it says, what it leaves out, what it survives."""

from __future__ import annotations

import base64
import builtins
import dataclasses
import json
import re
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import report_results as made

from magtensor import result
from magtensor.errors import DataError, UsageError
from magtensor.report import write_report
from magtensor.survey.flags import Flag
from magtensor.survey.model import Survey
from magtensor.verdict import verdict

pytestmark = pytest.mark.pictures
VOID = {"meta", "img", "br", "link", "input", "hr"}
Write = Callable[..., Path]


@pytest.fixture(scope="module")
def whole_survey() -> Survey:
    return made.calibrated_survey()


@pytest.fixture
def written(tmp_path: Path) -> Write:
    """Write a survey as a finished run would, without the page; the folder."""
    return lambda survey, outcome=None, **changes: made.save(tmp_path / "run", survey, outcome, **changes)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """For what is only about the words of the page."""
    monkeypatch.setattr("magtensor.report.gallery.gallery", lambda content: [])


class Balanced(HTMLParser):
    """Collects what is wrong with the nesting, and every text, tag and attribute."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.faults: list[str] = []
        self.tags: list[str] = []
        self.text: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(page)
        self.close()
        self.faults += [f"<{tag}> is never closed" for tag in self.open]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.faults.append(f"</{tag}> closes nothing that is open")

    def handle_data(self, data: str) -> None:
        self.text.append(data)

    def of(self, tag: str, name: str) -> list[str]:
        return [v for t, n, v in self.attributes if (t, n) == (tag, name)]


def parsed(path: Path | None) -> Balanced:
    assert path is not None
    page = Balanced(path.read_text(encoding="utf-8"))
    assert page.faults == []
    assert not {"script", "iframe", "object", "link", "embed", "base", "form"} & set(page.tags)
    identifiers = [v for _, n, v in page.attributes if n == "id"]
    assert len(set(identifiers)) == len(identifiers)
    assert {v[1:] for v in page.of("a", "href")} <= set(identifiers)
    for uri in page.of("img", "src"):
        ElementTree.fromstring(picture(uri))  # well-formed
    return page


def picture(uri: str) -> str:
    head, _, data = uri.partition(",")
    assert head == "data:image/svg+xml;base64"
    return base64.b64decode(data, validate=True).decode()


def words(page: Balanced) -> str:
    return re.sub(r"\s+", " ", " ".join(page.text))


def titles(page: Balanced) -> list[str]:
    return [alt.split(".")[0] for alt in page.of("img", "alt")]


@pytest.fixture(scope="module")
def whole(whole_survey: Survey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    result.write(folder, whole_survey, made.provenance(), verdict(whole_survey))
    assert (folder / "report.html").is_file()  # a run writes the page with its other files
    return folder


def test_page_of_a_whole_result_has_every_picture_in_order(whole: Path) -> None:
    page = parsed(whole / "report.html")
    assert titles(page) == [
        "What is left of the total field",
        "Contrasts between the sensors",
        "Gradient tensor",
        "Trace and asymmetry",
        "Invariants",
        "Attitudes",
        "What is left against direction",
        "Spectrum of what is left",
        "Distribution of what is left",
        "Reference",
        "Samples taken out of use",
    ]


def test_page_says_what_the_files_say(whole: Path) -> None:
    text = words(parsed(whole / "report.html"))
    outcome = json.loads((whole / "verdict.json").read_text())
    from magtensor.report.tables import number
    from magtensor.verdict_words import told

    said = told(outcome)
    assert f"{said.head}." in text
    for heading, items in said.groups.items():
        assert heading in text and all(item in text for item in items)
    for block in ("total_field_rms_nT", "tensor_rms_nT_per_m", "invariant_rms"):
        for value in outcome["error"]["fit"][block].values():
            assert number(value) in text
    for expected in (
        "Cross of four fluxgates", "A. Surveyor, B. Physicist", "Chi, Ren and Liu 2017", "1 fail", "1 warn", "1 pass",
        "much too wide", "a rotation of the whole array", "sensor S1", "output at the end of its range",
        "2026-03-21 09:16:40 UTC", "magtensor run result.nc", "ab" * 32, "parameters of Chi 2017", "calibrate_scalar",
    ):  # fmt: skip
        assert expected in text


def test_page_loads_nothing_from_anywhere(whole: Path) -> None:
    page = (whole / "report.html").read_text()
    balanced = parsed(whole / "report.html")
    resources = [v for _, n, v in balanced.attributes if n in ("src", "href", "srcset", "data", "action", "poster")]
    assert resources and all(v.startswith(("data:image/svg+xml;base64,", "#")) for v in resources)
    assert "@import" not in page and not re.search(r"url\((?!#)", page)
    for uri in balanced.of("img", "src"):
        drawing = picture(uri)
        assert set(re.findall(r'(?:href|src)="([^"]{0,5})', drawing)) <= {"data:"} | set(
            re.findall(r'href="(#[^"]{0,4})', drawing)
        )
        assert not re.search(r"url\((?!#)", drawing) and "@import" not in drawing


def test_the_same_result_gives_the_same_bytes(whole: Path) -> None:
    first = (whole / "report.html").read_bytes()
    assert write_report(whole) == whole / "report.html"
    assert (whole / "report.html").read_bytes() == first
    assert not [f.name for f in whole.iterdir() if "partial" in f.name]


def without(survey: Survey, *paths: str) -> Survey:
    """The survey without groups (`calibration`) or variables (`residual/contrast`)."""
    tree = survey.tree.copy()
    for path in paths:
        group, _, name = path.partition("/")
        if name:
            tree[group] = type(tree)(tree[group].to_dataset().drop_vars(name))
        else:
            del tree[group]
    return dataclasses.replace(survey, tree=tree)


@pytest.mark.parametrize(
    ("missing", "gone", "said"),
    [
        (("residual", "qc"), "What is left of the total field", "holds no |b| − F"),
        (("residual/total_field", "array/diurnal"), "What is left against direction", "of each sensor is held."),
        (("residual/contrast", "residual/total_field_before"), "Contrasts between the sensors", "noise alone"),
        (("residual/closure", "calibrated/tensor_std", "calibration"), "Trace and asymmetry", "holds no calibration"),
        (("calibrated/tensor", "calibrated/tensor_std"), "Gradient tensor", "three or more sensors"),
        (("calibrated", "array/total_field", "array/diurnal"), "Reference", "holds no calibrated field"),
        (("calibration/noise_std", "calibration/covariance", "qc"), "nothing", "No metric judged this survey"),
        (("calibrated", "residual", "qc", "array/total_field", "array/diurnal"), "Attitudes", "no stage calibrated"),
    ],
)
def test_what_is_missing_is_said_in_words(
    whole_survey: Survey, written: Write, missing: tuple[str, ...], gone: str, said: str
) -> None:
    folder = written(without(whole_survey, *missing), outcome=verdict(whole_survey))
    page = parsed(write_report(folder))
    assert gone not in titles(page)
    assert said in words(page)


@pytest.mark.parametrize("sensors", [("only",), ("left", "right")])
def test_one_or_two_sensors_have_no_tensor_and_the_page_says_so(written: Write, sensors: tuple[str, ...]) -> None:
    page = parsed(write_report(written(made.calibrated_survey(400, sensors))))
    assert "What is left of the total field" in titles(page)
    assert ("Contrasts between the sensors" in titles(page)) == (len(sensors) == 2)
    assert "three or more sensors" in words(page)
    assert "noise alone" in words(page)  # found from the data where no stage stored it


@pytest.mark.parametrize("samples", [1, 12])
def test_a_handful_of_samples(written: Write, samples: int) -> None:
    assert "Gradient tensor" in titles(parsed(write_report(written(made.calibrated_survey(samples)))))


def test_no_sample_at_all(whole_survey: Survey, written: Write) -> None:
    tree = whole_survey.tree.copy()
    empty = {n: c.to_dataset().isel(time=slice(0, 0)) if "time" in c.dims else c.to_dataset()
             for n, c in tree.children.items()}  # fmt: skip
    tree = type(tree).from_dict({f"/{n}": d for n, d in empty.items()})
    survey = dataclasses.replace(whole_survey, tree=tree, flags=())
    page = parsed(write_report(written(survey, outcome=verdict(whole_survey))))
    assert titles(page) == [] and "nothing over time" in words(page)


def test_columns_of_nan_and_infinity(whole_survey: Survey, written: Write) -> None:
    b, residual = whole_survey.values("calibrated/b").copy(), whole_survey.values("residual/total_field").copy()
    b[:, 1] = np.nan
    residual[:, 1] = np.nan
    residual[5:9, 0] = np.inf
    tensor = np.full_like(whole_survey.values("calibrated/tensor"), np.nan)
    dims = ("time", "sensor")
    survey = whole_survey.merged(
        {
            "calibrated/b": ((*dims, "axis"), b, {}),
            "residual/total_field": (dims, residual, {}),
            "calibrated/tensor": (("time", "row", "column"), tensor, {}),
            "calibration/noise_std": (("sensor", "axis"), np.full((4, 3), np.nan), {}),
        }
    )
    page = parsed(write_report(written(survey, outcome=verdict(whole_survey))))
    assert "Gradient tensor" in titles(page)
    assert "fewer than ten samples" in words(page)
    assert page.text.count("noise alone") == 0


def test_every_sample_flagged(written: Write) -> None:
    survey = made.calibrated_survey(300)
    survey = survey.merged({"good": (("time", "sensor"), np.zeros((300, 4), dtype=bool), {})})
    assert "no samples" in "".join(picture(u) for u in parsed(write_report(written(survey))).of("img", "src"))


HOSTILE = (
    "<script>alert(1)</script>", "a\x00b\nc", "$\\frac{x$", "_hidden", "]]>-->&amp;\"'", "N" * 300, "传感器 ٣",
    "{{ 7*7 }}",
)  # fmt: skip


def test_hostile_text_stays_text(written: Write) -> None:
    survey = made.calibrated_survey(300, tuple(n.replace("\x00", "\x01") for n in HOSTILE))
    survey = survey.merged(
        {
            "qc/words": (("metric",), np.array(["<img src=x onerror=alert(1)>"] * 3), {}),
            "qc/state": (("metric",), np.array(['"><script>', "warn", "fail"]), {}),
        },
        [Flag(1000.0, 1005.0, 50, HOSTILE[0], "<b>by</b>", "$reason_{<i>} -->")],
    )
    survey = dataclasses.replace(survey, attributes={"title": "</title><script>x</script>"})
    recipe = {"title": "<script>1</script>", "authors": ["<u>me</u>"], "references": ["javascript:alert(1)"],
              "description": "</p><script>"}  # fmt: skip
    outcome = verdict(survey) | {
        "adopted": [{"error_model": "<script>", "sensors": ["<b>"], "coefficients": [{"name": "<x>", "value": 1.0}]}],
        "rejected": [{"error_model": "<i>", "why": "</section>"}],
    }
    page = parsed(write_report(written(survey, outcome=outcome, recipe=recipe)))
    assert not {"i", "u", "b"} & set(page.tags)
    assert "<script>alert(1)</script>" in words(page) and "{{ 7*7 }}" in words(page)


@pytest.mark.usefixtures("no_pictures")
def test_the_loops_findings_are_shown(whole_survey: Survey, written: Write) -> None:
    block = verdict(whole_survey)["error"]["fit"]
    better = json.loads(json.dumps(block))
    better["total_field_rms_nT"]["all"] = 0.0321
    outcome = verdict(whole_survey) | {
        "adopted": [
            {"error_model": "temperature_offset", "sensors": ["S1"], "settings": {"channel": "air", "lag_s": 118.0},
             "coefficients": [{"name": "x", "sensor": "S1", "value": 1.02, "std": 0.004, "units": "nT/degC"}],
             "evidence": {"z": 11.8}, "indistinguishable_from": ["warm_up"], "channels_as_good": ["box_degC"]}
        ],
        "rejected": [{"error_model": "eddy_current", "why": "no gain on held-out blocks"},
                     {"error_model": "bandwidth", "why": "screened"}, {"error_model": "warm_up", "why": "screened"}],
        "not_tested": [{"error_model": "current_field", "missing": ["current_*"]}],
        "unexplained": {"present": True, "excess_rms_nT": 0.21, "description": "a line at 0.5 Hz in S2"},
        "error": {"fit": None, "held_out": {"before": block, "after": better}},
    }  # fmt: skip
    text = words(parsed(write_report(written(whole_survey, outcome=outcome))))
    for expected in (
        "temperature_offset", "lag_s: 118", "channel: air", "S1 x: 1.0200 ± 0.0040 nT/degC", "warm_up",
        "eddy_current: no gain", "bandwidth, warm_up: screened", "nor its channel from box_degC",
        "current_field: the survey has no current_*", "a line at 0.5 Hz in S2", "0.21 nT rms above the noise",
        "held-out blocks: declared model", "held-out blocks: with adopted effects", "0.0321",
    ):  # fmt: skip
        assert expected in text


@pytest.mark.usefixtures("no_pictures")
def test_equal_errors_before_and_after_are_one_column(whole_survey: Survey, written: Write) -> None:
    outcome = verdict(whole_survey, verify=verdict(whole_survey)["error"]["fit"])
    text = words(parsed(write_report(written(whole_survey, outcome=outcome))))
    assert "verification survey" in text and "declared model" not in text


@pytest.mark.long
def test_many_samples_of_a_dozen_sensors_stay_small(tmp_path: Path) -> None:
    survey = made.calibrated_survey(30_000, tuple(f"S{k}" for k in range(14)))
    path = write_report(made.save(tmp_path, survey))
    page = parsed(path)
    assert path is not None and path.stat().st_size < 3_000_000
    assert "Of 14 sensors the 12 with the most left are shown" in words(page)


@pytest.mark.parametrize("library", ["matplotlib", "jinja2"])
def test_without_the_optional_libraries(whole: Path, monkeypatch: pytest.MonkeyPatch, library: str) -> None:
    real = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == library:
            raise ModuleNotFoundError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    before = (whole / "report.html").read_bytes()
    assert write_report(whole) is None
    with pytest.raises(UsageError, match=re.escape("pip install 'magtensor[report]'")):
        write_report(whole, required=True)
    assert (whole / "report.html").read_bytes() == before


def test_importing_the_report_is_cheap() -> None:
    import subprocess

    code = (
        "import sys, magtensor.report;"
        "sys.exit(any(m in sys.modules for m in ('matplotlib', 'jinja2', 'xarray', 'scipy')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_folder_without_a_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        write_report(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", ["{", "[]", '{"schema": 1}'])
def test_a_broken_verdict_is_named(whole_survey: Survey, written: Write, content: str) -> None:
    folder = written(whole_survey)
    (folder / "verdict.json").write_text(content)
    with pytest.raises(DataError, match=r"verdict\.json"):
        write_report(folder)


@pytest.mark.usefixtures("no_pictures")
def test_no_verdict_is_said(whole_survey: Survey, written: Write) -> None:
    folder = written(whole_survey)
    (folder / "verdict.json").unlink()
    assert "no verdict.json" in words(parsed(write_report(folder)))
