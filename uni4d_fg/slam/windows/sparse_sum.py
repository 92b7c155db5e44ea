"""Normal equations of windows with added factors, which tie frames anywhere: one sparse matrix."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.errors import SolverError
from uni4d_fg.slam.windows.added_terms import Entries
from uni4d_fg.slam.windows.information import UNDETERMINED, WindowInformation


class SparseSum:
    """Factorization of a sum of symmetric matrices on the free columns.

    Args:
        information: Of every window.
        matrices: (n, n) per window, on its columns.
        added: Further entries.
        free: (size,) columns that are not held.

    Raises:
        SolverError: If the matrix is singular.
    """

    def __init__(
        self,
        information: list[WindowInformation],
        matrices: list[FloatArray],
        added: Iterable[Entries],
        free: BoolArray,
    ) -> None:
        num_frames, self.free = information[-1].window.stop, np.flatnonzero(free)
        entries = list(added)
        for part, matrix in zip(information, matrices, strict=True):
            columns = part.columns(num_frames)
            entries.append((np.repeat(columns, len(columns)), np.tile(columns, len(columns)), matrix.reshape(-1)))
        rows, columns, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        whole = scipy.sparse.csc_matrix((values, (rows, columns)), shape=(len(free), len(free)))
        try:
            self._factors = scipy.sparse.linalg.splu(
                whole[self.free][:, self.free].tocsc(),
                permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True},
            )  # fmt: skip
        except RuntimeError as error:
            raise SolverError(UNDETERMINED) from error

    def solve(self, sides: FloatArray) -> FloatArray:
        """Return the solutions (m, size) of right-hand sides (m, size); zero in columns that are held."""
        solved = np.zeros_like(sides)
        solved[:, self.free] = self._factors.solve(np.ascontiguousarray(sides[:, self.free].T)).T
        return solved
