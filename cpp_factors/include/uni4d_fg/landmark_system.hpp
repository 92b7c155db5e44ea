// The landmark Schur complement of bundle adjustment: linearize, eliminate the landmarks, back-substitute.
//
//     [ H_cc  E ] [d_c]     [g_c]
//     [ E^T   V ] [d_l] = - [g_l]        S = H_cc - E V^{-1} E^T,  V block-diagonal with 3x3 blocks
//
// The camera system has the free entries of (pose, log-scale) frame by frame, its core, bordered by the four
// intrinsics. The core is stored like LAPACK's lower triangle: entry (i, j), i >= j, of a dense core stands at
// j * rows + i, of a banded one at j * rows + (i - j). The source of the algorithm is Triggs et al. 2000, "Bundle
// adjustment - a modern synthesis"; damping is Marquardt's, on the clamped diagonal, before the elimination.
#pragma once

#include <algorithm>
#include <vector>

#include "uni4d_fg/landmark_plan.hpp"

namespace uni4d_fg {

/// Values of the variables; shapes as in the Python package.
struct LandmarkState {
  const double* world_T_cam;  ///< (T, 4, 4)
  const double* intrinsics;   ///< (4,) px
  const double* log_scale;    ///< (T,); not read without depth batches
  const double* landmarks;    ///< (N, 3) m
};

struct DampingBounds {
  double damping, min_diagonal, max_diagonal;
};

/// A camera system with n core columns, in storage of the caller.
struct CameraSystem {
  double* core;      ///< (n, stored rows)
  double* border;    ///< (n, 4)
  double* corner;    ///< (4, 4)
  double* gradient;  ///< (n + 4,)
};

struct LinearizeResult {
  double landmark_gradient_max = 0.0;  ///< over free landmarks
  bool finite = true;
};

/// The sums over landmarks that the norm of a step and the decrease it predicts need.
struct StepSums {
  double slope = 0.0;    ///< g_l . d_l
  double damped = 0.0;   ///< d_l . D_l d_l, D the clamped diagonal
  double squared = 0.0;  ///< d_l . d_l
};

constexpr int kFrameColumns = 7;
constexpr int kBorder = 4;

class LandmarkSystem {
 public:
  /// Plan once; no result depends on the number of `threads`. The arrays of the batches are not read afterwards.
  /// Throws std::invalid_argument if frames that share a landmark are further apart than the stored rows.
  LandmarkSystem(LandmarkProblem problem, int threads);

  int num_batches() const { return num_reprojection_ + num_depth_; }
  std::int64_t num_pairs() const { return plan_.num_pairs; }
  const LandmarkProblem& problem() const { return problem_; }

  /// Energy of every batch, reprojection batches first, into `out` (num_batches,).
  void energies(const LandmarkState& state, double* out) const;

  /// Move every free landmark towards its own minimum under resting cameras, by up to `iterations` steps of which none
  /// raises its energy: `landmarks` (N, 3) become those of `state`, moved. Factors that the system was not given are
  /// not looked at; the damping of `bounds` is not read.
  void settle_landmarks(const LandmarkState& state, const DampingBounds& bounds, int iterations,
                        double* landmarks) const;

  /// Write the normal equations of the cameras (all of `system` is overwritten); keep those of the landmarks.
  LinearizeResult linearize(const LandmarkState& state, const CameraSystem& system);

  /// Landmark blocks V (N, 3, 3) and gradients (N, 3) of the last linearization.
  void landmark_blocks(double* blocks, double* gradients) const;

  /// Add to the landmark blocks and gradients of the last linearization what factors of other types contribute:
  /// V_l += blocks (count, 3, 3), of which the symmetric part is taken, and g_l += gradients (count, 3) for
  /// l = rows (count,), which may repeat and must be free. Returns the largest gradient entry over free landmarks.
  double add_to_landmarks(std::int64_t count, const std::int64_t* rows, const double* blocks, const double* gradients);

  /// Add to the coupling E of the last linearization: blocks (count, 3, 7), J_l^T J of landmark rows[i] with the six
  /// pose entries and the log-scale of frames[i]. Pairs may repeat, must be of free landmarks, and of a factor that the
  /// problem has, be its weight 0: for others no storage is planned. Throws std::invalid_argument for any other pair.
  void add_to_coupling(std::int64_t count, const std::int64_t* frames, const std::int64_t* rows, const double* blocks);

  /// Eliminate the landmarks of the last linearization.
  ///
  /// `hessian` is H_cc with everything that else reads the cameras; `reduced` becomes S with its gradient replaced
  /// by the right-hand side -g_c + E V^{-1} g_l. Returns false if a damped landmark block is not positive definite.
  bool reduce(const DampingBounds& bounds, const CameraSystem& hessian, const CameraSystem& reduced);

  /// Whitened coupling (count, 3, n + 5) of free landmarks `rows` after a successful `reduce`: L^{-1} E^T over the core
  /// columns and the four intrinsics, then L^{-1} g_l, with V + damping D = L L^T.
  ///
  /// With it the caller adds a coupling F to other variables to E, for which no storage is planned here: the reduced
  /// system changes by -(E_l V^{-1} F_l^T + F_l V^{-1} E_l^T + F_l V^{-1} F_l^T) and its right-hand side by F_l V^{-1}
  /// g_l.
  void whitened_coupling(std::int64_t count, const std::int64_t* rows, double* out);

  /// L^{-1} (count, 3, 3) of free landmarks `rows` after a successful `reduce`.
  void inverse_factors(std::int64_t count, const std::int64_t* rows, double* out) const;

  /// Landmark steps (N, 3), 0 for frozen ones, for a camera step d_c (n + 4,), after a successful `reduce`:
  /// d_l = -V^{-1} (E^T d_c + g_l + extra_l). `extra` (N, 3), or null, is what couplings that are not in E add.
  StepSums back_substitute(const double* camera_step, const double* extra, double* landmark_step) const;

  bool linearized() const { return linearized_; }
  bool reduced() const { return reduced_; }

 private:
  /// The sums over some of the chunks, and the scratch memory of a thread.
  struct Part;
  struct Scratch;

  Part make_part(int index) const;
  void check_storage(const std::vector<int>& last_frame) const;
  void write_camera_blocks(const CameraSystem& system) const;
  void write_reduced(const DampingBounds& bounds, const CameraSystem& hessian, const CameraSystem& reduced) const;
  bool eliminate_chunk(const LandmarkChunk& chunk, const DampingBounds& bounds, Part& part, Scratch& scratch);
  double* core_column(const CameraSystem& system, int column) const;
  int workers() const { return std::min(threads_, plan_.num_parts()); }
  /// Call f(part, worker) for the number of every part, in order on each of the workers.
  template <typename F>
  void for_parts(F f) const;
  /// Call f(chunk) for the chunks of a part.
  template <typename F>
  void for_chunks(std::size_t part, F f) const;

  void index_pairs();

  LandmarkProblem problem_;
  int threads_;
  std::vector<Kernel> reprojection_kernels_, depth_kernels_;
  int num_reprojection_ = 0, num_depth_ = 0;
  bool poses_free_ = false;  ///< any entry of any pose
  LandmarkPlan plan_;
  /// (pairs, 3, 8) rows of E^T of a pair: six pose entries, log-scale, 0.
  AlignedDoubles coupling_;
  /// (N, 24) per landmark: V as xx xy xz yy yz zz, gradient 3, coupling to the intrinsics (3, 4), 3 unused.
  AlignedDoubles landmarks_;
  /// (N, 6) Cholesky factor of the damped V: 1/l00, l10, 1/l11, l20, l21, 1/l22.
  std::vector<double> factors_;
  DampingBounds bounds_{0.0, 0.0, 0.0};
  std::vector<Part> parts_;
  std::vector<Scratch> scratch_;  ///< per worker
  /// Pairs of every free landmark, in the order of their frames; made when first asked for.
  struct LandmarkPair {
    std::int64_t pair;
    int frame;
  };
  std::vector<std::int64_t> pairs_begin_, pairs_end_;  ///< (N,)
  std::vector<LandmarkPair> pairs_of_landmark_;
  bool linearized_ = false, reduced_ = false;
};

struct LandmarkSystem::Part {
  /// Frames [begin, end) that see landmarks of these chunks, and their sums (end - begin, kSums, 8) over the records of
  /// a frame, a lane each.
  int frames_begin = 0, frames_end = 0;
  AlignedDoubles frame_sums;
  /// Tile (i, j) of E V^{-1} E^T, frames i <= j, is needed if a landmark of these chunks is seen in both. Row i has
  /// tiles for j = i .. last_frame[i], the first at tile_begin[i]; behind all rows come one tile per frame for its
  /// border (intrinsics and gradient) and one for the border with itself.
  std::vector<int> last_frame;           ///< (T,)
  std::vector<std::int64_t> tile_begin;  ///< (T + 1,)
  AlignedDoubles tiles;                  ///< (tiles + T + 1, 7, 8)
};

struct LandmarkSystem::Scratch {
  AlignedDoubles border;   ///< (64, 3, 8): whitened intrinsics rows and gradient of a chunk's landmarks
  AlignedDoubles rows;     ///< whitened rows of a chunk's pairs, or of its frames
  std::vector<int> place;  ///< (frames, 64)
};

}  // namespace uni4d_fg
