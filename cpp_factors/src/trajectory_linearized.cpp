// Factors of a TrajectorySystem that come linearized: their part of gradient, product and preconditioner.
//
// Sums over factors are gathered point by point, in the order of the factors, whatever the number of threads. A slot of
// a factor that reads a point is a "use" of the point, numbered factor * slots + slot.
#include <algorithm>

#include "uni4d_fg/parallel.hpp"
#include "uni4d_fg/trajectory_system.hpp"

namespace uni4d_fg {

void TrajectorySystem::add_linearized(const std::int64_t* rows, std::int64_t count, int slots, int dim) {
  const std::vector<double> ones(static_cast<std::size_t>(count), 1.0);
  Batch batch = make_batch({rows, count, ones.data(), false, ones.data(), {}}, Kind::kLinearized, slots, dim);
  batches_.push_back(std::move(batch));
}

/// List the uses of every point, and give every factor its place among the changes of a product.
void TrajectorySystem::plan_uses() {
  for (Batch& batch : batches_) {
    if (batch.kind != Kind::kLinearized) continue;
    const auto count = static_cast<std::size_t>(batch.size()), slots = static_cast<std::size_t>(batch.slots);
    const auto dim = static_cast<std::size_t>(batch.dim);
    batch.first_change = linearized_rows_;
    linearized_rows_ += count * dim;
    batch.residual.assign(count * dim, 0.0);
    batch.jacobians.assign(count * dim * slots * 3, 0.0);
    for (std::size_t n = 0; n < count; ++n) batch.inside_bands.push_back(complete(&batch.rows[n * slots], batch.slots));
    batch.use_start.assign(static_cast<std::size_t>(num_points_) + 1, 0);
    for (const std::int32_t row : batch.rows) ++batch.use_start[static_cast<std::size_t>(row) + 1];
    for (std::size_t p = 0; p < static_cast<std::size_t>(num_points_); ++p)
      batch.use_start[p + 1] += batch.use_start[p];
    batch.use.resize(batch.rows.size());
    std::vector<std::int32_t> next(batch.use_start.begin(), batch.use_start.end() - 1);
    for (std::size_t i = 0; i < batch.rows.size(); ++i) {
      batch.use[static_cast<std::size_t>(next[static_cast<std::size_t>(batch.rows[i])]++)] =
          static_cast<std::int32_t>(i);
    }
  }
}

void TrajectorySystem::set_linearized(int batch, const double* residual, const double* jacobians) {
  Batch& target = batches_[static_cast<std::size_t>(batch)];
  std::copy_n(residual, target.residual.size(), target.residual.begin());
  std::copy_n(jacobians, target.jacobians.size(), target.jacobians.begin());
  target.set = true;
  linearized_ = false;
}

int TrajectorySystem::missing_linearization() const {
  for (std::size_t b = 0; b < batches_.size(); ++b) {
    if (batches_[b].kind == Kind::kLinearized && !batches_[b].set) return static_cast<int>(b);
  }
  return -1;
}

/// Add to gradient and blocks of the points of a chunk. Blocks within a track are those of the preconditioner: all of a
/// factor's, or the diagonal ones alone where others are beyond the bands, so that it stays positive definite.
void TrajectorySystem::gather_linearized(int chunk) {
  const auto [begin, end] = chunk_points(chunk);
  for (const Batch& batch : batches_) {
    if (batch.kind != Kind::kLinearized) continue;
    const auto slots = static_cast<std::size_t>(batch.slots), dim = static_cast<std::size_t>(batch.dim);
    const std::size_t stride = 3 * slots;  // from one residual's row of the Jacobian to the next
    for (std::size_t p = begin; p < end; ++p) {
      for (std::int32_t u = batch.use_start[p]; u < batch.use_start[p + 1]; ++u) {
        const auto use = static_cast<std::size_t>(batch.use[static_cast<std::size_t>(u)]);
        const std::size_t factor = use / slots, slot = use % slots;
        const double* jacobian = &batch.jacobians[factor * dim * stride];
        const double* own = jacobian + 3 * slot;
        for (std::size_t i = 0; i < dim; ++i) {
          const double r = batch.residual[factor * dim + i];
          for (std::size_t a = 0; a < 3; ++a) gradient_[3 * p + a] += r * own[i * stride + a];
        }
        for (std::size_t other = 0; other < slots; ++other) {
          const std::int32_t q = batch.rows[factor * slots + other];
          for (std::size_t i = 0; i < dim; ++i) {
            add_block(static_cast<std::int32_t>(p), q, batch.inside_bands[factor] != 0, 1.0, own + i * stride,
                      jacobian + i * stride + 3 * other);
          }
        }
      }
    }
  }
}

/// Write a worker's share of J v, the changes of the residuals along a vector (3 P).
void TrajectorySystem::linearized_changes(const double* vector, int worker, int workers, double* changes) const {
  for (const Batch& batch : batches_) {
    if (batch.kind != Kind::kLinearized) continue;
    const auto slots = static_cast<std::size_t>(batch.slots), dim = static_cast<std::size_t>(batch.dim);
    const auto last = static_cast<std::size_t>(range_begin(batch.size(), workers, worker + 1));
    for (auto n = static_cast<std::size_t>(range_begin(batch.size(), workers, worker)); n < last; ++n) {
      const double* jacobian = &batch.jacobians[3 * n * dim * slots];
      for (std::size_t i = 0; i < dim; ++i) {
        double change = 0.0;
        for (std::size_t s = 0; s < slots; ++s, jacobian += 3) {
          const double* v = vector + 3 * batch.rows[n * slots + s];
          change += jacobian[0] * v[0] + jacobian[1] * v[1] + jacobian[2] * v[2];
        }
        changes[batch.first_change + n * dim + i] = change;
      }
    }
  }
}

/// Add J^T (J v) of one point to `out` (3,).
void TrajectorySystem::add_linearized_products(std::size_t point, const double* changes, double* out) const {
  for (const Batch& batch : batches_) {
    if (batch.kind != Kind::kLinearized) continue;
    const auto slots = static_cast<std::size_t>(batch.slots), dim = static_cast<std::size_t>(batch.dim);
    for (std::int32_t u = batch.use_start[point]; u < batch.use_start[point + 1]; ++u) {
      const auto use = static_cast<std::size_t>(batch.use[static_cast<std::size_t>(u)]);
      const std::size_t factor = use / slots, slot = use % slots;
      const double* jacobian = &batch.jacobians[3 * (factor * dim * slots + slot)];
      const double* change = changes + batch.first_change + factor * dim;
      for (std::size_t i = 0; i < dim; ++i, jacobian += 3 * slots) {
        for (std::size_t a = 0; a < 3; ++a) out[a] += change[i] * jacobian[a];
      }
    }
  }
}

}  // namespace uni4d_fg
