"""Cholesky's factorization of large dense systems on several threads, of which no result depends on their number.

BLAS splits its sums by the number of threads. Here tiles of fixed size are what threads divide among themselves, and
each of a tile's products is one thread's.
"""

from __future__ import annotations

from functools import partial

from scipy.linalg import blas, lapack

from uni4d_fg.arrays import FloatArray
from uni4d_fg.optim.threads import map_in_order, one_blas_thread

TILE = 256
"""Rows and columns of a tile: products of tiles are then as fast as BLAS is."""

TILED_SIZE = 2500
"""Smaller systems are left to LAPACK on one thread, which is as fast there as two threads with tiles."""


def cholesky(matrix: FloatArray, threads: int) -> FloatArray | None:
    """Return the factor L of a symmetric matrix, matrix = L L^T; None if it is not positive definite.

    The columns of L are found from left to right, a tile's width at a time ("left-looking"; Golub and Van Loan, "Matrix
    Computations", 4.2): what the columns before take from them is one product with a long inner dimension.

    Args:
        matrix: (n, n) in Fortran's order, of which the lower triangle is read. It is overwritten.
        threads: Threads to use; the result is the same for any number.

    Returns:
        (n, n) in Fortran's order; what stands above the diagonal means nothing.
    """
    with one_blas_thread():
        if len(matrix) < TILED_SIZE:
            factor, info = lapack.dpotrf(matrix, lower=1, overwrite_a=1, clean=0)
            return factor if info == 0 else None
        for start in range(0, len(matrix), TILE):
            columns = slice(start, start + TILE)
            before = matrix[columns, :start]
            corner, info = lapack.dpotrf(matrix[columns, columns] - before @ before.T, lower=1, clean=0)
            if info != 0:
                return None
            matrix[columns, columns] = corner
            below = list(range(start + TILE, len(matrix), TILE))
            map_in_order(partial(_finish_tile, matrix, columns), below, threads)
    return matrix


def _finish_tile(matrix: FloatArray, columns: slice, row: int) -> None:
    """Find L in the tile of some columns that begins at a row below the diagonal."""
    rows, before = slice(row, row + TILE), slice(0, columns.start)
    rest = matrix[rows, columns] - matrix[rows, before] @ matrix[columns, before].T
    matrix[rows, columns] = blas.dtrsm(1.0, matrix[columns, columns], rest, side=1, lower=1, trans_a=1)
