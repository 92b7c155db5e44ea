"""From a sequence to a run folder: the stages in order, resumable, each written as it ends."""

from uni4d_fg.pipeline.run import reconstruct
from uni4d_fg.pipeline.summary import RunSummary

__all__ = ["RunSummary", "reconstruct"]
