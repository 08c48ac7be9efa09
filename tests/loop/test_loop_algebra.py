"""Terms, Gram matrices and held-out loss against brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, synthetic

from magtensor.calibration.joint import fit_joint
from magtensor.components import component_of, error_model
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.terms import REFERENCE, Terms, joined
from magtensor.loop.evidence.assessment import Colours, colours_of, estimated, explained
from magtensor.loop.evidence.colour import Colour
from magtensor.loop.evidence.estimate import own_information, solve
from magtensor.loop.evidence.grams import grams, held_out, normal
from magtensor.loop.evidence.residual import Residual, residual_of, taken_off
from magtensor.loop.evidence.scoring import Scorer, rarity
from magtensor.loop.fitting.model import Fitting, Record
from magtensor.loop.fitting.seen import excitation_of
from magtensor.loop.searching.search import search

WHITE = Colour(None, 1.0)


def drawn_terms(seed: int, names: str, samples: int = 20) -> Terms:
    rng = np.random.default_rng(seed)
    count = len(names)
    parts = 2 * count
    return Terms(
        tuple(names), tuple("AB"[i % 2] for i in range(count)), ("nT",) * count, rng.standard_normal((samples, 3)),
        np.repeat(np.arange(count), 2), rng.integers(REFERENCE, 6, parts), rng.integers(0, 3, parts),
        part_weight=rng.standard_normal(parts),
    )  # fmt: skip


def dense(terms: Terms, outputs: int) -> Array:
    """(N, outputs + 1, P): every term on every output, the reference last; part by part."""
    out = np.zeros((len(terms.series), outputs + 1, terms.count))
    for t, o, s, w in zip(terms.part_term, terms.part_output, terms.part_series, terms.part_weight, strict=True):
        out[:, o, t] += w * terms.series[:, s]  # REFERENCE is -1: the last
    return out


def test_terms_add_up() -> None:
    one, two = drawn_terms(1, "abcd"), drawn_terms(2, "xyz")
    both = joined([one, two])
    theta = np.random.default_rng(3).standard_normal(7)
    expected = np.concatenate([dense(one, 6), dense(two, 6)], axis=2) @ theta
    np.testing.assert_allclose(both.contribution(theta, 6), expected[:, :6], atol=1e-12)
    np.testing.assert_allclose(both.on_reference(theta), expected[:, 6], atol=1e-12)
    assert both.names == ("a", "b", "c", "d", "x", "y", "z")
    some = both.only([5, 0, 2])
    assert (some.names, some.sensors) == (("y", "a", "c"), ("B", "A", "A"))
    np.testing.assert_allclose(dense(some, 6), dense(both, 6)[:, :, [5, 0, 2]])
    np.testing.assert_allclose(dense(both.at(np.array([4, 2])), 6), dense(both, 6)[[4, 2]])
    np.testing.assert_allclose(dense(both.unweighted, 6), dense(both, 6))


def models_terms(record: Record) -> Terms:
    """Offsets, scales, a matrix, a pattern over all sensors and the reference: every way in which effects act."""
    fit = fit_joint(record.raw, record.total_field, noise=np.full(record.raw.shape[1:], 1.0))
    x = excitation_of(record, fit, record.raw)
    t = np.linspace(-1, 1, len(record.time))
    return joined(
        [
            x.offsets(t**2, "nT"),
            x.scales(1e-4 * np.sin(9 * t), "1"),
            x.matrices(1e-4 * np.cos(5 * t)[:, None] * x.field[:, 0], "1").only(range(5)),
            x.shared(np.sin(7 * t)[:, None, None] * np.ones(x.output.shape), "nT", "all"),
            x.on_reference(np.cos(11 * t), "nT", "F"),
            x.one_each_sensing(np.sin(3 * t), 1e-4 * x.field[:, 0] * [1.0, -0.3, 0.2], "1", "stretched"),
            x.shared_sensing(np.cos(3 * t), x.direction, "nT", "longer"),
        ]
    )


@pytest.mark.parametrize("sensors", [1, 2, 4])
def test_normal_equations_are_those_of_the_whole_pipeline(sensors: int) -> None:
    """The change of the whitened residual of a joint refit when a little of each term is added to the data."""
    record = synthetic(4, samples=250, sensors=sensors)
    noise = np.random.default_rng(1).uniform(0.7, 1.5, (sensors, 3))
    terms = models_terms(record)
    every = np.ones(250, dtype=bool)

    def refit(raw: Array, field: Array) -> Array:
        fit = fit_joint(raw, field, noise=noise, keep=every, worst_error=1.0)
        left = residual_of(fit, raw, field)
        assert left.along is not None
        across = np.zeros((250, 0)) if left.across is None else left.across
        return np.column_stack([across, left.along]).ravel()

    assert record.total_field is not None
    step = 1e-2
    columns = []
    for unit in np.eye(terms.count):
        raw = step * terms.contribution(unit, 3 * sensors).reshape(record.raw.shape)
        field = step * terms.on_reference(unit)
        more = refit(record.raw + raw, record.total_field + field)
        columns.append((more - refit(record.raw - raw, record.total_field - field)) / (2 * step))
    jacobian = np.column_stack(columns)
    here = refit(record.raw, record.total_field)
    fit = fit_joint(record.raw, record.total_field, noise=noise, keep=every, worst_error=1.0)
    found, right = normal(grams(residual_of(fit, record.raw, record.total_field), terms, WHITE, WHITE).total())
    scale = np.sqrt(np.diag(jacobian.T @ jacobian))
    # noise over field, 2e-5, in the direction of the field moves a column by as much as the field turns it
    np.testing.assert_allclose(
        found[0] / np.outer(scale, scale), jacobian.T @ jacobian / np.outer(scale, scale), atol=2e-3
    )
    np.testing.assert_allclose(right[0] / scale, jacobian.T @ here / scale, atol=0.02)


def dense_problem(residual: Residual, terms: Terms) -> tuple[Array, Array, Array]:
    """Fit's own freedom (N, 3 S + 1, 12 S + 12), terms (N, 3 S + 1, P) and residual (N, 3 S + 1), whitened."""
    assert residual.across is not None and residual.along is not None
    n, size = residual.across.shape
    own = np.zeros((n, size + 1, 4 * size + 12))
    for o in range(size):
        own[:, :size, 4 * o : 4 * o + 4] = residual.projector[:, o][None, :, None] * residual.affine[:, None, :]
    own[:, size, 4 * size :] = residual.inner
    every = dense(terms, size)
    raw = every[:, :size] / residual.noise[:, None]
    columns = np.zeros((n, size + 1, terms.count))
    columns[:, :size] = np.einsum("ij,njp->nip", residual.projector, raw)
    columns[:, size] = np.einsum("no,nop->np", residual.gain, raw) + residual.reference_gain[:, None] * every[:, size]
    return own, columns, np.column_stack([residual.across, residual.along])


def regression(own: Array, columns: Array, r: Array) -> Array:
    both = np.concatenate([own, columns], axis=2)
    rows = both.reshape(-1, both.shape[2])
    scale = np.sqrt((rows**2).sum(axis=0))
    out: Array = np.linalg.lstsq(rows / scale, r.ravel(), rcond=1e-10)[0] / scale
    return out


def test_coefficients_and_held_out_loss_are_those_of_a_dense_regression() -> None:
    record = synthetic(5, samples=400, sensors=2)
    terms = models_terms(record)
    fit = fit_joint(record.raw, record.total_field, noise=np.ones((2, 3)))
    residual = residual_of(fit, record.raw, record.total_field)
    own, columns, r = dense_problem(residual, terms)
    blocks = grams(residual, terms, WHITE, WHITE, 8)
    n, y = normal(blocks.total())
    estimate = solve(n[0], y[0], own_information(blocks))
    assert estimate.rank == terms.count
    np.testing.assert_allclose(estimate.theta, regression(own, columns, r)[-terms.count :], rtol=1e-5, atol=1e-7)

    masks = np.zeros((2, 8), dtype=bool)
    masks[0, 2:4], masks[1, 7] = True, True
    test, train = blocks.chosen(masks), blocks.chosen(~masks)
    n, y = normal(train)
    theta = np.stack([solve(n[k], y[k], own_information(blocks)).theta for k in range(2)])
    before, after = held_out(train, test, theta)
    for k in range(2):
        row = np.repeat(masks[k], 50)
        full = regression(own[~row], columns[~row], r[~row])
        left = r[row] - np.concatenate([own, columns], axis=2)[row] @ full
        assert after[k] == pytest.approx(np.sum(left**2), rel=1e-6)
        alone = regression(own[~row], np.zeros((int((~row).sum()), 7, 0)), r[~row])
        assert before[k] == pytest.approx(np.sum((r[row] - own[row] @ alone) ** 2), rel=1e-6)


def test_taking_off_what_was_fitted_leaves_nothing_to_fit() -> None:
    record = synthetic(6, samples=300, sensors=4)
    terms = models_terms(record)
    fit = fit_joint(record.raw, record.total_field, noise=np.ones((4, 3)))
    residual = residual_of(fit, record.raw, record.total_field)
    blocks = grams(residual, terms, WHITE, WHITE)
    n, y = normal(blocks)
    estimate = solve(n[0], y[0], own_information(blocks))
    left = taken_off(residual, terms, estimate.theta)
    _, after = normal(grams(left, terms, WHITE, WHITE))
    assert np.abs(after[0] / np.sqrt(np.diag(n[0]))).max() < 1e-6 * np.sqrt(residual.freedom * 300)
    expected = (residual.square() - left.square()) * 300 * residual.freedom
    assert estimate.theta @ n[0] @ estimate.theta == pytest.approx(expected, rel=1e-6)


def test_merged_blocks_hold_the_same_sums() -> None:
    record = synthetic(7, samples=240, sensors=2)
    terms = models_terms(record)
    residual = residual_of(
        fit_joint(record.raw, record.total_field, noise=np.ones((2, 3))), record.raw, record.total_field
    )
    fine, coarse = grams(residual, terms, WHITE, WHITE, 12), grams(residual, terms, WHITE, WHITE, 4)
    for name in ("zz", "zd", "dd", "ze", "de", "ee", "aa", "ar", "rr", "samples"):
        together, own = getattr(fine.merged(4), name), getattr(coarse, name)
        np.testing.assert_allclose(together, own, rtol=1e-9, atol=1e-9 * np.abs(own).max())
    left_out = fine.without_each()
    np.testing.assert_allclose(left_out.dd[3] + fine.dd[3], fine.total().dd[0], rtol=1e-9, atol=1e-9)


def test_samples_left_out_leave_the_rest_as_it_was() -> None:
    record = synthetic(8, samples=100, sensors=2)
    residual = residual_of(
        fit_joint(record.raw, record.total_field, noise=np.ones((2, 3))), record.raw, record.total_field
    )
    few = residual.smaller(np.array([3, 50, 7]))
    assert residual.across is not None and few.across is not None
    np.testing.assert_array_equal(few.across, residual.across[[3, 50, 7]])
    np.testing.assert_array_equal(few.samples, residual.samples[[3, 50, 7]])
    assert replace(few, along=None).freedom == few.freedom - 1


def test_an_error_model_that_gives_no_terms_is_told_and_in_nobodys_way() -> None:
    @error_model("instrument", source="s", typical="t")
    def shapeless(x: Excitation) -> Terms:
        """Gives an array."""
        return np.zeros((3, 4))  # type: ignore[return-value]

    component = component_of(shapeless)
    assert component is not None
    found = search(synthetic(3, samples=200), [component], Fitting())
    assert "gives ndarray" in found.failed["shapeless"] and not found.last.adopted


def test_sets_of_terms_are_scored_together_as_each_is_alone() -> None:
    """Whatever is in already, and in noise of any colour: by the explained sum of squares of a fit to each."""
    record = synthetic(9, samples=300, sensors=3)
    fit = fit_joint(record.raw, record.total_field, noise=np.ones((3, 3)))
    residual, x = residual_of(fit, record.raw, record.total_field), excitation_of(record, fit, record.raw)
    t = np.linspace(-1.0, 1.0, 300)
    given = x.offsets(t**3, "nT")
    several = [
        joined([x.offsets(np.sin(w * t), "nT"), x.matrices(1e-4 * np.cos(w * t)[:, None] * x.field[:, 0], "1")])
        for w in (3.0, 5.0, 7.0)
    ]
    assert several[0].kind == several[2].kind != given.kind
    for adopted in (None, given):
        for colours in (Colours(WHITE, WHITE), colours_of(residual)):
            score = Scorer(residual, adopted, colours)
            alone = None if adopted is None else estimated(residual, adopted, colours)
            for terms, found in zip(several, score.of_each(several), strict=True):
                every = [terms] if adopted is None else [adopted, terms]
                estimate = estimated(residual, joined(every), colours)
                beyond, rank = (
                    (explained(estimate), estimate.rank)
                    if alone is None
                    else (explained(estimate) - explained(alone), estimate.rank - alone.rank)
                )
                assert found == pytest.approx(rarity(beyond, rank), rel=1e-6)
