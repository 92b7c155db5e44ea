// The factors that read a landmark, sorted once so that every later pass runs over them in order.
//
// Landmarks are ordered by the first frame that sees them and cut into chunks of 64. Within a chunk, an observation
// is a pair (frame, landmark) with one coupling block however many factors read it; pairs are ordered by frame. The
// factors of a pair are merged into records of at most one reprojection and one depth factor; eight records of one
// frame and of the same batches form a group, one per lane.
#pragma once

#include <cstdint>
#include <vector>

#include "uni4d_fg/robust.hpp"
#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

constexpr int kChunkLandmarks = 64;

/// Arrays of one batch; they are read while planning only.
struct LandmarkBatch {
  std::int64_t count = 0;
  const std::int64_t* pose = nullptr;      ///< (count,)
  const std::int64_t* landmark = nullptr;  ///< (count,)
  const double* measured = nullptr;        ///< (count, 2) uv in px, or (count,) depth in m
  const double* sigma = nullptr;           ///< (count,) or (count, 2)
  int sigma_columns = 1;
  const double* weight = nullptr;  ///< (count,)
  Kernel kernel;
};

/// A bundle adjustment with shared intrinsics and one log-scale per frame.
struct LandmarkProblem {
  std::vector<LandmarkBatch> reprojection;
  std::vector<LandmarkBatch> depth;
  int num_frames = 0;
  int num_landmarks = 0;
  std::vector<std::uint8_t> landmark_free;  ///< (num_landmarks,)
  /// (num_frames, 7) column of each pose entry and log-scale in the camera system, -1 if frozen; ascending.
  std::vector<int> columns;
  int num_columns = 0;
  /// Whether intrinsics and log-scales have columns: their blocks are left out otherwise.
  bool intrinsics_free = false;
  /// Rows stored per column of the camera system: num_columns when dense, else the bandwidth and 1.
  int stored_rows = 0;
  bool banded = false;
};

/// Eight records of one frame.
struct RecordGroup {
  int frame;
  int reprojection;  ///< batch whose kernel applies
  int depth;
  int used;    ///< lanes that hold a record
  bool first;  ///< these are the first records of their pairs
};

/// Fields of a group's data, eight lanes each. An absent factor has weight and inverse sigma 0.
enum Field { kU, kV, kInverseSigmaU, kInverseSigmaV, kWeight, kLogDepth, kInverseSigmaDepth, kDepthWeight, kFields };

struct LandmarkChunk {
  bool frozen = false;
  std::vector<int> landmarks;               ///< row of each, at most 64
  std::vector<int> frames;                  ///< frames that see any of them, ascending
  std::vector<std::uint64_t> seen;          ///< per frame, bit per landmark
  std::vector<int> frame_begin;             ///< first pair of each frame, plus the end
  std::vector<std::uint8_t> pair_landmark;  ///< (pairs,) index among `landmarks`
  std::int64_t first_pair = 0;              ///< of this chunk among all
  std::vector<RecordGroup> groups;
  AlignedDoubles data;                      ///< (groups, kFields, 8)
  std::vector<std::uint8_t> lane_landmark;  ///< (groups, 8)
  std::vector<int> lane_pair;               ///< (groups, 8) pair within the chunk
  double cost = 0.0;                        ///< of eliminating it, in tile products

  int num_pairs() const { return static_cast<int>(pair_landmark.size()); }
};

struct LandmarkPlan {
  std::vector<LandmarkChunk> chunks;
  std::int64_t num_pairs = 0;  ///< of free landmarks
  /// (parts + 1) first chunk of each part, of about equal cost. Sums are those of the parts, added in their order, and
  /// parts depend on the problem alone: results do not depend on the number of threads.
  std::vector<int> part_begin;

  int num_parts() const { return static_cast<int>(part_begin.size()) - 1; }
};

/// Sort and cut, on up to `threads` threads.
LandmarkPlan plan_landmarks(const LandmarkProblem& problem, int threads);

}  // namespace uni4d_fg
