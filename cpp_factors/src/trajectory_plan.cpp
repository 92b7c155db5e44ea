// Building a TrajectorySystem: copying batches and ordering factors, so that every later sum has a fixed order.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <numeric>

#include "uni4d_fg/trajectory_system.hpp"

namespace uni4d_fg {
namespace {

constexpr std::int32_t kChunkPoints = 512;

/// Return values (N, width) with their rows in a new order.
template <typename T>
std::vector<T> permuted(const std::vector<T>& values, const std::vector<std::int32_t>& order, std::size_t width) {
  std::vector<T> out(values.size());
  for (std::size_t i = 0; i < order.size(); ++i) {
    std::copy_n(values.begin() + static_cast<std::ptrdiff_t>(static_cast<std::size_t>(order[i]) * width), width,
                out.begin() + static_cast<std::ptrdiff_t>(i * width));
  }
  return out;
}

// Lists of unequal length ("the factors of each chunk") are stored one after another: list i from start[i] up to
// start[i + 1]. They are filled as in a counting sort: count the members of list i at start[i + 1], sum up, and then
// place each member at next[i]++, where next begins as a copy of the starts. Members keep their order, so that later
// sums are always the same.

/// Turn counts stored at [i + 1] into starts, in place.
void accumulate_starts(std::vector<std::int32_t>& starts) {
  std::partial_sum(starts.begin(), starts.end(), starts.begin());
}

}  // namespace

TrajectorySystem::TrajectorySystem(const std::int64_t* track, std::int64_t num_points, int threads)
    : num_points_(num_points), threads_(std::max(threads, 1)) {
  track_of_.resize(static_cast<std::size_t>(num_points));
  for (std::int64_t i = 0; i < num_points; ++i) {
    if (i == 0 || track[i] != track[i - 1]) track_start_.push_back(static_cast<std::int32_t>(i));
    track_of_[static_cast<std::size_t>(i)] = static_cast<std::int32_t>(track_start_.size()) - 1;
  }
  track_start_.push_back(static_cast<std::int32_t>(num_points));
}

TrajectorySystem::Batch TrajectorySystem::make_batch(const TrajectoryRows& rows, Kind kind, int slots, int dim) const {
  Batch batch;
  batch.kind = kind;
  batch.slots = slots;
  batch.dim = dim;
  batch.kernel = rows.kernel;
  const auto count = static_cast<std::size_t>(rows.count);
  batch.rows.assign(rows.rows, rows.rows + count * static_cast<std::size_t>(slots));
  batch.weight.assign(rows.weight, rows.weight + count);
  batch.inverse_sigma.resize(count * static_cast<std::size_t>(dim));
  for (std::size_t i = 0; i < batch.inverse_sigma.size(); ++i) {
    batch.inverse_sigma[i] = 1.0 / rows.sigma[rows.sigma_per_component ? i : i / static_cast<std::size_t>(dim)];
  }
  batch.original.resize(count);
  std::iota(batch.original.begin(), batch.original.end(), 0);
  return batch;
}

std::int32_t TrajectorySystem::camera_index(const double* world_T_cam, const double* intrinsics) {
  const FrozenCamera camera{load_pose(world_T_cam), load_intrinsics(intrinsics)};
  const auto same = [&](std::int32_t index) {
    return std::memcmp(&cameras_[static_cast<std::size_t>(index)], &camera, sizeof camera) == 0;
  };
  // Observations of a track follow each other frame by frame: the camera after the last one is the likely one.
  const auto count = static_cast<std::int32_t>(cameras_.size());
  for (std::int32_t guess = last_camera_; guess <= last_camera_ + 2; ++guess) {
    if (guess >= 0 && guess < count && same(guess)) return last_camera_ = guess;
  }
  if (camera_buckets_.empty()) camera_buckets_.resize(1024);
  std::uint64_t hash = 1469598103934665603ULL;
  const Vec3& center = camera.pose.center;
  for (const double value : {center.x, center.y, center.z, camera.pose.rotation(0, 1)}) {
    std::uint64_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    hash = (hash ^ (bits >> 20)) * 1099511628211ULL;
  }
  auto& bucket = camera_buckets_[(hash >> 32) % camera_buckets_.size()];
  for (const std::int32_t index : bucket) {
    if (same(index)) return last_camera_ = index;
  }
  bucket.push_back(count);
  cameras_.push_back(camera);
  return last_camera_ = count;
}

void TrajectorySystem::add_dynamic_reprojection(const TrajectoryRows& rows, const double* uv, const double* world_T_cam,
                                                const double* intrinsics) {
  Batch batch = make_batch(rows, Kind::kReprojection, 1, 2);
  batch.observed.assign(uv, uv + 2 * rows.count);
  for (std::int64_t i = 0; i < rows.count; ++i) {
    batch.camera.push_back(camera_index(world_T_cam + 16 * i, intrinsics + 4 * i));
  }
  batches_.push_back(std::move(batch));
}

void TrajectorySystem::add_dynamic_depth_prior(const TrajectoryRows& rows, const double* depth,
                                               const double* world_T_cam, const double* log_scale) {
  const double unused[4] = {0.0, 0.0, 0.0, 0.0};
  Batch batch = make_batch(rows, Kind::kDepth, 1, 1);
  for (std::int64_t i = 0; i < rows.count; ++i) {
    batch.observed.push_back(std::log(depth[i]) + log_scale[i]);
    batch.camera.push_back(camera_index(world_T_cam + 16 * i, unused));
  }
  batches_.push_back(std::move(batch));
}

void TrajectorySystem::add_smoothness(const TrajectoryRows& rows, int slots) {
  batches_.push_back(make_batch(rows, Kind::kSmoothness, slots, 3));
}

void TrajectorySystem::add_arap(const TrajectoryRows& rows) { batches_.push_back(make_batch(rows, Kind::kArap, 4, 1)); }

void TrajectorySystem::plan() {
  plan_chunks();
  for (Batch& batch : batches_) {
    if (batch.kind != Kind::kArap && batch.kind != Kind::kLinearized) plan_inside(batch);
  }
  plan_edges();
  plan_arap_blocks();
  plan_uses();
  const auto points = static_cast<std::size_t>(num_points_);
  for (auto* values : {&gradient_, &added_}) values->assign(3 * points, 0.0);
  inside_.assign(18 * points, 0.0);
  blocks_.assign(24 * points, 0.0);
  factor_.assign(24 * points, 0.0F);
  planned_ = true;
}

void TrajectorySystem::reweight(int batch, const double* weight, const Kernel& kernel) {
  Batch& target = batches_[static_cast<std::size_t>(batch)];
  linearized_ = false;
  if (target.kind == Kind::kLinearized) return;  // its arrays come with weights and kernels applied
  target.kernel = kernel;
  for (std::size_t i = 0; i < target.weight.size(); ++i) target.weight[i] = weight[target.original[i]];
}

/// Cut the tracks into chunks of about the same number of points, whatever the number of threads.
void TrajectorySystem::plan_chunks() {
  chunk_tracks_.assign(1, 0);
  const auto tracks = static_cast<std::int32_t>(track_start_.size()) - 1;
  for (std::int32_t track = 0; track < tracks; ++track) {
    const bool last = track + 1 == tracks;
    const std::int32_t begin = track_start_[static_cast<std::size_t>(chunk_tracks_.back())];
    if (last || track_start_[static_cast<std::size_t>(track) + 1] - begin >= kChunkPoints) {
      chunk_tracks_.push_back(track + 1);
    }
  }
  num_chunks_ = static_cast<int>(chunk_tracks_.size()) - 1;
}

/// Whether the blocks of a factor between points of one track all lie within the bands.
bool TrajectorySystem::complete(const std::int32_t* rows, int slots) const {
  for (int i = 0; i < slots; ++i) {
    for (int j = 0; j < i; ++j) {
      const auto p = static_cast<std::size_t>(rows[i]), q = static_cast<std::size_t>(rows[j]);
      if (track_of_[p] == track_of_[q] && std::abs(rows[i] - rows[j]) > 2) return false;
    }
  }
  return true;
}

/// Order a batch by chunk of tracks; smoothness factors that couple tracks, or points beyond the bands, go last.
///
/// Such a factor could write to any chunk: they get a group of their own behind the last chunk, which one thread works
/// on.
void TrajectorySystem::plan_inside(Batch& batch) {
  const auto count = static_cast<std::size_t>(batch.size());
  const auto slots = static_cast<std::size_t>(batch.slots);
  std::vector<std::int32_t> chunk_of_track(track_start_.size());
  for (std::int32_t chunk = 0; chunk < num_chunks_; ++chunk) {
    const auto c = static_cast<std::size_t>(chunk);
    for (std::int32_t t = chunk_tracks_[c]; t < chunk_tracks_[c + 1]; ++t)
      chunk_of_track[static_cast<std::size_t>(t)] = chunk;
  }
  std::vector<std::int32_t> group(count);
  for (std::size_t i = 0; i < count; ++i) {
    const std::int32_t* rows = &batch.rows[i * slots];
    const std::int32_t track = track_of_[static_cast<std::size_t>(rows[0])];
    bool one_track = true;
    for (std::size_t k = 1; k < slots; ++k) one_track &= track_of_[static_cast<std::size_t>(rows[k])] == track;
    const bool inside = one_track && complete(rows, batch.slots);
    group[i] = inside ? chunk_of_track[static_cast<std::size_t>(track)] : num_chunks_;
  }
  batch.chunk_start.assign(static_cast<std::size_t>(num_chunks_) + 2, 0);
  for (const std::int32_t g : group) ++batch.chunk_start[static_cast<std::size_t>(g) + 1];
  accumulate_starts(batch.chunk_start);
  std::vector<std::int32_t> order(count), next(batch.chunk_start.begin(), batch.chunk_start.end() - 1);
  for (std::size_t i = 0; i < count; ++i) {
    order[static_cast<std::size_t>(next[static_cast<std::size_t>(group[i])]++)] = static_cast<std::int32_t>(i);
  }
  batch.first_loose = batch.chunk_start[static_cast<std::size_t>(num_chunks_)];
  if (std::is_sorted(order.begin(), order.end())) return;
  batch.rows = permuted(batch.rows, order, slots);
  batch.inverse_sigma = permuted(batch.inverse_sigma, order, static_cast<std::size_t>(batch.dim));
  batch.weight = permuted(batch.weight, order, 1);
  batch.original = permuted(batch.original, order, 1);
  if (!batch.camera.empty()) batch.camera = permuted(batch.camera, order, 1);
  if (!batch.observed.empty()) batch.observed = permuted(batch.observed, order, batch.observed.size() / count);
}

/// Find the distinct distances of all ARAP factors, ordered by their lower and then their higher row.
///
/// Factor f with rows (p0, p1, p2, p3) uses two distances: (p0, p1) is use 2 f and (p2, p3) is use 2 f + 1, in the same
/// order as the pairs in `rows`. Uses of the same two rows are one edge. Afterwards:
///     edges of lower row p       low_start_[p] .. low_start_[p + 1], edges themselves (they are sorted by it)
///     edges of higher row p      high_edge_[high_start_[p] .. high_start_[p + 1]]
///     factors of edge e          entries_[entry_start_[e] .. entry_start_[e + 1]], each with its factor's other edge
///     edges of factor f          factor_now_[f], factor_after_[f]
void TrajectorySystem::plan_edges() {
  const auto points = static_cast<std::size_t>(num_points_);
  std::vector<std::int32_t> low, high;  // rows of every use, two uses per factor
  std::int32_t factors = 0;
  for (Batch& batch : batches_) {
    if (batch.kind != Kind::kArap) continue;
    batch.first_factor = factors;
    factors += batch.size();
    low.reserve(2 * static_cast<std::size_t>(factors));
    high.reserve(low.capacity());
    for (std::size_t i = 0; i < batch.rows.size(); i += 2) {
      low.push_back(std::min(batch.rows[i], batch.rows[i + 1]));
      high.push_back(std::max(batch.rows[i], batch.rows[i + 1]));
    }
  }
  std::vector<std::int32_t> start(points + 1, 0), uses(low.size()), edge_of(low.size());
  for (const std::int32_t p : low) ++start[static_cast<std::size_t>(p) + 1];
  accumulate_starts(start);
  std::vector<std::int32_t> next(start.begin(), start.end() - 1);
  for (std::size_t u = 0; u < low.size(); ++u) {
    uses[static_cast<std::size_t>(next[static_cast<std::size_t>(low[u])]++)] = static_cast<std::int32_t>(u);
  }
  low_start_.assign(points + 1, 0);
  for (std::size_t p = 0; p < points; ++p) {
    const auto begin = uses.begin() + start[p], end = uses.begin() + start[p + 1];
    // Uses of one lower row, by higher row: equal ones are neighbors then, and the first of them opens an edge.
    std::sort(begin, end, [&](std::int32_t a, std::int32_t b) {
      const std::int32_t p_a = high[static_cast<std::size_t>(a)], p_b = high[static_cast<std::size_t>(b)];
      return p_a != p_b ? p_a < p_b : a < b;
    });
    for (auto use = begin; use != end; ++use) {
      const auto u = static_cast<std::size_t>(*use);
      if (use == begin || high[u] != edge_high_.back()) {
        edge_low_.push_back(static_cast<std::int32_t>(p));
        edge_high_.push_back(high[u]);
      }
      edge_of[u] = static_cast<std::int32_t>(edge_low_.size()) - 1;
    }
    low_start_[p + 1] = static_cast<std::int32_t>(edge_low_.size());
  }
  const std::size_t edges = edge_low_.size(), count = static_cast<std::size_t>(factors);
  high_start_.assign(points + 1, 0);
  for (const std::int32_t p : edge_high_) ++high_start_[static_cast<std::size_t>(p) + 1];
  accumulate_starts(high_start_);
  high_edge_.resize(edges);
  next.assign(high_start_.begin(), high_start_.end() - 1);
  for (std::size_t e = 0; e < edges; ++e) {
    high_edge_[static_cast<std::size_t>(next[static_cast<std::size_t>(edge_high_[e])]++)] =
        static_cast<std::int32_t>(e);
  }
  factor_now_.resize(count);
  factor_after_.resize(count);
  entry_start_.assign(edges + 1, 0);
  for (std::size_t f = 0; f < count; ++f) {
    factor_now_[f] = edge_of[2 * f];
    factor_after_[f] = edge_of[2 * f + 1];
    ++entry_start_[static_cast<std::size_t>(factor_now_[f]) + 1];
    ++entry_start_[static_cast<std::size_t>(factor_after_[f]) + 1];
  }
  accumulate_starts(entry_start_);
  entries_.resize(2 * count);
  next.assign(entry_start_.begin(), entry_start_.end() - 1);
  for (std::size_t f = 0; f < count; ++f) {
    const std::int32_t now = factor_now_[f], after = factor_after_[f], factor = static_cast<std::int32_t>(f);
    entries_[static_cast<std::size_t>(next[static_cast<std::size_t>(now)]++)] = {factor, after};
    entries_[static_cast<std::size_t>(next[static_cast<std::size_t>(after)]++)] = {factor, now};
  }
  for (auto* values : {&distance_, &edge_stiffness_, &edge_force_, &edge_diagonal_}) {
    values->assign(edges, 0.0);
  }
  direction_.assign(3 * edges, 0.0);
  factor_weight_.assign(count, 0.0);
  factor_force_.assign(count, 0.0);
}

/// Whether an ARAP factor links two different tracks and its points of one track are one or two rows apart.
bool TrajectorySystem::regular(std::int32_t factor) const {
  const auto now = static_cast<std::size_t>(factor_now_[static_cast<std::size_t>(factor)]);
  const auto after = static_cast<std::size_t>(factor_after_[static_cast<std::size_t>(factor)]);
  const auto track = [&](std::int32_t row) { return track_of_[static_cast<std::size_t>(row)]; };
  const auto apart = [](std::int32_t a, std::int32_t b) { return a != b && std::abs(a - b) <= 2; };
  return track(edge_low_[now]) != track(edge_high_[now]) && track(edge_low_[now]) == track(edge_low_[after]) &&
         track(edge_high_[now]) == track(edge_high_[after]) && apart(edge_low_[now], edge_low_[after]) &&
         apart(edge_high_[now], edge_high_[after]);
}

/// Plan the products of ARAP's two directions at the points of one track.
///
/// A regular factor joins points (p, m) of two tracks at one frame with (p', m') at a later or earlier one. Its J^T J
/// has a block p' x p within the first track and m' x m within the second, one or two rows off the diagonal: two
/// entries, each listed with the later of its two points. Pass one counts, pass two fills.
void TrajectorySystem::plan_arap_blocks() {
  const std::size_t count = factor_now_.size();
  factor_regular_.assign(count, 0);
  lag_start_.assign(static_cast<std::size_t>(num_points_) + 1, 0);
  std::vector<std::int32_t> next;
  for (const bool counting : {true, false}) {
    if (!counting) {
      accumulate_starts(lag_start_);
      next.assign(lag_start_.begin(), lag_start_.end() - 1);
      lag_entries_.resize(static_cast<std::size_t>(lag_start_.back()));
    }
    for (std::size_t f = 0; f < count; ++f) {
      const auto factor = static_cast<std::int32_t>(f);
      if (counting && !(factor_regular_[f] = regular(factor))) irregular_.push_back(factor);
      if (!factor_regular_[f]) continue;
      const auto now = static_cast<std::size_t>(factor_now_[f]), after = static_cast<std::size_t>(factor_after_[f]);
      for (const auto* ends : {&edge_low_, &edge_high_}) {
        const std::int32_t p = (*ends)[now], q = (*ends)[after];
        const auto later = static_cast<std::size_t>(std::max(p, q));
        if (counting) {
          ++lag_start_[later + 1];
        } else {
          lag_entries_[static_cast<std::size_t>(next[later]++)] = {factor, q > p,
                                                                   static_cast<std::int8_t>(std::abs(p - q))};
        }
      }
    }
  }
}

}  // namespace uni4d_fg
