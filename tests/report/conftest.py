"""The finished run that the tests report about: the same as for the viewer."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "view"))

from viewing_samples import finished_run

__all__ = ["finished_run"]
