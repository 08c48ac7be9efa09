"""What the loop finds, and whom it accuses, where the attitudes determine no calibration: level flight.

    python studies/level_flight.py --rows build/level.jsonl --first-seed 300 --repeats 1
    python studies/level_flight.py --rows build/level.jsonl --first-seed 700 --repeats 0 --page docs/level_flight.md

Each trial is a flight of five minutes at 10 Hz, simulated in the time domain: heading wanders freely, or eight legs to
and fro; roll and pitch stay within 2 to 5 deg. Two or four sensors with 5 % of soft iron, 2 deg of misalignment,
offsets up to 2000 nT, 1 to 20 nT of white noise each axis, alone or with 1/f noise that crosses it at 0.1 Hz. The
reference is a base station, or one constant while the field varies. Logged are a current, which draws more when the
platform leans and turns (and wanders by itself), the battery's voltage and a temperature.

- **right**: the effect or a model declared indistinguishable from it is all that was adopted, on the sensor that has
  it (a difference in delay: on either); **shared**: so, but on another sensor too; **more**: something else was adopted
  beside it; **wrong**: only something else was.
- **told**: nothing was adopted, but the verdict says that something unexplained is left; **missed**: it does not.

Within 2 to 5 deg the attitudes are sometimes just enough for the fit without a prior, which then decides as it does on
any survey; those flights have rows of their own. Where the reference is a constant, the field's own variation is there
to be told; where it is called `reference_drift`, which it is, it counts as wrong all the same.

Rows that exist are not made again: the command goes on where it stopped, and writes the page from all of them.
"""

from __future__ import annotations

import argparse
import itertools
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import trials
from loop_surveys import recorded

from magtensor.simulate import Simulated, simulate

SENSORS = {
    1: [[0.0, 0.0, 0.15]],
    2: [[0.0, 0.0, 0.15], [0.05, 0.0, 0.0]],
    4: [[0.2, 0, 0], [-0.2, 0, 0], [0, 0.2, 0], [0, -0.2, 0.1]],
}
FIELD: dict[str, Any] = {
    "earth": {"total_field_nT": 49500.0, "inclination_deg": 66.0, "declination_deg": 4.0},
    "variation": {"diurnal": {"amplitude_nT": [5.0, -20.0, 8.0]}, "irregular": {"rms_nT": 2.0, "time_s": 100.0}},
}
TEMPERATURE = {
    "type": "temperature", "ambient_degC": 18.0, "trend_degC_per_h": 20.0, "wander_rms_degC": 1.0,
    "wander_time_s": 60.0, "self_heating_degC": 4.0, "tau_s": 60.0, "log_noise": 0.02,
}  # fmt: skip


class Flight(NamedTuple):
    """One survey: effect ("" for none) on sensor S2, its rms over the white noise, and the circumstances."""

    effect: str
    amplitude: float
    sensors: int
    noise_nT: float
    flicker: bool
    motion: str
    reference: str
    seed: int


def flown(flight: Flight) -> Simulated:
    """The flight's survey."""
    rng = np.random.default_rng([flight.seed, 77])
    tilt = float(rng.uniform(2.0, 5.0))
    motion: dict[str, Any] = {
        "wander": {"type": "limited_tilt", "duration_s": 300.0, "tilt_deg": tilt, "tilt_time_s": 6.0,
                   "yaw_rate_rms_deg_s": 12.0, "yaw_time_s": 30.0},
        "legs": {"type": "survey_lines", "lines": 8, "length_m": 165.0, "speed_m_s": 5.0, "turn_s": 5.0,
                 "wobble_deg": 0.6 * tilt, "wobble_time_s": 4.0, "azimuth_deg": float(rng.uniform(0, 360))},
        "tumbling": {"type": "tumbling", "duration_s": 300.0, "rate_rms_deg_s": 20.0, "rate_time_s": 4.0},
    }[flight.motion]  # fmt: skip
    noise = {"white_sd_nT": flight.noise_nT}
    if flight.flicker:  # equal to the white noise at 0.1 Hz
        noise["flicker_nT_per_rtHz"] = flight.noise_nT * float(np.sqrt(2.0 * 0.1 / 10.0))
    errors = {"scale": 0.02, "non_orthogonality_deg": 1.0, "misalignment_deg": 2.0, "soft_iron": 0.05,
              "hard_iron_nT": 1500.0, "bias_nT": 500.0}  # fmt: skip
    effects: list[dict[str, Any]] = []
    size = {"rms_nT": flight.amplitude * flight.noise_nT, "sensors": [f"S{min(2, flight.sensors)}"]}
    if flight.effect == "temperature_offset":
        effects = [{"type": "temperature_offset", "lag_s": 20.0, **size}]
    elif flight.effect == "sampling_lag":
        effects = [{"type": "sampling_lag", **size}]
    made = simulate({
        "title": "level flight", "seed": flight.seed, "start": "2026-03-21T09:00:00Z", "rate_Hz": 10.0,
        "instrument": {"seed": 500 + flight.seed, "array": {"positions_m": SENSORS[flight.sensors][: flight.sensors]},
                       "errors": errors, "noise": noise},
        "motion": motion, "field": FIELD, "base_station": {"rate_Hz": 0.5, "noise_sd_nT": 0.1, "resolution_nT": 0.01},
        "channels": {"temperature": TEMPERATURE}, "logging": {"attitude": True}, "effects": effects,
    })  # fmt: skip
    current = drawn(made, rng)
    raw = np.array(made.b_raw)
    if flight.effect == "current_field":
        way = rng.standard_normal(3)
        shape = np.outer(current - current.mean(), way)
        raw[:, min(1, flight.sensors - 1)] += shape * (flight.amplitude * flight.noise_nT / np.sqrt(np.mean(shape**2)))
    voltage = 16.2 - 0.03 * current - 0.6 * made.time / 300.0 + 0.01 * rng.standard_normal(len(current))
    logged = dict(made.channels)
    if flight.seed % 2:
        del logged["attitude"]
    logged["current_battery"] = (current + 0.05 * rng.standard_normal(len(current)), ("time",), "A")
    logged["voltage_battery"] = (voltage, ("time",), "V")
    reference = made.reference
    if flight.reference == "constant" and reference is not None:
        nearly = FIELD["earth"]["total_field_nT"] + 80.0
        reference = replace(reference, total_field=np.full(len(reference.time), nearly))
    return replace(made, b_raw=raw, channels=logged, reference=reference)


def drawn(made: Simulated, rng: np.random.Generator) -> np.ndarray:
    """(N,) A: hover, what leaning and turning cost with the motors' delay, and wind."""
    x, y, z, w = made.channels["attitude"][0].T
    lean = np.hypot(2 * (x * z - w * y), 2 * (y * z + w * x))  # sine of the angle between the platform's z and up
    heading = np.unwrap(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))
    turning = np.abs(np.gradient(heading, made.time))
    wind = _smooth(rng.standard_normal(len(lean)), 40) + 0.5 * _smooth(rng.standard_normal(len(lean)), 400)
    work = _standard(_smooth(lean, 3)) + 0.7 * _standard(_smooth(turning, 3)) + _standard(wind)
    return np.asarray(15.0 + 2.0 * work + 0.2 * rng.standard_normal(len(lean)))


def _smooth(series: np.ndarray, samples: int) -> np.ndarray:
    """(N,) after a one-pole low-pass."""
    from scipy.signal import lfilter

    share = 1.0 - np.exp(-1.0 / samples)
    out: np.ndarray = lfilter([share], [1.0, share - 1.0], series - series.mean())
    return _standard(out)


def _standard(series: np.ndarray) -> np.ndarray:
    return (series - series.mean()) / max(float(series.std()), 1e-12)


def outcome(flight: Flight) -> dict[str, Any]:
    """What the loop makes of it."""
    from magtensor.calibration.nominal import Nominal
    from magtensor.errors import MagtensorError
    from magtensor.loop.fitting.model import Fitting
    from magtensor.loop.inquiry import Inquiry
    from magtensor.loop.near_nominal import settled
    from magtensor.loop.searching.gates import ALPHA
    from magtensor.loop.searching.outcome import described
    from magtensor.loop.searching.search import MOST_EFFECTS
    from magtensor.loop.searching.unexplained import unexplained
    from magtensor.registry import Registry

    registry = Registry.load()
    models = [registry.find("error_model", name) for name in registry.names("error_model")]
    simulation = flown(flight)
    record = recorded(simulation)
    began = time.monotonic()

    def inquired(how: Fitting) -> Inquiry:
        inquiry = Inquiry(record, models, how, most_effects=MOST_EFFECTS, alpha=ALPHA)
        inquiry.loop()
        return inquiry

    try:
        _, found, refusal = settled(inquired, Fitting(), Nominal())
    except MagtensorError as error:
        return {"verdict": "refused", "why": str(error).splitlines()[0]}
    told = unexplained(found, found.record)
    adopted = described(found, found.record, 0)["adopted"]
    facts = {
        "adopted": [[a["error_model"], a["settings"], a["sensors"], a["indistinguishable_from"]] for a in adopted],
        "unexplained": told["description"] if told["present"] else "",
        "determined": not refusal,
        "seconds": round(time.monotonic() - began, 1),
    }
    right = [a for a in adopted if flight.effect in (a["error_model"], *a["indistinguishable_from"])]
    own = f"S{min(2, flight.sensors)}"
    if flight.effect != "sampling_lag":
        right = [a for a in right if own in a["sensors"]]
    alone = flight.effect == "sampling_lag" or all(a["sensors"] == [own] for a in right)
    if adopted:
        verdict = "wrong" if not right else "more" if len(adopted) > 1 else "right" if alone else "shared"
    else:
        verdict = "told" if told["present"] else "missed"
    if right and flight.effect == "current_field":
        facts["coefficients"] = [[c["sensor"], c["value"], c["std"]] for c in right[0]["coefficients"]]
        facts["truth"] = truth_of(flight)
    return {"verdict": verdict} | facts


def truth_of(flight: Flight) -> list[float]:
    """(3,) nT/A of the current's effect."""
    with_, without = flown(flight), flown(flight._replace(effect=""))
    which = min(1, flight.sensors - 1)
    current = with_.channels["current_battery"][0]
    added = with_.b_raw[:, which] - without.b_raw[:, which]
    return [float(np.polyfit(current, a, 1)[0]) for a in added.T]


def flights(first_seed: int, repeats: int) -> Iterator[Flight]:
    """Every survey of the study, clean ones first; circumstances turn over, no seed comes twice."""
    seed = first_seed
    noises = (1.0, 5.0, 20.0)
    for sensors, flicker, motion, reference, noise in itertools.product(
        (2, 4), (False, True), ("wander", "legs"), ("base", "constant"), noises
    ):
        seed += 1
        yield Flight("", 0.0, sensors, noise, flicker, motion, reference, seed)
    wanted = [("current_field", a) for a in (1.0, 3.0, 10.0, 100.0)]
    wanted += [("temperature_offset", 3.0), ("sampling_lag", 3.0)]
    for _ in range(repeats):
        for sensors, (effect, amplitude), motion in itertools.product((2, 4), wanted, ("wander", "legs")):
            seed += 1
            flicker, reference = bool(seed // 2 % 2), ("base", "constant")[seed // 4 % 2]
            yield Flight(effect, amplitude, sensors, noises[seed % 3], flicker, motion, reference, seed)


def main() -> None:
    """Make the rows that are missing, then the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    trials.add_options(parser)
    parser.add_argument("--page", type=Path)
    parser.add_argument("--first-seed", type=int, default=5000)
    parser.add_argument("--repeats", type=int, default=2)
    given = parser.parse_args()
    wanted = flights(given.first_seed, given.repeats)
    rows, _ = trials.rows_of(given, wanted, lambda row: row["flight"], tried, line)
    if given.page:
        given.page.write_text(page(rows), encoding="utf-8")
    print(table(rows))


def tried(flight: Flight) -> dict[str, Any]:
    """The row of a survey."""
    return {"flight": list(flight)} | outcome(flight)


def line(row: dict[str, Any]) -> str:
    """A row, as it is told when it is made."""
    said = (row["verdict"], row.get("adopted"), row.get("why", ""))
    return " ".join(str(v) for v in (*row["flight"], *said))


VERDICTS = ("right", "shared", "more", "wrong", "told", "missed", "refused")


def table(rows: list[dict[str, Any]]) -> str:
    """How often each verdict came, by whether the attitudes determined a calibration, effect and strength."""
    lines = ["| attitudes | effect | x noise | surveys | " + " | ".join(VERDICTS) + " |", "|---|" + "---|" * 10]
    kinds = [(bool(r.get("determined")), r["flight"][0], r["flight"][1]) for r in rows]
    for kind in sorted(set(kinds)):
        own = [r["verdict"] for k, r in zip(kinds, rows, strict=True) if k == kind]
        counts = [str(own.count(v)) for v in VERDICTS]
        if not kind[1]:  # nothing is there to be found or missed
            counts = ["-", "-", "-", *counts[3:5], "-", counts[6]]
        told = "enough" if kind[0] else "not enough"
        lines.append(f"| {told} | {kind[1] or 'none'} | {kind[2]:g} | {len(own)} | {' | '.join(counts)} |")
    return "\n".join(lines)


def page(rows: list[dict[str, Any]]) -> str:
    """The study's page."""
    assert __doc__ is not None
    return f"# Level flight\n\n{__doc__.split('Rows that exist')[0].strip()}\n\n{table(rows)}\n"


if __name__ == "__main__":
    main()
