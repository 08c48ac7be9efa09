"""`magtensor simulate`: a scenario file in, a survey file out, and what was made in one line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from magtensor.atomic import refuse_overwriting, require_writable
from magtensor.recipe.overrides import override
from magtensor.recipe.problems import Problems
from magtensor.recipe.source import load_yaml


def simulate_file(scenario: Path, output: Path, overrides: Sequence[str] = ()) -> str:
    """Simulate a scenario file and write the survey in the canonical layout.

    Args:
        scenario: the YAML file.
        output: the survey file.
        overrides: `PATH=VALUE` texts, e.g. `seed=7` or `instrument.noise.white_sd_nT=1`.

    Raises:
        UsageError: every mistake in the scenario, with file and line; or the output cannot be written.
    """
    from magtensor.simulate.output import write
    from magtensor.simulate.run import simulate
    from magtensor.simulate.scenario import Scenario

    refuse_overwriting([output], [scenario])
    require_writable(output.parent)
    document = load_yaml(scenario)
    for text in overrides:
        document = override(document, text)
    problems = Problems(document)
    checked = problems.validated(Scenario, document.value, ())
    problems.raise_if_any()
    assert checked is not None
    simulated = simulate(checked)
    write(simulated, output)
    sensors = f"{len(simulated.sensors)} sensor{'s' * (len(simulated.sensors) > 1)}"
    return f"simulated: {output}: {len(simulated.time)} samples of {sensors}"
