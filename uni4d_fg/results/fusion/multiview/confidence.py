"""How far matched depth can be trusted, calibrated on scenes with truth.

The probability that depth is right to 3 % is a logistic function of what the matching and the comparison with other
frames say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import Float32Array
from uni4d_fg.results.fusion.multiview.sweep import Swept

_WEIGHTS = np.array([-2.018, 1.241, -2.002, 4.676, -12.241, -0.261, -1.969, 0.015])
_ERROR_PLANES = 0.13
"""Standard deviation of a right match, in planes."""
_FLOOR = 0.002


@dataclass(frozen=True)
class Evidence:
    """What there is to judge depth by, (h, w) each."""

    margin: Float32Array
    match: Float32Array
    at_end: Float32Array
    step: Float32Array
    """Relative depth between two planes."""
    views: int
    agreeing: Float32Array
    """Part of the other frames that see the pixel and agree, 0 to 1; 0 where none sees it."""
    seen: Float32Array
    """Number of frames that see it."""

    @classmethod
    def of(cls, swept: Swept, step: Float32Array, views: int) -> Evidence:
        """Return the evidence of one frame alone."""
        nothing = np.zeros_like(swept.margin)
        return cls(swept.margin, swept.match, swept.at_end, step, views, nothing, nothing)

    def with_neighbors(self, agreeing: Float32Array, seeing: Float32Array) -> Evidence:
        """Return it with the numbers of other frames that agree and that see the pixel."""
        share: Float32Array = np.asarray(agreeing / np.maximum(seeing, 1), dtype=np.float32)
        return replace(self, agreeing=share, seen=seeing)

    def features(self) -> Float32Array:
        """Return (h, w, 8)."""
        m = np.log1p(np.maximum(self.margin, 0) * 10)
        return np.stack(
            [
                np.ones_like(m), m, np.maximum(self.match, 0), self.agreeing, self.at_end,
                np.log(np.clip(self.step, 1e-3, 1.0)), np.minimum(self.seen, 3) / 3, m * self.agreeing,
            ],
            axis=-1,
        ).astype(np.float32)  # fmt: skip


def confidence(evidence: Evidence) -> Float32Array:
    """Return the probability (h, w) that depth is right to 3 %; 0 where there is none."""
    value = evidence.features() @ _WEIGHTS.astype(np.float32)
    probability = 1 / (1 + np.exp(-np.clip(value, -30, 30)))
    out: Float32Array = np.asarray(np.where(np.isfinite(value), probability, 0), dtype=np.float32)
    return out


def relative_sigma(evidence: Evidence) -> Float32Array:
    """Return the standard deviation (h, w) of log depth where it is right."""
    sigma: Float32Array = np.hypot(_ERROR_PLANES * evidence.step, np.float32(_FLOOR))
    return sigma
