/// The normal equations of many moving points, and their inexact solution by conjugate gradients.
///
/// Unknowns are P points (3 each), rows ordered by track and frame, all free. Factors read one point (reprojection,
/// depth prior), two or three (temporal smoothness) or four (as-rigid-as-possible); factors of any other type come
/// linearized. The damped normal equations
/// (J^T J + damping D) d = -J^T r are solved by preconditioned conjugate gradients; the preconditioner is the exact
/// block of every track on its own, block pentadiagonal with 3x3 blocks, factored by Cholesky track by track.
///
/// As-rigid-as-possible factors subtract two distances, and most distances appear in two factors (of consecutive
/// frames). Distances ("edges" here: two points) are therefore evaluated once, and J is kept as one direction per
/// edge and one weight per factor. Every sum runs in an order that does not depend on the number of threads.
#pragma once

#include <array>
#include <cstdint>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

#include "uni4d_fg/camera.hpp"
#include "uni4d_fg/robust.hpp"

namespace uni4d_fg {

/// A factor whose residual or Jacobian is not finite.
struct NonFinite {
  int batch = std::numeric_limits<int>::max();
  std::int64_t row = std::numeric_limits<std::int64_t>::max();

  bool any() const { return batch != std::numeric_limits<int>::max(); }
  void merge(const NonFinite& other) {
    if (other.batch < batch || (other.batch == batch && other.row < row)) *this = other;
  }
};

struct TrajectoryStep {
  std::vector<double> delta;      ///< (3 P)
  double norm = 0.0;              ///< Euclidean norm of delta.
  double predicted_decrease = 0;  ///< Of the undamped quadratic model, not negative.
  int iterations = 0;             ///< Conjugate-gradient steps.
};

/// Rows, noise and weights that every batch has.
struct TrajectoryRows {
  const std::int64_t* rows = nullptr;  ///< (N, slots), row-major.
  std::int64_t count = 0;              ///< N.
  const double* sigma = nullptr;       ///< (N) or (N, d).
  bool sigma_per_component = false;
  const double* weight = nullptr;  ///< (N).
  Kernel kernel;
};

class TrajectorySystem {
 public:
  /// @param track    (num_points) track of every point; points of one track are consecutive.
  /// @param threads  Largest number of worker threads.
  TrajectorySystem(const std::int64_t* track, std::int64_t num_points, int threads);

  /// r = uv - pi(p), px; frozen cameras (N, 4, 4) and intrinsics (N, 4) fx, fy, cx, cy.
  void add_dynamic_reprojection(const TrajectoryRows& rows, const double* uv, const double* world_T_cam,
                                const double* intrinsics);
  /// r = log z - log depth - log_scale with depth (N), frozen cameras (N, 4, 4) and log_scale (N).
  void add_dynamic_depth_prior(const TrajectoryRows& rows, const double* depth, const double* world_T_cam,
                               const double* log_scale);
  /// First difference (two slots: p' - p) or second difference (three slots: p'' - 2 p' + p).
  void add_smoothness(const TrajectoryRows& rows, int slots);
  /// r = d(p0, p1) - d(p2, p3), d the distance smoothed at zero.
  void add_arap(const TrajectoryRows& rows);

  /// Factors of any other type, known by their linearization alone: `slots` points and `dim` residuals each.
  void add_linearized(const std::int64_t* rows, std::int64_t count, int slots, int dim);

  /// Order the factors and plan all sums; call once after the last batch.
  void plan();

  /// Give the factors of a batch, in the order in which they were added, other weights (N) and another kernel.
  void reweight(int batch, const double* weight, const Kernel& kernel);

  int num_batches() const { return static_cast<int>(batches_.size()); }
  std::int64_t num_points() const { return num_points_; }
  int threads() const { return threads_; }
  std::int64_t num_factors(int batch) const { return batches_[static_cast<std::size_t>(batch)].size(); }
  bool planned() const { return planned_; }
  bool linearized() const { return linearized_; }

  bool is_linearized(int batch) const { return batches_[static_cast<std::size_t>(batch)].kind == Kind::kLinearized; }
  int num_slots(int batch) const { return batches_[static_cast<std::size_t>(batch)].slots; }
  int dim(int batch) const { return batches_[static_cast<std::size_t>(batch)].dim; }
  /// Give the next `linearize` the residuals (N, dim) and Jacobians (N, dim, slots, 3) of a batch of add_linearized,
  /// whitened and scaled by the roots of weight and kernel.
  void set_linearized(int batch, const double* residual, const double* jacobians);
  /// The first batch of add_linearized whose values the last `linearize` used up; -1 if there is none.
  int missing_linearization() const;

  /// Energy of every batch, sum of weight rho(|r / sigma|), at points (P, 3); 0 for those of add_linearized.
  std::vector<double> energies(const double* points) const;
  /// Form the gradient J^T r and all blocks at points (P, 3). Returns the first factor that is not finite, if any.
  /// @param kernel_curvature  Part of the kernels' falloff that the blocks account for, in [0, 1); 0 reweights only.
  NonFinite linearize(const double* points, double kernel_curvature = 0.0);
  const std::vector<double>& gradient() const { return gradient_; }
  /// Undamped 3x3 diagonal block of a point: xx, xy, xz, yy, yz, zz.
  std::array<double, 6> diagonal_block(std::int64_t point) const;
  /// (J^T J) vector, both (3 P).
  void multiply(const double* vector, double* result) const;
  /// The inexact step; empty when the preconditioner is not positive definite or the step is not finite.
  std::optional<TrajectoryStep> solve(double damping, double min_diagonal, double max_diagonal, double cg_tolerance,
                                      int cg_max_iterations);

 private:
  enum class Kind { kReprojection, kDepth, kSmoothness, kArap, kLinearized };

  /// Camera frozen in the data of a factor; few distinct ones serve many factors.
  struct FrozenCamera {
    Pose pose;
    Intrinsics intrinsics;
  };

  /// One batch; per-factor arrays are in planned order, and `original` leads back.
  struct Batch {
    Kind kind = Kind::kReprojection;
    int slots = 1;
    int dim = 2;  ///< Residual dimension.
    Kernel kernel;
    std::vector<std::int32_t> rows;  ///< (N, slots)
    std::vector<std::int32_t> camera;
    std::vector<double> observed;       ///< uv (N, 2), or log depth + log scale (N).
    std::vector<double> inverse_sigma;  ///< (N, dim)
    std::vector<double> weight;         ///< (N)
    std::vector<std::int32_t> original;
    std::vector<std::int32_t> chunk_start;  ///< Factors inside a track, by chunk of tracks.
    std::int32_t first_loose = 0;           ///< Smoothness factors from here on couple beyond the bands.
    std::int32_t first_factor = 0;          ///< ARAP: position in the list of all ARAP factors.
    std::int32_t size() const { return static_cast<std::int32_t>(weight.size()); }

    // Batches of add_linearized.
    std::vector<double> residual;              ///< (N, dim)
    std::vector<double> jacobians;             ///< (N, dim, slots, 3)
    std::vector<std::uint8_t> inside_bands;    ///< (N) whether all products within a track are within the bands.
    std::vector<std::int32_t> use_start, use;  ///< (P + 1) and (N slots): factor * slots + slot, point by point.
    std::size_t first_change = 0;              ///< Where the changes (N, dim) of a product stand among all.
    bool set = false;                          ///< Since the last linearization.
  };

  struct Entry {
    std::int32_t factor, other;
  };
  /// A product of two directions that couples a point with an earlier one of its track.
  struct LagEntry {
    std::int32_t factor;
    bool after_is_later;
    std::int8_t lag;
  };

  Batch make_batch(const TrajectoryRows& rows, Kind kind, int slots, int dim) const;
  std::int32_t camera_index(const double* world_T_cam, const double* intrinsics);
  void plan_chunks();
  void plan_inside(Batch& batch);
  void plan_edges();
  void plan_arap_blocks();
  void plan_uses();
  bool complete(const std::int32_t* rows, int slots) const;
  bool regular(std::int32_t factor) const;

  double energy_of(const Batch& batch, std::int32_t begin, std::int32_t end, const double* points) const;
  void linearize_edges(const double* points);
  void linearize_arap(double kernel_curvature, std::vector<NonFinite>& bad);
  void sum_over_edges();
  void linearize_inside(const Batch& batch, int batch_index, int chunk, const double* points, double kernel_curvature,
                        NonFinite& bad);
  void linearize_smoothness(const Batch& batch, std::size_t n, double kernel_curvature, const double* r, double* pull,
                            double* stiffness) const;
  void gather_arap(int chunk);
  void add_block(std::int32_t row, std::int32_t column, bool all_lags, double scale, const double* a, const double* b);
  void add_irregular_arap();
  void linearize_loose(const Batch& batch, int batch_index, const double* points, double kernel_curvature,
                       NonFinite& bad);
  void multiply_loose(const double* vector, double* result) const;

  void gather_linearized(int chunk);
  void linearized_changes(const double* vector, int worker, int workers, double* changes) const;
  void add_linearized_products(std::size_t point, const double* changes, double* out) const;

  class ConjugateGradients;
  bool factorize_chunk(int chunk, double damping, double min_diagonal, double max_diagonal);
  void precondition_chunk(int chunk, const double* vector, double* result) const;
  /// Rows [first, second) of the points of a chunk.
  std::pair<std::size_t, std::size_t> chunk_points(int chunk) const;

  std::int64_t num_points_;
  int threads_;
  bool planned_ = false, linearized_ = false;
  std::vector<std::int32_t> track_of_;      ///< (P) consecutive number of the point's track.
  std::vector<std::int32_t> track_start_;   ///< (tracks + 1)
  std::vector<std::int32_t> chunk_tracks_;  ///< (chunks + 1) tracks at which chunks begin.
  int num_chunks_ = 0;

  std::vector<Batch> batches_;
  std::vector<FrozenCamera> cameras_;
  std::vector<std::vector<std::int32_t>> camera_buckets_;
  std::int32_t last_camera_ = -1;

  // As-rigid-as-possible.
  std::vector<std::int32_t> edge_low_, edge_high_;       ///< (E) rows, low < high unless both are one point.
  std::vector<std::int32_t> low_start_;                  ///< (P + 1) edges by their lower row.
  std::vector<std::int32_t> high_start_, high_edge_;     ///< Edges by their higher row.
  std::vector<std::int32_t> factor_now_, factor_after_;  ///< (F) edges.
  std::vector<std::int32_t> entry_start_;                ///< (E + 1)
  std::vector<Entry> entries_;
  std::vector<std::int32_t> lag_start_;  ///< (P + 1)
  std::vector<LagEntry> lag_entries_;
  std::vector<std::int32_t> irregular_;
  std::vector<std::uint8_t> factor_regular_;
  mutable std::vector<double> distance_;              ///< (E)
  std::vector<double> direction_;                     ///< (E, 3)
  std::vector<double> factor_weight_, factor_force_;  ///< (F) stiffness, and pull on the first of its edges.
  std::vector<double> edge_stiffness_, edge_force_;   ///< (E) sums over factors.
  std::vector<double> edge_diagonal_;                 ///< (E) as edge_stiffness_, regular factors only.

  std::size_t linearized_rows_ = 0;  ///< Residuals of all batches of add_linearized.

  std::vector<double> gradient_;  ///< (3 P)
  std::vector<double> inside_;    ///< (P, 18) J^T J of factors within a track: block, lag 1, lag 2, all symmetric.
  std::vector<double> blocks_;    ///< (P, 24) all of J^T J within a track: block, lag 1, lag 2.
  std::vector<double> loose_stiffness_;  ///< Smoothness beyond the bands: symmetric stiffness (factors, 6).
  std::vector<double> added_;            ///< (3 P) damping.
  std::vector<float> factor_;            ///< (P, 24) Cholesky: inverse of the diagonal block, lags 1 and 2.
};

}  // namespace uni4d_fg
