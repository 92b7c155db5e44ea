"""How much the scale of a video's depth maps changes from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uni4d_fg.arrays import FloatArray


@dataclass(frozen=True)
class ScaleFlicker:
    """Spread of s_t, the median of log(prediction / truth) over the static valid pixels of frame t."""

    standard_deviation: float | None
    """Of s_t about its mean over the frames scored; None without any."""
    frame_to_frame: float | None
    """Standard deviation of s_{t+1} - s_t, of neighboring frames that are both scored; None without any."""
    log_scales: tuple[float | None, ...]
    """s_t per frame; None where a frame has no static valid pixel."""
    frames_scored: int
    """Frames with an s_t."""


@dataclass
class FlickerAccumulator:
    """Collects one s_t per frame, in order."""

    log_scales: list[float] = field(default_factory=list)

    def add(self, log_ratios: FloatArray) -> None:
        """Add one frame: log(prediction / truth) of its static valid pixels (N,), N may be 0."""
        self.log_scales.append(float(np.median(log_ratios)) if log_ratios.size else float("nan"))

    def result(self) -> ScaleFlicker:
        """Return the spread of what was added."""
        scales = np.array(self.log_scales, dtype=np.float64)
        known = scales[np.isfinite(scales)]
        steps = np.diff(scales)
        steps = steps[np.isfinite(steps)]
        return ScaleFlicker(
            standard_deviation=float(known.std()) if len(known) else None,
            frame_to_frame=float(steps.std()) if len(steps) else None,
            log_scales=tuple(float(s) if np.isfinite(s) else None for s in scales),
            frames_scored=len(known),
        )
