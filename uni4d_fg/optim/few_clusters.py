r"""A covariance from few clusters, steadied by the shape that independent errors would give.

Some twenty clusters say well how large errors are, and badly how they are correlated: of a sample covariance of six
dimensions the small eigenvalues come out too small, so that the mean squared error normalized by it is 1.6 times what
it should be. Let x_g be the displacement of a pose that cluster g causes, S their sum of squares and F the covariance
of the same part of the errors were they independent, both whitened by the model's own covariance. With

    mu = tr S / tr F                            how much less information there is than independent errors would leave,
    V  = E ||S - E S||^2                        from the scatter of the single x_g x_g^T,
    lambda = min(1, V / ||S - mu F||^2)         what of their distance is sampling error,
    n  = (tr(S)^2 + tr(S^2)) / V                samples that S is worth,

the covariance is f ((1 - lambda) S + lambda mu F): many clusters that disagree with the model are believed, few that
scatter about it are not. The factor f = n' / (n' - 7), n' = n / (1 - lambda)^2, makes the normalized squared error of
six dimensions right on average in spite of the sampling error that is left. Sums are taken over all poses.
Source: Ledoit and Wolf 2004, "A well-conditioned estimator for large-dimensional covariance matrices"; the mean of an
inverse Wishart matrix for f.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray

_LARGEST_FACTOR = 2.5
"""Of f: with fewer samples than this stands for, a mean does not exist."""


@dataclass(frozen=True)
class Blend:
    """Weights of the two covariances of the errors that clusters share."""

    clusters: float
    """Of the sum over clusters."""
    model: float
    """Of the covariance with independent errors."""
    inflation: float
    """mu: the variance of a pose as a multiple of what independent errors would give."""
    share: float
    """lambda in [0, 1]."""


def blend(influence: FloatArray, model: FloatArray, rest: FloatArray) -> Blend:
    """Return how much to believe the clusters and how much the model.

    Args:
        influence: (G, T, d) displacement of each pose that each cluster causes; sums of squares over clusters are the
            covariance.
        model: (T, d, d) covariance of the poses with independent errors.
        rest: (T, d, d) the part of it that factors without clusters make up.
    """
    moves = np.flatnonzero(np.einsum("tii->ti", model).min(axis=1, initial=np.inf) > 0.0)
    nothing = Blend(1.0, 0.0, 1.0, 0.0)
    if len(moves) == 0:
        return nothing
    dim = model.shape[1]
    root = _cholesky(model[moves])
    if root is None:
        return nothing
    white = np.linalg.solve(root, np.moveaxis(influence[:, moves], 0, -1))
    sampled = white @ np.swapaxes(white, 1, 2)
    inverse = np.linalg.inv(root)
    target = np.eye(dim) - inverse @ rest[moves] @ np.swapaxes(inverse, 1, 2)
    inflation = float(np.einsum("tii->", sampled) / max(float(np.einsum("tii->", target)), 1e-300))
    # sum_g ||x_g x_g^T - S / G||^2 = sum_g |x_g|^4 - ||S||^2 / G
    count = int(np.any(influence != 0.0, axis=(1, 2)).sum())
    fourth = float(np.sum(np.sum(white**2, axis=1) ** 2))
    squared = float(np.sum(sampled**2))
    variance = (fourth - squared / max(count, 1)) * count / max(count - 1, 1)
    distance = float(np.sum((sampled - inflation * target) ** 2))
    share = float(np.clip(variance / max(distance, 1e-300), 0.0, 1.0))
    samples = (float(np.sum(np.einsum("tii->t", sampled) ** 2)) + squared) / max(variance, 1e-300)
    factor = _small_sample_factor(samples / max((1.0 - share) ** 2, 1e-12), dim)
    return Blend(factor * (1.0 - share), factor * share * inflation, inflation, share)


def _small_sample_factor(samples: float, dim: int) -> float:
    """Return n / (n - d - 1), the mean of the inverse of a sample covariance of n samples, bounded."""
    room = samples - dim - 1.0
    return min(samples / room, _LARGEST_FACTOR) if room > 0.0 else _LARGEST_FACTOR


def _cholesky(matrices: FloatArray) -> FloatArray | None:
    try:
        return np.asarray(np.linalg.cholesky(matrices), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
