"""Robust kernels: weight is the derivative of rho, parity with GTSAM, limits, square-root form."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest

from uni4d_fg.errors import SolverError
from uni4d_fg.factors.kernels import Kernel

KERNELS = [
    Kernel("quadratic"),
    *(Kernel(kind, c) for kind in ("huber", "pseudo_huber", "cauchy", "norm") for c in (0.05, 1.345, 20.0)),
]
IDS = [f"{k.kind}-{k.threshold}" for k in KERNELS]
S = np.concatenate([np.geomspace(1e-4, 1e4, 161)])


@pytest.mark.parametrize("kernel", KERNELS, ids=IDS)
def test_weight_is_the_slope_of_rho_over_s(kernel: Kernel) -> None:
    step = 1e-6 * S
    numerical = (kernel.rho((S + step) ** 2) - kernel.rho((S - step) ** 2)) / (2 * step)
    # The difference of two nearly equal rho loses digits where rho is small against its own slope.
    np.testing.assert_allclose(kernel.weight(S**2) * S, numerical, rtol=1e-5)


@pytest.mark.parametrize("kernel", KERNELS, ids=IDS)
def test_rho_grows_and_weight_does_not(kernel: Kernel) -> None:
    assert kernel.rho(np.zeros(1)) == 0.0
    assert (np.diff(kernel.rho(S**2)) > 0).all()
    assert (np.diff(kernel.weight(S**2)) <= 0).all()
    assert np.isfinite(kernel.weight(np.zeros(1))).all()


@pytest.mark.parametrize("kernel", KERNELS, ids=IDS)
def test_falloff_is_how_fast_the_weight_falls(kernel: Kernel) -> None:
    s = S[np.abs(S / kernel.threshold - 1.0) > 1e-4]  # Huber's has a step there
    step = 1e-5 * s
    numerical = -(kernel.weight((s + step) ** 2) - kernel.weight((s - step) ** 2)) / (2e-5 * kernel.weight(s**2))
    np.testing.assert_allclose(kernel.falloff(s**2), np.minimum(numerical, 1.0), rtol=1e-4, atol=1e-8)
    assert kernel.falloff(np.zeros(1)) == 0.0


@pytest.mark.parametrize("c", [0.5, 1.345, 4.0])
@pytest.mark.parametrize("kind", ["huber", "cauchy"])
def test_parity_with_gtsam(kind: str, c: float) -> None:
    estimator = gtsam.noiseModel.mEstimator
    theirs = (estimator.Huber if kind == "huber" else estimator.Cauchy).Create(c)
    ours = Kernel(kind, c)
    np.testing.assert_allclose(ours.rho(S**2), [theirs.loss(s) for s in S], rtol=1e-9)
    np.testing.assert_allclose(ours.weight(S**2), [theirs.weight(s) for s in S], rtol=1e-12)


@pytest.mark.parametrize("kind", ["huber", "pseudo_huber", "cauchy"])
def test_small_residuals_and_large_thresholds_are_quadratic(kind: str) -> None:
    s = np.array([0.1, 1.0, 3.0])
    kernel = Kernel(kind, 1e6)
    np.testing.assert_allclose(kernel.rho(s**2), 0.5 * s**2, rtol=1e-10)
    np.testing.assert_allclose(kernel.weight(s**2), 1.0, rtol=1e-10)


def test_large_residuals_have_the_stated_slope() -> None:
    s = np.array([1e6])
    np.testing.assert_allclose(Kernel("huber", 2.0).weight(s**2) * s, 2.0)
    np.testing.assert_allclose(Kernel("pseudo_huber", 2.0).weight(s**2) * s, 2.0, rtol=1e-9)
    np.testing.assert_allclose(Kernel("norm", 1e-3).weight(s**2) * s, 1.0, rtol=1e-9)


def test_norm_tends_to_the_unsquared_norm() -> None:
    s = np.array([0.0, 1e-3, 0.5, 7.0])
    for c in (1e-2, 1e-4, 1e-6):
        difference = s - Kernel("norm", c).rho(s**2)
        assert (difference >= -1e-15).all()
        assert (difference <= c).all()


def test_pseudo_huber_keeps_digits_near_zero() -> None:
    np.testing.assert_allclose(Kernel("pseudo_huber", 1.0).rho(np.array([1e-20])), [5e-21], rtol=1e-12)
    np.testing.assert_allclose(Kernel("norm", 1.0).rho(np.array([1e-20])), [5e-21], rtol=1e-12)


@pytest.mark.parametrize("kernel", KERNELS, ids=IDS)
def test_square_root_form(kernel: Kernel) -> None:
    a, slope = kernel.square_root(S**2)
    np.testing.assert_allclose(0.5 * (a * S) ** 2, kernel.rho(S**2), rtol=1e-12)
    s = np.geomspace(1e-2, 1e3, 101) * (1 + 1e-7)
    step = 1e-5 * s
    numerical = (kernel.square_root((s + step) ** 2)[0] - kernel.square_root((s - step) ** 2)[0]) / (2 * step)
    a, slope = kernel.square_root(s**2)
    np.testing.assert_allclose(slope * s, numerical, rtol=1e-4, atol=1e-9 * (a / s).max())


@pytest.mark.parametrize("kernel", KERNELS, ids=IDS)
def test_square_root_form_is_finite_at_zero(kernel: Kernel) -> None:
    a, slope = kernel.square_root(np.array([0.0, 1e-300, 1e-30, 1e-13, 1e-12, 1e-11]))
    assert np.isfinite(a).all()
    assert np.isfinite(slope).all()
    expected = np.sqrt(kernel.weight(np.zeros(1)))
    np.testing.assert_allclose(a[0], expected[0], rtol=1e-9)
    # Bounded by the curvature at zero: no amplified rounding just above the switch to zero.
    limit = 2.0 / min(kernel.threshold, 1.0) ** 2.5 if kernel.kind != "quadratic" else 1e-12
    assert (np.abs(slope) <= limit).all()


@pytest.mark.parametrize(
    ("kind", "threshold", "said"),
    [
        ("hubber", 1.0, "there is no kernel 'hubber'; choose one of quadratic, huber, pseudo_huber, cauchy, norm"),
        (None, 1.0, "there is no kernel None"),
        *(("huber", wrong, "finite and positive, got") for wrong in (-1, 0.0, np.nan, np.inf, "1", None)),
    ],
)
def test_a_kernel_that_cannot_be_is_refused_where_it_is_made(kind: Any, threshold: Any, said: str) -> None:
    with pytest.raises(SolverError, match=said):
        Kernel(kind, threshold)


def test_thresholds_may_be_any_real_number() -> None:
    for threshold in (1, 0.5, np.float32(0.5), np.int64(2)):
        assert Kernel("huber", threshold).threshold == threshold
