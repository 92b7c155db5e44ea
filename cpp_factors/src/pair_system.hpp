// Normal equations of depth reprojection between the poses of a window with shared intrinsics.
#pragma once

#include <cstdint>
#include <vector>

#include "uni4d_fg/math.hpp"
#include "uni4d_fg/robust.hpp"

namespace uni4d_fg {

/// Rows of N depth reprojection factors, as the caller stores them.
struct PairRows {
  std::int64_t count = 0;
  const std::int64_t* source = nullptr;  // (N,) pose rows
  const std::int64_t* target = nullptr;  // (N,)
  const double* uv_source = nullptr;     // (N, 2) px
  const double* depth = nullptr;         // (N,) m
  const double* uv_target = nullptr;     // (N, 2) px
  const double* sigma = nullptr;         // (N,) or (N, 2) px
  int sigma_columns = 1;
  const double* weight = nullptr;  // (N,)
};

/// Depth reprojection factors grouped by frame pair.
///
/// All factors of a pair share the relative pose, and J_source = -J_target Ad(target_T_source): a factor adds only to
/// one 10x10 block (target twist, intrinsics) of its pair, which is spread over both poses once per pair.
/// Nothing changes after the constructor, so that threads may share a system without a lock.
class PairSystem {
 public:
  /// `pose_columns` (num_poses, 6) and `intrinsics_columns` (4,): position of an entry in the dense system of `size`
  /// free entries, or -1 when the entry is frozen.
  PairSystem(int num_poses, const PairRows& rows, const Kernel& kernel, std::vector<std::int64_t> pose_columns,
             std::vector<std::int64_t> intrinsics_columns, int size, int threads);

  int num_poses() const { return num_poses_; }
  int size() const { return size_; }
  std::int64_t num_factors() const { return static_cast<std::int64_t>(weight_.size()); }

  /// sum weight rho(|r / sigma|). `poses` (num_poses, 4, 4), `intrinsics` (4,).
  double energy(const double* poses, const double* intrinsics) const;

  /// Write the IRLS Hessian J^T J (size, size) and gradient J^T r (size,).
  void linearize(const double* poses, const double* intrinsics, double* hessian, double* gradient) const;

  /// Columns of a pair's block: six of the target twist, four of the intrinsics, one of the residual.
  static constexpr int kColumns = 11;
  static constexpr int kSums = kColumns * (kColumns + 1) / 2;

 private:
  /// Two poses and the rows [begin, end) of their factors. A pair is summed by one thread, so that no result depends on
  /// the number of threads.
  struct Pair {
    int source, target, begin, end;
  };

  std::vector<Pose> relative_poses(const double* poses) const;
  /// Call f(number) for every pair.
  template <typename F>
  void for_pairs(F f) const;
  /// Call f(input) for every few rows of a pair, in order.
  template <typename F>
  void for_tiles(const Pair& pair, F f) const;
  void spread(const Pair& pair, const Pose& target_T_source, const double* sums, double* hessian,
              double* gradient) const;

  int num_poses_, size_, threads_;
  Kernel kernel_;
  std::vector<std::int64_t> pose_columns_, intrinsics_columns_;
  std::vector<Pair> pairs_;
  // One entry per factor, in the order of the pairs.
  std::vector<double> u_source_, v_source_, depth_, u_target_, v_target_, inverse_sigma_u_, inverse_sigma_v_, weight_;
};

}  // namespace uni4d_fg
