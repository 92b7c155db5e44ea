// The inexact step of a TrajectorySystem: conjugate gradients, preconditioned by every track's own block.
#include <algorithm>
#include <atomic>
#include <cmath>

#include "uni4d_fg/parallel.hpp"
#include "uni4d_fg/thread_team.hpp"
#include "uni4d_fg/trajectory_system.hpp"

namespace uni4d_fg {
namespace {

/// Symmetric (six values) or lower triangular (xx, yx, yy, zx, zy, zz) or full (row-major) 3x3 blocks.
using Block = double[9];

/// Factor a symmetric block: `inverse` receives the inverse of its lower Cholesky factor. False unless positive.
UNI4D_FG_INLINE bool invert_cholesky(const double* s, double* inverse) {
  const double p0 = s[0];
  const double i0 = 1.0 / std::sqrt(p0);
  const double l10 = s[1] * i0, l20 = s[2] * i0;
  const double p1 = s[3] - l10 * l10;
  const double i1 = 1.0 / std::sqrt(p1);
  const double l21 = (s[4] - l20 * l10) * i1;
  const double p2 = s[5] - l20 * l20 - l21 * l21;
  const double i2 = 1.0 / std::sqrt(p2);
  inverse[0] = i0;
  inverse[1] = -l10 * i0 * i1;
  inverse[2] = i1;
  inverse[3] = (l10 * l21 * i1 - l20) * i0 * i2;
  inverse[4] = -l21 * i1 * i2;
  inverse[5] = i2;
  return p0 > 0.0 && p1 > 0.0 && p2 > 0.0;
}

/// out = B L^-T for the inverse of a lower factor.
UNI4D_FG_INLINE void times_inverse_transposed(const double* b, const double* inverse, double* out) {
  for (int i = 0; i < 3; ++i) {
    const double x = b[3 * i], y = b[3 * i + 1], z = b[3 * i + 2];
    out[3 * i] = x * inverse[0];
    out[3 * i + 1] = x * inverse[1] + y * inverse[2];
    out[3 * i + 2] = x * inverse[3] + y * inverse[4] + z * inverse[5];
  }
}

/// out -= A v.
UNI4D_FG_INLINE void subtract_product(const float* a, const double* v, double* out) {
  for (int i = 0; i < 3; ++i) out[i] -= a[3 * i] * v[0] + a[3 * i + 1] * v[1] + a[3 * i + 2] * v[2];
}

/// out -= A^T v.
UNI4D_FG_INLINE void subtract_transposed_product(const float* a, const double* v, double* out) {
  for (int i = 0; i < 3; ++i) out[i] -= a[i] * v[0] + a[3 + i] * v[1] + a[6 + i] * v[2];
}

double sum(const std::vector<double>& values) {
  double total = 0.0;
  for (const double value : values) total += value;
  return total;
}

}  // namespace

std::pair<std::size_t, std::size_t> TrajectorySystem::chunk_points(int chunk) const {
  const auto c = static_cast<std::size_t>(chunk);
  return {static_cast<std::size_t>(track_start_[static_cast<std::size_t>(chunk_tracks_[c])]),
          static_cast<std::size_t>(track_start_[static_cast<std::size_t>(chunk_tracks_[c + 1])])};
}

/// Factor the damped blocks of the tracks of a chunk. False when one is not positive definite.
///
/// A track's matrix A is block pentadiagonal, and so is its Cholesky factor L, A = L L^T. With point p's blocks A_0 on
/// the diagonal, A_1 to the point before and A_2 to the one before that:
///     L_2(p) = A_2 L_0(p-2)^{-T}
///     L_1(p) = (A_1 - L_2(p) L_1(p-1)^T) L_0(p-1)^{-T}
///     L_0(p) L_0(p)^T = A_0 - L_1(p) L_1(p)^T - L_2(p) L_2(p)^T
/// A point's 24 values are L_0^{-1} (6), L_1 (9) and L_2 (9).
bool TrajectorySystem::factorize_chunk(int chunk, double damping, double min_diagonal, double max_diagonal) {
  const auto [begin, end] = chunk_points(chunk);
  bool positive = true;
  double rows[3][24];  // of points p, p - 1 and p - 2 at p % 3, (p + 2) % 3 and (p + 1) % 3, in double precision
  for (std::size_t p = begin; p < end; ++p) {
    const double* block = &blocks_[24 * p];
    double* own = rows[p % 3];
    const double* previous = rows[(p + 2) % 3];
    const double* before_that = rows[(p + 1) % 3];
    double s[6];
    std::copy_n(block, 6, s);
    for (int a = 0; a < 3; ++a) {
      const double added = damping * std::min(std::max(block[kDiagonal[a]], min_diagonal), max_diagonal);
      added_[3 * p + static_cast<std::size_t>(a)] = added;
      s[kDiagonal[a]] += added;
    }
    const auto position = static_cast<std::int64_t>(p) - track_start_[static_cast<std::size_t>(track_of_[p])];
    double* one = own + 6;
    double* two = own + 15;
    std::fill_n(one, 18, 0.0);
    if (position >= 2) times_inverse_transposed(block + 15, before_that, two);
    if (position >= 1) {
      Block coupling;
      std::copy_n(block + 6, 9, coupling);
      if (position >= 2) {
        for (int i = 0; i < 3; ++i) {
          for (int j = 0; j < 3; ++j) {
            for (int k = 0; k < 3; ++k) coupling[3 * i + j] -= two[3 * i + k] * previous[6 + 3 * j + k];
          }
        }
      }
      times_inverse_transposed(coupling, previous, one);
    }
    for (const double* lag : {one, two}) {
      for (int i = 0, entry = 0; i < 3; ++i) {
        for (int j = i; j < 3; ++j, ++entry) {
          for (int k = 0; k < 3; ++k) s[entry] -= lag[3 * i + k] * lag[3 * j + k];
        }
      }
    }
    positive &= invert_cholesky(s, own);
    // Rounding to single precision changes the preconditioner, which stays symmetric and positive, and not the result;
    // conjugate gradients are bound by memory.
    for (std::size_t i = 0; i < 24; ++i) factor_[24 * p + i] = static_cast<float>(own[i]);
  }
  return positive;
}

/// result = (L L^T)^{-1} vector for the points of a chunk: forwards through the tracks with L^{-1}, backwards with
/// L^{-T}. Backwards, a point is divided by its own block first and then subtracted from the two before it.
void TrajectorySystem::precondition_chunk(int chunk, const double* vector, double* result) const {
  const auto [begin, end] = chunk_points(chunk);
  for (std::size_t p = begin; p < end; ++p) {
    const float* own = &factor_[24 * p];
    const auto position = static_cast<std::int64_t>(p) - track_start_[static_cast<std::size_t>(track_of_[p])];
    double v[3] = {vector[3 * p], vector[3 * p + 1], vector[3 * p + 2]};
    double* out = result + 3 * p;
    if (position >= 2) subtract_product(own + 15, out - 6, v);
    if (position >= 1) subtract_product(own + 6, out - 3, v);
    out[0] = own[0] * v[0];
    out[1] = own[1] * v[0] + own[2] * v[1];
    out[2] = own[3] * v[0] + own[4] * v[1] + own[5] * v[2];
  }
  for (std::size_t p = end; p-- > begin;) {
    const float* own = &factor_[24 * p];
    const auto position = static_cast<std::int64_t>(p) - track_start_[static_cast<std::size_t>(track_of_[p])];
    double* out = result + 3 * p;
    const double v[3] = {out[0], out[1], out[2]};
    out[0] = own[0] * v[0] + own[1] * v[1] + own[3] * v[2];
    out[1] = own[2] * v[1] + own[4] * v[2];
    out[2] = own[5] * v[2];
    if (position >= 1) subtract_transposed_product(own + 6, out, out - 3);
    if (position >= 2) subtract_transposed_product(own + 15, out, out - 6);
  }
}

/// One solve: its vectors, and the steps that a team of threads shares. Sums run over chunks, in order.
class TrajectorySystem::ConjugateGradients {
 public:
  explicit ConjugateGradients(const TrajectorySystem& system)
      : system_(system),
        size_(system.gradient_.size()),
        change_(system.edge_low_.size()),
        tension_(system.edge_low_.size()),
        loose_(system.loose_stiffness_.empty() ? 0 : size_),
        linearized_(system.linearized_rows_),
        partial_(static_cast<std::size_t>(system.num_chunks_)) {}

  /// result = (J^T J + added) vector; returns the sum of vector * result. Contains three barriers.
  ///
  /// ARAP in three passes, u_e the direction of edge e, w_f the weight of factor f on edges e and e':
  ///     change c_e = u_e . (v_low - v_high)
  ///     tension t_e = sum of w_f (c_e - c_e') over the factors of e; edge_stiffness_ is the sum of the w_f
  ///     a point gets t_e u_e from the edges of which it is the lower end, and -t_e u_e from the others.
  double multiply(const double* vector, const double* added, double* result, int worker, ThreadTeam& team) {
    const TrajectorySystem& s = system_;
    if (worker == 0 && !loose_.empty()) {
      std::fill(loose_.begin(), loose_.end(), 0.0);
      s.multiply_loose(vector, loose_.data());
    }
    const int edges = static_cast<int>(change_.size());
    const auto first = static_cast<std::size_t>(range_begin(edges, team.size(), worker));
    const auto last = static_cast<std::size_t>(range_begin(edges, team.size(), worker + 1));
    for (std::size_t e = first; e < last; ++e) {
      const double* a = vector + 3 * s.edge_low_[e];
      const double* b = vector + 3 * s.edge_high_[e];
      const double* d = &s.direction_[3 * e];
      change_[e] = d[0] * (a[0] - b[0]) + d[1] * (a[1] - b[1]) + d[2] * (a[2] - b[2]);
    }
    if (!linearized_.empty()) s.linearized_changes(vector, worker, team.size(), linearized_.data());
    team.wait();
    for (std::size_t e = first; e < last; ++e) {
      double tension = s.edge_stiffness_[e] * change_[e];
      for (std::int32_t i = s.entry_start_[e]; i < s.entry_start_[e + 1]; ++i) {
        const Entry& entry = s.entries_[static_cast<std::size_t>(i)];
        tension -=
            s.factor_weight_[static_cast<std::size_t>(entry.factor)] * change_[static_cast<std::size_t>(entry.other)];
      }
      tension_[e] = tension;
    }
    team.wait();
    for_chunks(worker, team, [&](int chunk) {
      partial_[static_cast<std::size_t>(chunk)] = linearized_.empty()
                                                      ? multiply_chunk<false>(chunk, vector, added, result)
                                                      : multiply_chunk<true>(chunk, vector, added, result);
    });
    team.wait();
    return sum(partial_);
  }

  /// Solve; the result is in `x`, the residual in `r`. Returns the number of steps.
  int solve(double tolerance, int max_iterations, int worker, ThreadTeam& team) {
    const TrajectorySystem& s = system_;
    if (worker == 0) {
      for (auto* values : {&x, &z_, &p_, &product_}) values->assign(size_, 0.0);
      r.resize(size_);
      for (std::size_t i = 0; i < size_; ++i) r[i] = -s.gradient_[i];
      residuals_.assign(partial_.size(), 0.0);
    }
    team.wait();
    for_chunks(worker, team, [&](int chunk) { precondition(chunk); });
    team.wait();
    double rz = sum(residuals_), beta = 0.0;
    const double target = tolerance * tolerance * rz;
    int iteration = 0;
    for (; iteration < max_iterations && rz > target; ++iteration) {
      for_chunks(worker, team, [&](int chunk) {
        const auto [begin, end] = s.chunk_points(chunk);
        for (std::size_t i = 3 * begin; i < 3 * end; ++i) p_[i] = z_[i] + beta * p_[i];
      });
      team.wait();
      const double alpha = rz / multiply(p_.data(), s.added_.data(), product_.data(), worker, team);
      for_chunks(worker, team, [&](int chunk) {
        const auto [begin, end] = s.chunk_points(chunk);
        for (std::size_t i = 3 * begin; i < 3 * end; ++i) {
          x[i] += alpha * p_[i];
          r[i] -= alpha * product_[i];
        }
        precondition(chunk);
      });
      team.wait();
      const double previous = rz;
      rz = sum(residuals_);
      beta = rz / previous;
    }
    return iteration;
  }

  std::vector<double> x, r;

 private:
  template <typename F>
  void for_chunks(int worker, const ThreadTeam& team, F f) const {
    const int end = range_begin(system_.num_chunks_, team.size(), worker + 1);
    for (int chunk = range_begin(system_.num_chunks_, team.size(), worker); chunk < end; ++chunk) f(chunk);
  }

  void precondition(int chunk) {
    system_.precondition_chunk(chunk, r.data(), z_.data());
    const auto [begin, end] = system_.chunk_points(chunk);
    double product = 0.0;
    for (std::size_t i = 3 * begin; i < 3 * end; ++i) product += r[i] * z_[i];
    residuals_[static_cast<std::size_t>(chunk)] = product;
  }

  template <bool kLinearized>
  double multiply_chunk(int chunk, const double* vector, const double* added, double* result) const {
    const TrajectorySystem& s = system_;
    const auto [begin, end] = s.chunk_points(chunk);
    double product = 0.0;
    for (std::size_t p = begin; p < end; ++p) {
      const double* own = &s.inside_[18 * p];  // to itself, to p - 1 at 6, to p - 2 at 12
      const double* v = vector + 3 * p;
      double out[3] = {0.0, 0.0, 0.0};
      add_symmetric_product(own, v, out);
      // Couplings are stored with the later point, and are zero where that is of the next track.
      if (p >= begin + 1) add_symmetric_product(own + 6, v - 3, out);
      if (p >= begin + 2) add_symmetric_product(own + 12, v - 6, out);
      // What couples p with later points stands with those: one and two points on, 18 values each.
      if (p + 1 < end) add_symmetric_product(own + 18 + 6, v + 3, out);
      if (p + 2 < end) add_symmetric_product(own + 36 + 12, v + 6, out);
      for (auto e = static_cast<std::size_t>(s.low_start_[p]); e < static_cast<std::size_t>(s.low_start_[p + 1]); ++e) {
        for (std::size_t a = 0; a < 3; ++a) out[a] += tension_[e] * s.direction_[3 * e + a];
      }
      for (std::int32_t i = s.high_start_[p]; i < s.high_start_[p + 1]; ++i) {
        const auto e = static_cast<std::size_t>(s.high_edge_[static_cast<std::size_t>(i)]);
        for (std::size_t a = 0; a < 3; ++a) out[a] -= tension_[e] * s.direction_[3 * e + a];
      }
      if constexpr (kLinearized) s.add_linearized_products(p, linearized_.data(), out);
      for (std::size_t a = 0; a < 3; ++a) {
        if (added != nullptr) out[a] += added[3 * p + a] * v[a];
        if (!loose_.empty()) out[a] += loose_[3 * p + a];
        result[3 * p + a] = out[a];
        product += out[a] * v[a];
      }
    }
    return product;
  }

  const TrajectorySystem& system_;
  std::size_t size_;
  std::vector<double> change_, tension_;  ///< Of every edge: its change along a vector, and what that pulls.
  std::vector<double> loose_;
  std::vector<double> linearized_;  ///< J v of all batches of add_linearized.
  std::vector<double> partial_, residuals_;
  std::vector<double> z_, p_, product_;
};

void TrajectorySystem::multiply(const double* vector, double* result) const {
  ConjugateGradients work(*this);
  ThreadTeam::run(useful_threads(threads_, num_chunks_, 2),
                  [&](int worker, ThreadTeam& team) { work.multiply(vector, nullptr, result, worker, team); });
}

std::optional<TrajectoryStep> TrajectorySystem::solve(double damping, double min_diagonal, double max_diagonal,
                                                      double cg_tolerance, int cg_max_iterations) {
  ConjugateGradients work(*this);
  std::atomic<bool> positive{true};
  TrajectoryStep step;
  ThreadTeam::run(useful_threads(threads_, num_chunks_, 2), [&](int worker, ThreadTeam& team) {
    const int end = range_begin(num_chunks_, team.size(), worker + 1);
    for (int chunk = range_begin(num_chunks_, team.size(), worker); chunk < end; ++chunk) {
      if (!factorize_chunk(chunk, damping, min_diagonal, max_diagonal)) positive = false;
    }
    team.wait();
    if (!positive) return;
    const int iterations = work.solve(cg_tolerance, cg_max_iterations, worker, team);
    if (worker == 0) step.iterations = iterations;
  });
  if (!positive) return std::nullopt;
  // With r = -g - (H + D) x the decrease -g x - x H x / 2 needs no further product.
  double squared = 0.0, slope = 0.0, rest = 0.0, damped = 0.0;
  for (std::size_t i = 0; i < work.x.size(); ++i) {
    const double x = work.x[i];
    squared += x * x;
    slope -= gradient_[i] * x;
    rest += work.r[i] * x;
    damped += added_[i] * x * x;
  }
  if (!std::isfinite(squared)) return std::nullopt;
  step.norm = std::sqrt(squared);
  step.predicted_decrease = std::max(0.5 * (slope + rest + damped), 0.0);
  step.delta = std::move(work.x);
  return step;
}

}  // namespace uni4d_fg
