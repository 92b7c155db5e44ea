// Energies and the quadratic model of a TrajectorySystem.
#include "uni4d_fg/trajectory_system.hpp"

#include <algorithm>
#include <cmath>

#include "uni4d_fg/factors/arap.hpp"
#include "uni4d_fg/factors/depth_prior.hpp"
#include "uni4d_fg/factors/dynamic_reprojection.hpp"
#include "uni4d_fg/factors/temporal_smoothness.hpp"
#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {
namespace {

constexpr int kRangeSize = 4096;
/// Ranges, or chunks of tracks, that are worth a thread.
constexpr int kRangeGrain = 2;
/// Places of the entries of a symmetric 3x3 block in its six stored values.
constexpr int kRowOf[6] = {0, 0, 0, 1, 1, 2};
constexpr int kColumnOf[6] = {0, 1, 2, 1, 2, 2};

UNI4D_FG_INLINE const double* smoothness_jacobian(int slots) {
  return slots == 2 ? VelocitySmoothness::kJacobian : AccelerationSmoothness::kJacobian;
}

UNI4D_FG_INLINE void smoothness_residual(const double* points, const std::int32_t* rows, int slots, double* r) {
  const double* a = points + 3 * rows[0];
  const double* b = points + 3 * rows[1];
  if (slots == 2) {
    VelocitySmoothness::residual(load_vec3(a), load_vec3(b), r);
  } else {
    AccelerationSmoothness::residual(load_vec3(a), load_vec3(b), load_vec3(points + 3 * rows[2]), r);
  }
}

/// Add scale * a b^T, both 3-vectors, to a full block of nine values.
UNI4D_FG_INLINE void add_outer(double scale, const double* a, const double* b, double* block) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) block[3 * i + j] += scale * a[i] * b[j];
  }
}

/// Add scale * a a^T to a symmetric block of six values.
UNI4D_FG_INLINE void add_square(double scale, const double* a, double* block) {
  for (int i = 0; i < 6; ++i) block[i] += scale * a[kRowOf[i]] * a[kColumnOf[i]];
}

/// Take what a robust kernel's falloff removes along the residual from a stiffness: `pull` is the gradient of a factor,
/// `robust` its weight, `squared` its whitened squared norm.
UNI4D_FG_INLINE void soften(double kernel_curvature, const Kernel& kernel, double robust, double squared,
                            const double* pull, double* stiffness) {
  const double softening = kernel_curvature * falloff(kernel, squared);
  if (softening * robust > 0.0) add_square(-softening / (robust * squared), pull, stiffness);
}

int num_ranges(std::size_t count) { return static_cast<int>((count + kRangeSize - 1) / kRangeSize); }

}  // namespace

std::vector<double> TrajectorySystem::energies(const double* points) const {
  const int edge_ranges = num_ranges(edge_low_.size());
  parallel_for(edge_ranges, useful_threads(threads_, edge_ranges, kRangeGrain), [&](int begin, int end, int) {
    const std::size_t stop = std::min(edge_low_.size(), static_cast<std::size_t>(end) * kRangeSize);
    for (std::size_t e = static_cast<std::size_t>(begin) * kRangeSize; e < stop; ++e) {
      distance_[e] =
          arap::smooth_distance(load_vec3(points + 3 * edge_low_[e]) - load_vec3(points + 3 * edge_high_[e]));
    }
  });
  // Every range of factors has its own sum, added in order below.
  std::vector<std::int32_t> first_range(1, 0);
  for (const Batch& batch : batches_) first_range.push_back(first_range.back() + num_ranges(batch.weight.size()));
  std::vector<double> sums(static_cast<std::size_t>(first_range.back()));
  parallel_for(
      first_range.back(), useful_threads(threads_, first_range.back(), kRangeGrain), [&](int begin, int end, int) {
        for (int range = begin; range < end; ++range) {
          const auto index = static_cast<std::size_t>(std::upper_bound(first_range.begin(), first_range.end(), range) -
                                                      first_range.begin() - 1);
          const std::int32_t start = (range - first_range[index]) * kRangeSize;
          sums[static_cast<std::size_t>(range)] =
              energy_of(batches_[index], start, std::min(start + kRangeSize, batches_[index].size()), points);
        }
      });
  std::vector<double> out(batches_.size(), 0.0);
  for (std::size_t b = 0; b < batches_.size(); ++b) {
    for (std::int32_t range = first_range[b]; range < first_range[b + 1]; ++range) {
      out[b] += sums[static_cast<std::size_t>(range)];
    }
  }
  return out;
}

double TrajectorySystem::energy_of(const Batch& batch, std::int32_t begin, std::int32_t end,
                                   const double* points) const {
  double sum = 0.0;
  if (batch.kind == Kind::kLinearized) return sum;  // the caller knows it
  for (std::int32_t i = begin; i < end; ++i) {
    const auto n = static_cast<std::size_t>(i);
    const double* inverse_sigma = &batch.inverse_sigma[n * static_cast<std::size_t>(batch.dim)];
    double r[3], squared = 0.0;
    switch (batch.kind) {
      case Kind::kReprojection: {
        const FrozenCamera& camera = cameras_[static_cast<std::size_t>(batch.camera[n])];
        DynamicReprojection::residual(load_vec3(points + 3 * batch.rows[n]), {&batch.observed[2 * n]}, camera.pose,
                                      camera.intrinsics, r);
        squared = whiten<2>(r, inverse_sigma);
        break;
      }
      case Kind::kDepth: {
        const Pose& pose = cameras_[static_cast<std::size_t>(batch.camera[n])].pose;
        depth_prior::residual(pose, load_vec3(points + 3 * batch.rows[n]), 0.0, batch.observed[n], r);
        squared = whiten<1>(r, inverse_sigma);
        break;
      }
      case Kind::kSmoothness:
        smoothness_residual(points, &batch.rows[n * static_cast<std::size_t>(batch.slots)], batch.slots, r);
        squared = whiten<3>(r, inverse_sigma);
        break;
      case Kind::kArap: {
        const std::size_t f = static_cast<std::size_t>(batch.first_factor) + n;
        r[0] =
            distance_[static_cast<std::size_t>(factor_now_[f])] - distance_[static_cast<std::size_t>(factor_after_[f])];
        squared = whiten<1>(r, inverse_sigma);
        break;
      }
      case Kind::kLinearized:
        break;
    }
    sum += batch.weight[n] * rho(batch.kernel, squared);
  }
  return sum;
}

NonFinite TrajectorySystem::linearize(const double* points, double kernel_curvature) {
  linearized_ = false;
  std::fill(gradient_.begin(), gradient_.end(), 0.0);
  std::fill(inside_.begin(), inside_.end(), 0.0);
  std::vector<NonFinite> bad(static_cast<std::size_t>(threads_) + 1);
  linearize_edges(points);
  linearize_arap(kernel_curvature, bad);
  sum_over_edges();
  parallel_for(num_chunks_, useful_threads(threads_, num_chunks_, kRangeGrain), [&](int begin, int end, int worker) {
    for (int chunk = begin; chunk < end; ++chunk) {
      for (std::size_t b = 0; b < batches_.size(); ++b) {
        if (batches_[b].kind != Kind::kArap && batches_[b].kind != Kind::kLinearized) {
          linearize_inside(batches_[b], static_cast<int>(b), chunk, points, kernel_curvature,
                           bad[static_cast<std::size_t>(worker)]);
        }
      }
      gather_arap(chunk);
      gather_linearized(chunk);
    }
  });
  for (Batch& batch : batches_) batch.set = false;
  add_irregular_arap();
  loose_stiffness_.clear();
  for (std::size_t b = 0; b < batches_.size(); ++b) {
    if (batches_[b].kind == Kind::kSmoothness) {
      linearize_loose(batches_[b], static_cast<int>(b), points, kernel_curvature, bad.back());
    }
  }
  NonFinite first;
  for (const NonFinite& candidate : bad) first.merge(candidate);
  linearized_ = !first.any();
  return first;
}

/// Evaluate the distance of every edge and its derivative with respect to the lower row.
void TrajectorySystem::linearize_edges(const double* points) {
  const int ranges = num_ranges(edge_low_.size());
  parallel_for(ranges, useful_threads(threads_, ranges, kRangeGrain), [&](int begin, int end, int) {
    const std::size_t stop = std::min(edge_low_.size(), static_cast<std::size_t>(end) * kRangeSize);
    for (std::size_t e = static_cast<std::size_t>(begin) * kRangeSize; e < stop; ++e) {
      const Vec3 difference = load_vec3(points + 3 * edge_low_[e]) - load_vec3(points + 3 * edge_high_[e]);
      const double distance = arap::smooth_distance(difference);
      distance_[e] = distance;
      store((1.0 / distance) * difference, &direction_[3 * e]);
    }
  });
}

void TrajectorySystem::linearize_arap(double kernel_curvature, std::vector<NonFinite>& bad) {
  for (std::size_t b = 0; b < batches_.size(); ++b) {
    const Batch& batch = batches_[b];
    if (batch.kind != Kind::kArap) continue;
    parallel_for(
        batch.size(), useful_threads(threads_, batch.size(), kRangeGrain * kRangeSize),
        [&](int begin, int end, int worker) {
          for (int i = begin; i < end; ++i) {
            const auto n = static_cast<std::size_t>(i), f = n + static_cast<std::size_t>(batch.first_factor);
            const double r = distance_[static_cast<std::size_t>(factor_now_[f])] -
                             distance_[static_cast<std::size_t>(factor_after_[f])];
            // A direction is not finite only if its distance is not.
            if (!std::isfinite(r))
              bad[static_cast<std::size_t>(worker)].merge({static_cast<int>(b), batch.original[n]});
            const double inverse_sigma = batch.inverse_sigma[n], squared = r * inverse_sigma * r * inverse_sigma;
            const double scale = batch.weight[n] * weight(batch.kernel, squared) * inverse_sigma * inverse_sigma;
            factor_force_[f] = scale * r;
            factor_weight_[f] = scale * (1.0 - kernel_curvature * falloff(batch.kernel, squared));
          }
        });
  }
}

/// Sum the weights and forces of the factors that use each distance.
void TrajectorySystem::sum_over_edges() {
  const int ranges = num_ranges(edge_low_.size());
  parallel_for(ranges, useful_threads(threads_, ranges, kRangeGrain), [&](int begin, int end, int) {
    const std::size_t stop = std::min(edge_low_.size(), static_cast<std::size_t>(end) * kRangeSize);
    for (std::size_t e = static_cast<std::size_t>(begin) * kRangeSize; e < stop; ++e) {
      double stiffness = 0.0, diagonal = 0.0, force = 0.0;
      for (std::int32_t i = entry_start_[e]; i < entry_start_[e + 1]; ++i) {
        const auto f = static_cast<std::size_t>(entries_[static_cast<std::size_t>(i)].factor);
        stiffness += factor_weight_[f];
        if (factor_regular_[f]) diagonal += factor_weight_[f];
        force += static_cast<std::size_t>(factor_now_[f]) == e ? factor_force_[f] : -factor_force_[f];
      }
      edge_stiffness_[e] = stiffness;
      edge_diagonal_[e] = diagonal;
      edge_force_[e] = force;
    }
  });
}

/// Add the factors of one batch that stay within the tracks of a chunk.
void TrajectorySystem::linearize_inside(const Batch& batch, int batch_index, int chunk, const double* points,
                                        double kernel_curvature, NonFinite& bad) {
  const auto c = static_cast<std::size_t>(chunk);
  for (std::int32_t i = batch.chunk_start[c]; i < batch.chunk_start[c + 1]; ++i) {
    const auto n = static_cast<std::size_t>(i);
    const double* inverse_sigma = &batch.inverse_sigma[n * static_cast<std::size_t>(batch.dim)];
    double r[3], jacobian[6];
    if (batch.kind == Kind::kSmoothness) {
      const std::int32_t* rows = &batch.rows[n * static_cast<std::size_t>(batch.slots)];
      smoothness_residual(points, rows, batch.slots, r);
      if (!std::isfinite(r[0] + r[1] + r[2])) bad.merge({batch_index, batch.original[n]});
      double pull[3], stiffness[6];
      linearize_smoothness(batch, n, kernel_curvature, r, pull, stiffness);
      const double* factor = smoothness_jacobian(batch.slots);
      for (int s = 0; s < batch.slots; ++s) {
        double* gradient = &gradient_[3 * static_cast<std::size_t>(rows[s])];
        double* own = &inside_[18 * static_cast<std::size_t>(rows[s])];
        for (int a = 0; a < 3; ++a) gradient[a] += factor[s] * pull[a];
        for (int t = 0; t < batch.slots; ++t) {
          const std::int32_t lag = rows[s] - rows[t];
          if (lag < 0) continue;
          const double product = factor[s] * factor[t];
          for (int entry = 0; entry < 6; ++entry) own[6 * lag + entry] += product * stiffness[entry];
        }
      }
      continue;
    }
    const auto row = static_cast<std::size_t>(batch.rows[n]);
    const FrozenCamera& camera = cameras_[static_cast<std::size_t>(batch.camera[n])];
    const Vec3 point = load_vec3(points + 3 * row);
    if (batch.kind == Kind::kReprojection) {
      DynamicReprojection::linearize(point, {&batch.observed[2 * n]}, camera.pose, camera.intrinsics, r, jacobian);
    } else {
      depth_prior::linearize_point(camera.pose, point, 0.0, batch.observed[n], r, jacobian);
    }
    double squared = 0.0, check = 0.0;
    for (int a = 0; a < batch.dim; ++a) {
      const double whitened = r[a] * inverse_sigma[a];
      squared += whitened * whitened;
      check += r[a] + jacobian[3 * a] + jacobian[3 * a + 1] + jacobian[3 * a + 2];
    }
    if (!std::isfinite(check)) bad.merge({batch_index, batch.original[n]});
    const double robust = batch.weight[n] * weight(batch.kernel, squared);
    double pull[3] = {0.0, 0.0, 0.0};
    for (int a = 0; a < batch.dim; ++a) {
      const double scale = robust * inverse_sigma[a] * inverse_sigma[a];
      for (int k = 0; k < 3; ++k) pull[k] += scale * r[a] * jacobian[3 * a + k];
      add_square(scale, jacobian + 3 * a, &inside_[18 * row]);
    }
    for (std::size_t k = 0; k < 3; ++k) gradient_[3 * row + k] += pull[k];
    soften(kernel_curvature, batch.kernel, robust, squared, pull, &inside_[18 * row]);
  }
}

/// Pull of a smoothness residual, and its stiffness: D w (I - c u u^T) D with D the inverse sigmas, u the direction of
/// the whitened residual and c the part of the kernel's falloff that counts.
void TrajectorySystem::linearize_smoothness(const Batch& batch, std::size_t n, double kernel_curvature, const double* r,
                                            double* pull, double* stiffness) const {
  const double* inverse_sigma = &batch.inverse_sigma[3 * n];
  double squared = 0.0;
  for (int a = 0; a < 3; ++a) squared += r[a] * inverse_sigma[a] * r[a] * inverse_sigma[a];
  const double robust = batch.weight[n] * weight(batch.kernel, squared);
  std::fill_n(stiffness, 6, 0.0);
  for (int a = 0; a < 3; ++a) {
    stiffness[kDiagonal[a]] = robust * inverse_sigma[a] * inverse_sigma[a];
    pull[a] = stiffness[kDiagonal[a]] * r[a];
  }
  soften(kernel_curvature, batch.kernel, robust, squared, pull, stiffness);
}

/// Copy what factors within a track gave to the blocks of a chunk, and add the part of ARAP.
void TrajectorySystem::gather_arap(int chunk) {
  const auto c = static_cast<std::size_t>(chunk);
  const auto begin = static_cast<std::size_t>(track_start_[static_cast<std::size_t>(chunk_tracks_[c])]);
  const auto end = static_cast<std::size_t>(track_start_[static_cast<std::size_t>(chunk_tracks_[c + 1])]);
  for (std::size_t p = begin; p < end; ++p) {
    const double* own = &inside_[18 * p];
    double* block = &blocks_[24 * p];
    double* gradient = &gradient_[3 * p];
    std::copy_n(own, 6, block);
    for (int i = 0; i < 6; ++i) {
      const int upper = 3 * kRowOf[i] + kColumnOf[i], lower = 3 * kColumnOf[i] + kRowOf[i];
      block[6 + upper] = block[6 + lower] = own[6 + i];
      block[15 + upper] = block[15 + lower] = own[12 + i];
    }
    const auto add_edge = [&](std::size_t e, double sign) {
      const double* direction = &direction_[3 * e];
      const double force = sign * edge_force_[e];
      for (int a = 0; a < 3; ++a) gradient[a] += force * direction[a];
      add_square(edge_diagonal_[e], direction, block);
    };
    for (std::int32_t e = low_start_[p]; e < low_start_[p + 1]; ++e) add_edge(static_cast<std::size_t>(e), 1.0);
    for (std::int32_t i = high_start_[p]; i < high_start_[p + 1]; ++i) {
      add_edge(static_cast<std::size_t>(high_edge_[static_cast<std::size_t>(i)]), -1.0);
    }
    for (std::int32_t i = lag_start_[p]; i < lag_start_[p + 1]; ++i) {
      const LagEntry& entry = lag_entries_[static_cast<std::size_t>(i)];
      const auto f = static_cast<std::size_t>(entry.factor);
      const double* now = &direction_[3 * static_cast<std::size_t>(factor_now_[f])];
      const double* after = &direction_[3 * static_cast<std::size_t>(factor_after_[f])];
      // The directions enter the residual with opposite signs. Rows of the block are the later point's.
      add_outer(-factor_weight_[f], entry.after_is_later ? after : now, entry.after_is_later ? now : after,
                block + (entry.lag == 1 ? 6 : 15));
    }
  }
}

/// Add one product of two slots' Jacobians within a track; rows beyond the bands are left out.
void TrajectorySystem::add_block(std::int32_t row, std::int32_t column, bool all_lags, double scale, const double* a,
                                 const double* b) {
  if (track_of_[static_cast<std::size_t>(row)] != track_of_[static_cast<std::size_t>(column)]) return;
  const std::int32_t lag = row - column;
  double* block = &blocks_[24 * static_cast<std::size_t>(row)];
  if (lag == 0) {
    for (int i = 0; i < 6; ++i) block[i] += scale * a[kRowOf[i]] * b[kColumnOf[i]];
  } else if (all_lags && (lag == 1 || lag == 2)) {
    add_outer(scale, a, b, block + (lag == 1 ? 6 : 15));
  }
}

/// Add the blocks of ARAP factors that link a track with itself or points far apart in time; few, if any.
void TrajectorySystem::add_irregular_arap() {
  for (const std::int32_t factor : irregular_) {
    const auto f = static_cast<std::size_t>(factor);
    const auto now = static_cast<std::size_t>(factor_now_[f]), after = static_cast<std::size_t>(factor_after_[f]);
    const std::int32_t rows[4] = {edge_low_[now], edge_high_[now], edge_low_[after], edge_high_[after]};
    const double* directions[4] = {&direction_[3 * now], &direction_[3 * now], &direction_[3 * after],
                                   &direction_[3 * after]};
    const double signs[4] = {1.0, -1.0, -1.0, 1.0};
    const bool all_lags = complete(rows, 4);
    for (int i = 0; i < 4; ++i) {
      for (int j = 0; j < 4; ++j) {
        add_block(rows[i], rows[j], all_lags, signs[i] * signs[j] * factor_weight_[f], directions[i], directions[j]);
      }
    }
  }
}

/// Add smoothness factors between tracks or beyond the bands; few, if any.
void TrajectorySystem::linearize_loose(const Batch& batch, int batch_index, const double* points,
                                       double kernel_curvature, NonFinite& bad) {
  const double* factor = smoothness_jacobian(batch.slots);
  const double unit[3][3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
  for (std::int32_t i = batch.first_loose; i < batch.size(); ++i) {
    const auto n = static_cast<std::size_t>(i);
    const std::int32_t* rows = &batch.rows[n * static_cast<std::size_t>(batch.slots)];
    double r[3], pull[3], stiffness[6];
    smoothness_residual(points, rows, batch.slots, r);
    if (!std::isfinite(r[0] + r[1] + r[2])) bad.merge({batch_index, batch.original[n]});
    linearize_smoothness(batch, n, kernel_curvature, r, pull, stiffness);
    loose_stiffness_.insert(loose_stiffness_.end(), stiffness, stiffness + 6);
    const bool all_lags = complete(rows, batch.slots);
    for (int s = 0; s < batch.slots; ++s) {
      for (std::size_t a = 0; a < 3; ++a) gradient_[3 * static_cast<std::size_t>(rows[s]) + a] += factor[s] * pull[a];
      for (int t = 0; t < batch.slots; ++t) {
        for (int entry = 0; entry < 6; ++entry) {
          const double product = factor[s] * factor[t] * stiffness[entry];
          const int row = kRowOf[entry], column = kColumnOf[entry];
          add_block(rows[s], rows[t], all_lags, product, unit[row], unit[column]);
          if (row != column) add_block(rows[s], rows[t], all_lags, product, unit[column], unit[row]);
        }
      }
    }
  }
}

/// Add the product of the smoothness factors between tracks or beyond the bands with a vector.
void TrajectorySystem::multiply_loose(const double* vector, double* result) const {
  std::size_t position = 0;
  for (const Batch& batch : batches_) {
    if (batch.kind != Kind::kSmoothness) continue;
    const double* factor = smoothness_jacobian(batch.slots);
    for (std::int32_t i = batch.first_loose; i < batch.size(); ++i, position += 6) {
      const std::int32_t* rows = &batch.rows[static_cast<std::size_t>(i) * static_cast<std::size_t>(batch.slots)];
      double change[3] = {0.0, 0.0, 0.0}, pull[3] = {0.0, 0.0, 0.0};
      for (int s = 0; s < batch.slots; ++s) {
        for (std::size_t a = 0; a < 3; ++a) change[a] += factor[s] * vector[3 * static_cast<std::size_t>(rows[s]) + a];
      }
      add_symmetric_product(&loose_stiffness_[position], change, pull);
      for (int s = 0; s < batch.slots; ++s) {
        for (std::size_t a = 0; a < 3; ++a) result[3 * static_cast<std::size_t>(rows[s]) + a] += factor[s] * pull[a];
      }
    }
  }
}

std::array<double, 6> TrajectorySystem::diagonal_block(std::int64_t point) const {
  std::array<double, 6> out;
  std::copy_n(&blocks_[24 * static_cast<std::size_t>(point)], 6, out.begin());
  return out;
}

}  // namespace uni4d_fg
