"""The finished run that the tests of results look at."""

from viewing_samples import finished_run

__all__ = ["finished_run"]
