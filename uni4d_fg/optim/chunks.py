"""Cutting a problem into chunks of landmarks and the factors that read them.

Planned once per solve: which rows of each batch belong to which chunk, sorted so that rows of the same
camera variables are consecutive, and where their products go.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, IntArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.layout import DenseLayout
from uni4d_fg.optim.problem import Problem

_CHUNK_LANDMARKS = 512
_CHUNK_ROWS = 16384
"""Rows of a batch that are processed together when nothing is eliminated."""


@dataclass(frozen=True)
class Span:
    """A range of rows of one camera variable that a chunk's landmarks couple to."""

    variable: VariableType
    first: int
    count: int
    dim: int


@dataclass(frozen=True)
class CouplingTarget:
    """Where the landmark-camera products of one slot go."""

    span: int
    row: IntArray
    """(rows,) row within the span."""
    start: int
    """First column of the slot in the batch's concatenated camera Jacobian."""
    stop: int
    unique: bool
    """No two rows share both the landmark and the camera variable."""


@dataclass(frozen=True)
class BatchPart:
    """The rows of one batch that belong to one chunk."""

    batch: FactorBatch
    camera_slots: tuple[int, ...]
    landmark_slot: int | None
    run_start: IntArray
    """First row of each run of rows with the same camera variables, plus the end."""
    columns: IntArray
    """(runs, D) position of each run's camera variables among the chunk's ``camera_columns``."""
    distinct_columns: bool
    """No run has a column twice."""
    landmark: IntArray
    """(rows,) landmark within the chunk; empty without a landmark slot."""
    coupling: tuple[CouplingTarget, ...]


@dataclass(frozen=True)
class Chunk:
    """A set of landmarks (possibly none) with the factors that read them."""

    landmarks: IntArray
    parts: tuple[BatchPart, ...]
    spans: tuple[Span, ...]
    span_columns: IntArray
    camera_columns: IntArray


def plan_chunks(
    problem: Problem, layout: DenseLayout, eliminate: VariableType | None, num_landmarks: int
) -> list[Chunk]:
    """Cut a problem into chunks: landmarks ordered by the first frame that sees them, then the other factors."""
    chunks = []
    if eliminate is not None:
        free = np.asarray(problem.free[eliminate].all(axis=1))
        of_landmark = _order_landmarks(problem, layout, eliminate, num_landmarks, free)
        rows = [_rows_by_landmark(batch, eliminate, num_landmarks) for batch in problem.batches]
        for landmarks in of_landmark:
            taken = [
                (batch, _take(by_landmark, landmarks))
                for batch, by_landmark in zip(problem.batches, rows, strict=True)
                if by_landmark is not None
            ]
            chunks.append(_chunk(taken, layout, eliminate, landmarks, num_landmarks))
        frozen = np.flatnonzero(~free)
    for batch in problem.batches:
        slot = next((s for s in batch.slots if s.variable == eliminate), None)
        rest = np.arange(len(batch)) if slot is None else np.flatnonzero(np.isin(slot.rows, frozen))
        camera = [s.rows for s in batch.slots if s.variable in layout.offset]
        if len(rest) == 0 or not camera:
            continue
        rest = rest[np.lexsort([rows[rest] for rows in reversed(camera)])]
        for start in range(0, len(rest), _CHUNK_ROWS):
            piece = [(batch, rest[start : start + _CHUNK_ROWS])]
            chunks.append(_chunk(piece, layout, None, np.zeros(0, dtype=np.int64), 0))
    return chunks


def _order_landmarks(
    problem: Problem, layout: DenseLayout, eliminate: VariableType, count: int, free: BoolArray
) -> list[IntArray]:
    first = np.full(count, np.iinfo(np.int64).max)
    for batch in problem.batches:
        landmark = next((s for s in batch.slots if s.variable == eliminate), None)
        if landmark is None:
            continue
        for slot in batch.slots:
            if layout.count.get(slot.variable, 0) > 1:
                np.minimum.at(first, landmark.rows, slot.rows)
    order = np.argsort(first, kind="stable")
    order = order[free[order]]
    return [order[i : i + _CHUNK_LANDMARKS] for i in range(0, len(order), _CHUNK_LANDMARKS)]


def _rows_by_landmark(batch: FactorBatch, eliminate: VariableType, count: int) -> tuple[IntArray, IntArray] | None:
    """Return the batch's rows sorted by landmark, and the first position of each landmark."""
    slot = next((s for s in batch.slots if s.variable == eliminate), None)
    if slot is None or len(batch) == 0:
        return None
    order = np.argsort(slot.rows, kind="stable")
    return order, np.searchsorted(slot.rows[order], np.arange(count + 1))


def _take(by_landmark: tuple[IntArray, IntArray], landmarks: IntArray) -> IntArray:
    """Return the rows of the given landmarks."""
    order, start = by_landmark
    lengths = start[landmarks + 1] - start[landmarks]
    offsets = np.repeat(start[landmarks] - np.r_[0, np.cumsum(lengths)[:-1]], lengths)
    result: IntArray = order[offsets + np.arange(int(lengths.sum()))]
    return result


def _chunk(
    pieces: list[tuple[FactorBatch, IntArray]],
    layout: DenseLayout,
    eliminate: VariableType | None,
    landmarks: IntArray,
    num_landmarks: int,
) -> Chunk:
    local = np.full(num_landmarks, -1)
    local[landmarks] = np.arange(len(landmarks))
    batches = [batch.take(rows) for batch, rows in pieces if len(rows)]
    spans = _spans(batches, layout) if eliminate is not None else ()
    used: list[IntArray] = [np.zeros(0, dtype=np.int64)]
    for batch in batches:
        used += [layout.columns(s.variable, s.rows).reshape(-1) for s in batch.slots if s.variable in layout.offset]
    camera_columns = np.unique(np.concatenate(used))
    parts = tuple(_part(batch, layout, eliminate, local, spans, camera_columns) for batch in batches)
    span_columns = [
        layout.columns(span.variable, np.arange(span.first, span.first + span.count)).reshape(-1) for span in spans
    ]
    columns = np.concatenate([np.zeros(0, dtype=np.int64), *span_columns])
    return Chunk(landmarks, parts, spans, columns, camera_columns)


def _spans(batches: list[FactorBatch], layout: DenseLayout) -> tuple[Span, ...]:
    spans = []
    for variable in layout.offset:
        rows = [s.rows for batch in batches for s in batch.slots if s.variable == variable]
        if rows:
            first = min(int(r.min()) for r in rows)
            last = max(int(r.max()) for r in rows)
            spans.append(Span(variable, first, last - first + 1, variable.dim))
    return tuple(spans)


def _part(
    batch: FactorBatch,
    layout: DenseLayout,
    eliminate: VariableType | None,
    local: IntArray,
    spans: tuple[Span, ...],
    camera_columns: IntArray,
) -> BatchPart:
    camera_slots = tuple(i for i, s in enumerate(batch.slots) if s.variable in layout.offset)
    landmark_slot = next((i for i, s in enumerate(batch.slots) if s.variable == eliminate), None)
    if camera_slots:
        batch = batch.take(np.lexsort([batch.slots[i].rows for i in reversed(camera_slots)]))
    empty = np.zeros(0, dtype=np.int64)
    landmark = local[batch.slots[landmark_slot].rows] if landmark_slot is not None else empty
    rows = np.stack([batch.slots[i].rows for i in camera_slots] or [np.zeros(len(batch), dtype=np.int64)], axis=1)
    new_run = np.flatnonzero(np.r_[True, (np.diff(rows, axis=0) != 0).any(axis=1)])
    dense = [layout.columns(batch.slots[i].variable, batch.slots[i].rows[new_run]) for i in camera_slots]
    columns = np.searchsorted(
        camera_columns, np.concatenate([*dense, np.zeros((len(new_run), 0), dtype=np.int64)], axis=1)
    )
    distinct = not (np.diff(np.sort(columns, axis=1), axis=1) == 0).any()
    coupling = []
    if landmark_slot is not None:
        start = 0
        for i in camera_slots:
            slot = batch.slots[i]
            span = next(n for n, s in enumerate(spans) if s.variable == slot.variable)
            row = slot.rows - spans[span].first
            pair = landmark * spans[span].count + row
            stop = start + slot.variable.dim
            coupling.append(CouplingTarget(span, row, start, stop, len(np.unique(pair)) == len(pair)))
            start = stop
    run_start = np.r_[new_run, len(batch)]
    return BatchPart(batch, camera_slots, landmark_slot, run_start, columns, distinct, landmark, tuple(coupling))
