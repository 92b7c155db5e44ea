// The hot loops of the landmark system, a chunk at a time; compiled for several processors.
#pragma once

#include "uni4d_fg/landmark_system.hpp"

namespace uni4d_fg::landmark_passes {

struct PassInput {
  LandmarkState state;
  const Kernel* reprojection_kernels;
  const Kernel* depth_kernels;
};

/// Doubles of a coupling block (3, 8) and of a landmark's sums.
constexpr int kWidth = 24;

/// Add a chunk's energies, a lane each, to (batches, 8) sums.
void energies_plain(const PassInput& in, const LandmarkChunk& chunk, double* reprojection);
void energies_depth(const PassInput& in, const LandmarkChunk& chunk, double* reprojection, double* depth);

/// Add a chunk's products to the sums of its frames; write its coupling blocks (pairs, 24) and landmarks (N, 24).
using Linearize = void (*)(const PassInput& in, const LandmarkChunk& chunk, double* frame_sums, double* coupling,
                           double* landmarks);
void linearize_plain(const PassInput&, const LandmarkChunk&, double*, double*, double*);
void linearize_depth(const PassInput&, const LandmarkChunk&, double*, double*, double*);
void linearize_intrinsics(const PassInput&, const LandmarkChunk&, double*, double*, double*);
void linearize_depth_intrinsics(const PassInput&, const LandmarkChunk&, double*, double*, double*);

/// Move each free landmark of a chunk, of landmarks (N, 3), by up to `iterations` steps under resting cameras; no step
/// raises its energy.
void settle_points(const PassInput& in, const LandmarkChunk& chunk, const DampingBounds& bounds, int iterations,
                   double* landmarks);
void settle_points_with_depth(const PassInput& in, const LandmarkChunk& chunk, const DampingBounds& bounds,
                              int iterations, double* landmarks);

/// Rows L^{-1} E^T of a chunk's pairs, (pairs, 3, 8), from its coupling blocks and its landmarks' factors (64, 6).
void whiten_pairs(const LandmarkChunk& chunk, const double* coupling, const double* factors, double* whitened);

/// Add the tile products of a chunk.
struct TileInput {
  const double* whitened;          ///< (pairs, 3, 8)
  const double* border;            ///< (64, 3, 8): whitened intrinsics rows 0..3 and gradient 4 of each landmark
  const int* place;                ///< (frames, 64) pair of a frame and landmark
  const std::int64_t* tile_begin;  ///< per frame of the sequence
  double* tiles;                   ///< tile (i, j) at tile_begin[i] + j - i
  double* border_tiles;            ///< (T, 7, 8), and one more for the border with itself
  double* corner_tile;
};
void multiply_tiles(const LandmarkChunk& chunk, const TileInput& in);
/// Doubles of a frame's row of L^{-1} E^T where only log-scales are free: three per landmark.
constexpr int kScaleRow = 3 * kChunkLandmarks;
/// The same for cameras that are frozen but for their log-scales, from the coupling blocks of the chunk and its
/// landmarks' factors (64, 6); `rows` (frames, kScaleRow) is scratch, `in.whitened` and `in.place` are not read.
void multiply_scales(const LandmarkChunk& chunk, const double* coupling, const double* factors, double* rows,
                     const TileInput& in);

/// E^T d of a chunk's landmarks: add to (64, 3).
void apply_coupling(const LandmarkChunk& chunk, const double* coupling, const double* frame_step, double* out);

}  // namespace uni4d_fg::landmark_passes
