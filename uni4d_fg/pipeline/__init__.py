"""From a sequence to a run folder, in one batch, in windows or as a stream; comparisons of solvers.

Each stage is written as it ends, and a run that was stopped is resumed.
"""

from uni4d_fg.pipeline.run import reconstruct
from uni4d_fg.pipeline.summary import RunSummary

__all__ = ["RunSummary", "reconstruct"]
