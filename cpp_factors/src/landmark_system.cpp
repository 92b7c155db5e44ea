#include "uni4d_fg/landmark_system.hpp"

#include <algorithm>
#include <atomic>
#include <stdexcept>
#include <string>
#include <utility>

#include "landmark_cholesky.hpp"
#include "landmark_frame_sums.hpp"
#include "landmark_passes.hpp"
#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

using landmark_cholesky::clamp;
using landmark_cholesky::factorize;
using landmark_cholesky::solve_lower;
using landmark_cholesky::solve_upper;
using landmark_passes::kWidth;

namespace {

constexpr std::size_t kTile = kFrameColumns * kSimd8Width;
constexpr int kSumWidth = frame_sums::kSums * kSimd8Width;

std::vector<Kernel> kernels_of(const std::vector<LandmarkBatch>& batches) {
  std::vector<Kernel> kernels;
  for (const LandmarkBatch& batch : batches) kernels.push_back(batch.kernel);
  // Groups without a factor of a family refer to its first kernel.
  if (kernels.empty()) kernels.emplace_back();
  return kernels;
}

}  // namespace

LandmarkSystem::LandmarkSystem(LandmarkProblem problem, int threads)
    : problem_(std::move(problem)),
      threads_(threads),
      reprojection_kernels_(kernels_of(problem_.reprojection)),
      depth_kernels_(kernels_of(problem_.depth)),
      num_reprojection_(static_cast<int>(problem_.reprojection.size())),
      num_depth_(static_cast<int>(problem_.depth.size())),
      plan_(plan_landmarks(problem_, threads)) {
  for (std::size_t i = 0; i < problem_.columns.size(); ++i)
    poses_free_ = poses_free_ || (problem_.columns[i] >= 0 && i % kFrameColumns < kFrameColumns - 1);
  problem_.reprojection.clear();
  problem_.depth.clear();
  coupling_.resize(static_cast<std::size_t>(plan_.num_pairs) * kWidth);
  landmarks_.assign(static_cast<std::size_t>(problem_.num_landmarks) * kWidth, 0.0);
  factors_.resize(static_cast<std::size_t>(problem_.num_landmarks) * 6);
  for (int part = 0; part < plan_.num_parts(); ++part) parts_.push_back(make_part(part));
  std::size_t most_pairs = 0, most_frames = 0;
  for (const LandmarkChunk& chunk : plan_.chunks) {
    if (chunk.frozen) continue;
    most_pairs = std::max(most_pairs, chunk.pair_landmark.size());
    most_frames = std::max(most_frames, chunk.frames.size());
  }
  scratch_.resize(static_cast<std::size_t>(workers()));
  for (Scratch& scratch : scratch_) {
    scratch.border.resize(kChunkLandmarks * kWidth);
    scratch.rows.resize(poses_free_ ? most_pairs * kWidth : most_frames * landmark_passes::kScaleRow);
    scratch.place.resize(most_frames * kChunkLandmarks);
  }
}

LandmarkSystem::Part LandmarkSystem::make_part(int index) const {
  const auto frames = static_cast<std::size_t>(problem_.num_frames);
  Part part;
  part.frames_begin = problem_.num_frames;
  part.last_frame.assign(frames, -1);
  for_chunks(static_cast<std::size_t>(index), [&](const LandmarkChunk& chunk) {
    if (chunk.frames.empty()) return;
    part.frames_begin = std::min(part.frames_begin, chunk.frames.front());
    part.frames_end = std::max(part.frames_end, chunk.frames.back() + 1);
    if (chunk.frozen) return;
    for (std::size_t a = 0; a < chunk.frames.size(); ++a)
      for (std::size_t b = chunk.frames.size(); b-- > a;)
        if ((chunk.seen[a] & chunk.seen[b]) != 0) {
          int& last = part.last_frame[static_cast<std::size_t>(chunk.frames[a])];
          last = std::max(last, chunk.frames[b]);
          break;
        }
  });
  check_storage(part.last_frame);
  part.frames_begin = std::min(part.frames_begin, part.frames_end);
  part.frame_sums.resize(static_cast<std::size_t>(part.frames_end - part.frames_begin) * kSumWidth);
  part.tile_begin.assign(frames + 1, 0);
  for (std::size_t f = 0; f < frames; ++f)
    part.tile_begin[f + 1] = part.tile_begin[f] + std::max(part.last_frame[f] - static_cast<int>(f) + 1, 0);
  part.tiles.resize((static_cast<std::size_t>(part.tile_begin[frames]) + frames + 1) * kTile);
  return part;
}

template <typename F>
void LandmarkSystem::for_parts(F f) const {
  parallel_for(plan_.num_parts(), threads_, [&](int begin, int end, int worker) {
    for (int part = begin; part < end; ++part) f(static_cast<std::size_t>(part), static_cast<std::size_t>(worker));
  });
}

template <typename F>
void LandmarkSystem::for_chunks(std::size_t part, F f) const {
  for (int i = plan_.part_begin[part]; i < plan_.part_begin[part + 1]; ++i)
    f(plan_.chunks[static_cast<std::size_t>(i)]);
}

void LandmarkSystem::check_storage(const std::vector<int>& last_frame) const {
  for (int frame = 0; frame < problem_.num_frames; ++frame) {
    const int last = std::max(last_frame[static_cast<std::size_t>(frame)], frame);
    const auto begin = problem_.columns.begin() + frame * kFrameColumns;
    const auto end = problem_.columns.begin() + (last + 1) * kFrameColumns;
    const auto lowest = std::find_if(begin, end, [](int column) { return column >= 0; });
    if (lowest == end) continue;
    const int span = *std::max_element(begin, end) - *lowest + 1;
    if (span > problem_.stored_rows)
      throw std::invalid_argument("stored_rows: " + std::to_string(problem_.stored_rows) + " are too few; frames " +
                                  std::to_string(frame) + " and " + std::to_string(last) +
                                  " share a landmark and span " + std::to_string(span) + " columns");
  }
}

void LandmarkSystem::energies(const LandmarkState& state, double* out) const {
  const landmark_passes::PassInput in{state, reprojection_kernels_.data(), depth_kernels_.data()};
  const std::size_t reprojections = reprojection_kernels_.size(), depths = depth_kernels_.size();
  std::vector<AlignedDoubles> sums(parts_.size(), AlignedDoubles((reprojections + depths) * kSimd8Width, 0.0));
  for_parts([&](std::size_t part, std::size_t) {
    double* own = sums[part].data();
    for_chunks(part, [&](const LandmarkChunk& chunk) {
      if (num_depth_ > 0)
        landmark_passes::energies_depth(in, chunk, own, own + reprojections * kSimd8Width);
      else
        landmark_passes::energies_plain(in, chunk, own);
    });
  });
  for (int batch = 0; batch < num_batches(); ++batch) {
    const std::size_t place = batch < num_reprojection_
                                  ? static_cast<std::size_t>(batch)
                                  : reprojections + static_cast<std::size_t>(batch - num_reprojection_);
    out[batch] = 0.0;
    for (const AlignedDoubles& own : sums) out[batch] += sum(load<Simd8<kOwnBytes>>(own.data() + place * kSimd8Width));
  }
}

void LandmarkSystem::settle_landmarks(const LandmarkState& state, const DampingBounds& bounds, int iterations,
                                      double* landmarks) const {
  std::copy_n(state.landmarks, 3 * static_cast<std::size_t>(problem_.num_landmarks), landmarks);
  const landmark_passes::PassInput in{state, reprojection_kernels_.data(), depth_kernels_.data()};
  const auto settle = num_depth_ > 0 ? landmark_passes::settle_points_with_depth : landmark_passes::settle_points;
  for_parts([&](std::size_t part, std::size_t) {
    for_chunks(part, [&](const LandmarkChunk& chunk) {
      if (!chunk.frozen) settle(in, chunk, bounds, iterations, landmarks);
    });
  });
}

LinearizeResult LandmarkSystem::linearize(const LandmarkState& state, const CameraSystem& system) {
  linearized_ = reduced_ = false;
  const landmark_passes::PassInput in{state, reprojection_kernels_.data(), depth_kernels_.data()};
  const landmark_passes::Linearize pass =
      num_depth_ > 0
          ? (problem_.intrinsics_free ? landmark_passes::linearize_depth_intrinsics : landmark_passes::linearize_depth)
          : (problem_.intrinsics_free ? landmark_passes::linearize_intrinsics : landmark_passes::linearize_plain);
  std::vector<LinearizeResult> results(parts_.size());
  for_parts([&](std::size_t index, std::size_t) {
    Part& part = parts_[index];
    std::fill(part.frame_sums.begin(), part.frame_sums.end(), 0.0);
    // Such that the sums of a frame are where the pass looks for them, counting from frame 0.
    double* sums = part.frame_sums.data() - static_cast<std::ptrdiff_t>(part.frames_begin) * kSumWidth;
    LinearizeResult& result = results[index];
    for_chunks(index, [&](const LandmarkChunk& chunk) {
      pass(in, chunk, sums, coupling_.data() + chunk.first_pair * kWidth, landmarks_.data());
      if (chunk.frozen) return;
      for (const int row : chunk.landmarks) {
        const double* landmark = landmarks_.data() + static_cast<std::size_t>(row) * kWidth;
        double difference = 0.0;
        for (int k = 0; k < 9; ++k) difference += landmark[k] - landmark[k];
        result.finite = result.finite && difference == 0.0;
        for (int k = 6; k < 9; ++k)
          result.landmark_gradient_max = std::max(result.landmark_gradient_max, std::abs(landmark[k]));
      }
    });
  });
  write_camera_blocks(system);
  LinearizeResult total;
  for (const LinearizeResult& result : results) {
    total.finite = total.finite && result.finite;
    total.landmark_gradient_max = std::max(total.landmark_gradient_max, result.landmark_gradient_max);
  }
  const int size = problem_.num_columns + kBorder;
  for (int i = 0; i < size; ++i) total.finite = total.finite && std::isfinite(system.gradient[i]);
  linearized_ = true;
  return total;
}

double* LandmarkSystem::core_column(const CameraSystem& system, int column) const {
  // Such that entry (i, column) is at [i]. A dense core has it at column * rows + i, a banded one at
  // column * rows + (i - column): hence the start is `column` earlier there.
  const auto offset = static_cast<std::ptrdiff_t>(column) * problem_.stored_rows;
  return system.core + offset - (problem_.banded ? column : 0);
}

void LandmarkSystem::write_camera_blocks(const CameraSystem& system) const {
  using namespace frame_sums;
  const auto size = static_cast<std::size_t>(problem_.num_columns);
  const auto stored = static_cast<std::size_t>(problem_.stored_rows);
  double intrinsics[kSums - kIntrinsicsU] = {};
  parallel_for(problem_.num_columns, workers(), [&](int begin, int end, int) {
    std::fill(system.core + static_cast<std::size_t>(begin) * stored,
              system.core + static_cast<std::size_t>(end) * stored, 0.0);
  });
  std::fill_n(system.border, size * kBorder, 0.0);
  std::fill_n(system.corner, kBorder * kBorder, 0.0);
  std::fill_n(system.gradient, size + kBorder, 0.0);
  for (int frame = 0; frame < problem_.num_frames; ++frame) {
    double total[kSums] = {};
    for (const Part& part : parts_) {
      if (frame < part.frames_begin || frame >= part.frames_end) continue;
      const double* sums = part.frame_sums.data() + static_cast<std::size_t>(frame - part.frames_begin) * kSumWidth;
      for (int k = 0; k < kSums; ++k) total[k] += sum(load<Simd8<kOwnBytes>>(sums + k * kSimd8Width));
    }
    for (int k = kIntrinsicsU; k < kSums; ++k) intrinsics[k - kIntrinsicsU] += total[k];
    double block[kFrameColumns][kFrameColumns] = {}, gradient[kFrameColumns], border[kFrameColumns][kBorder] = {};
    for (int row = 0; row < 6; ++row) {
      for (int column = 0; column <= row; ++column) block[row][column] = total[kPose + lower(row, column)];
      gradient[row] = total[kPoseGradient + row];
    }
    for (int k = 0; k < 3; ++k) block[6][kPoseOfDepth[k]] = total[kPoseScale + k];
    block[6][6] = total[kScale];
    gradient[6] = total[kScale + 1];
    for (int k = 0; k < 5; ++k) {
      border[kPoseOfU[k]][0] = total[kPoseU + 2 * k];
      border[kPoseOfU[k]][2] = total[kPoseU + 2 * k + 1];
      border[kPoseOfV[k]][1] = total[kPoseV + 2 * k];
      border[kPoseOfV[k]][3] = total[kPoseV + 2 * k + 1];
    }
    const int* columns = problem_.columns.data() + static_cast<std::size_t>(frame) * kFrameColumns;
    for (int row = 0; row < kFrameColumns; ++row) {
      if (columns[row] < 0) continue;
      for (int column = 0; column <= row; ++column)
        if (columns[column] >= 0) core_column(system, columns[column])[columns[row]] = block[row][column];
      for (int k = 0; k < kBorder; ++k) system.border[columns[row] * kBorder + k] = border[row][k];
      system.gradient[columns[row]] = gradient[row];
    }
  }
  const double* u = intrinsics;
  const double* v = intrinsics + kIntrinsicsV - kIntrinsicsU;
  double* corner = system.corner;
  corner[0] = u[0];
  corner[2] = corner[8] = u[1];
  corner[10] = u[2];
  corner[5] = v[0];
  corner[7] = corner[13] = v[1];
  corner[15] = v[2];
  for (std::size_t k = 0; k < kBorder; ++k)
    system.gradient[size + k] = intrinsics[kIntrinsicsGradient - kIntrinsicsU + static_cast<int>(k)];
}

void LandmarkSystem::landmark_blocks(double* blocks, double* gradients) const {
  constexpr int kPlace[9] = {0, 1, 2, 1, 3, 4, 2, 4, 5};
  for (std::size_t i = 0; i < static_cast<std::size_t>(problem_.num_landmarks); ++i) {
    const double* landmark = landmarks_.data() + i * kWidth;
    for (std::size_t k = 0; k < 9; ++k) blocks[9 * i + k] = landmark[kPlace[k]];
    for (std::size_t k = 0; k < 3; ++k) gradients[3 * i + k] = landmark[6 + k];
  }
}

bool LandmarkSystem::eliminate_chunk(const LandmarkChunk& chunk, const DampingBounds& bounds, Part& part,
                                     Scratch& scratch) {
  double factors[6 * kChunkLandmarks];
  double* border = scratch.border.data();
  double* whitened = scratch.rows.data();
  for (std::size_t i = 0; i < chunk.landmarks.size(); ++i) {
    const auto row = static_cast<std::size_t>(chunk.landmarks[i]);
    const double* landmark = landmarks_.data() + row * kWidth;
    double* factor = factors + 6 * i;
    if (!factorize(landmark, bounds, factor)) return false;
    std::copy_n(factor, 6, factors_.data() + 6 * row);
    for (std::size_t k = 0; k <= kBorder; ++k) {
      double x[3];
      for (std::size_t j = 0; j < 3; ++j) x[j] = k < kBorder ? landmark[9 + kBorder * j + k] : landmark[6 + j];
      solve_lower(factor, x);
      for (std::size_t j = 0; j < 3; ++j) border[i * kWidth + kSimd8Width * j + k] = x[j];
    }
    for (std::size_t j = 0; j < 3; ++j) std::fill_n(border + i * kWidth + kSimd8Width * j + kBorder + 1, 3, 0.0);
  }
  if (chunk.frames.empty()) return true;
  std::fill_n(border + chunk.landmarks.size() * kWidth, (kChunkLandmarks - chunk.landmarks.size()) * kWidth, 0.0);
  const double* coupling = coupling_.data() + chunk.first_pair * kWidth;
  double* tiles = part.tiles.data();
  const auto frames = static_cast<std::size_t>(problem_.num_frames);
  double* border_tiles = tiles + static_cast<std::size_t>(part.tile_begin[frames]) * kTile;
  int* place = scratch.place.data();
  const landmark_passes::TileInput input{
      whitened, border, place, part.tile_begin.data(), tiles, border_tiles, border_tiles + frames * kTile};
  if (!poses_free_) {
    landmark_passes::multiply_scales(chunk, coupling, factors, whitened, input);
    return true;
  }
  landmark_passes::whiten_pairs(chunk, coupling, factors, whitened);
  for (std::size_t f = 0; f < chunk.frames.size(); ++f)
    for (int i = chunk.frame_begin[f]; i < chunk.frame_begin[f + 1]; ++i)
      place[f * kChunkLandmarks + chunk.pair_landmark[static_cast<std::size_t>(i)]] = i;
  landmark_passes::multiply_tiles(chunk, input);
  return true;
}

bool LandmarkSystem::reduce(const DampingBounds& bounds, const CameraSystem& hessian, const CameraSystem& reduced) {
  reduced_ = false;
  std::atomic<bool> positive{true};
  for_parts([&](std::size_t index, std::size_t worker) {
    Part& part = parts_[index];
    std::fill(part.tiles.begin(), part.tiles.end(), 0.0);
    for_chunks(index, [&](const LandmarkChunk& chunk) {
      if (positive && !chunk.frozen && !eliminate_chunk(chunk, bounds, part, scratch_[worker])) positive = false;
    });
  });
  if (!positive) return false;
  write_reduced(bounds, hessian, reduced);
  bounds_ = bounds;
  return reduced_ = true;
}

void LandmarkSystem::write_reduced(const DampingBounds& bounds, const CameraSystem& hessian,
                                   const CameraSystem& reduced) const {
  const int size = problem_.num_columns;
  const auto stored = static_cast<std::size_t>(problem_.stored_rows);
  parallel_for(size, workers(), [&](int begin, int end, int) {
    const auto first = static_cast<std::size_t>(begin) * stored, last = static_cast<std::size_t>(end) * stored;
    std::copy(hessian.core + first, hessian.core + last, reduced.core + first);
    for (int i = begin; i < end; ++i) {
      double& diagonal = core_column(reduced, i)[i];
      diagonal += bounds.damping * clamp(diagonal, bounds);
    }
  });
  std::copy_n(hessian.border, size * kBorder, reduced.border);
  std::copy_n(hessian.corner, kBorder * kBorder, reduced.corner);
  for (int k = 0; k < kBorder; ++k)
    reduced.corner[k * (kBorder + 1)] += bounds.damping * clamp(hessian.corner[k * (kBorder + 1)], bounds);
  for (int i = 0; i < size + kBorder; ++i) reduced.gradient[i] = -hessian.gradient[i];

  const auto frames = static_cast<std::size_t>(problem_.num_frames);
  parallel_for(problem_.num_frames, workers(), [&](int begin, int end, int) {
    for (int frame = begin; frame < end; ++frame) {
      const auto f = static_cast<std::size_t>(frame);
      const int* columns = problem_.columns.data() + f * kFrameColumns;
      for (const Part& part : parts_) {
        if (frame < part.frames_begin || frame >= part.frames_end) continue;
        const double* tile = part.tiles.data() + static_cast<std::size_t>(part.tile_begin[f]) * kTile;
        // Tile (frame, other) has rows of `frame` and columns of `other` >= frame. The core stores its lower triangle
        // by columns: entry (row of `other`, column of `frame`), and within the tile of a frame with itself j >= i.
        for (int other = frame; other <= part.last_frame[f]; ++other, tile += kTile) {
          const int* rows = problem_.columns.data() + static_cast<std::size_t>(other) * kFrameColumns;
          for (int i = 0; i < kFrameColumns; ++i) {
            if (columns[i] < 0) continue;
            double* column = core_column(reduced, columns[i]);
            for (int j = other == frame ? i : 0; j < kFrameColumns; ++j)
              if (rows[j] >= 0) column[rows[j]] -= tile[i * kSimd8Width + j];
          }
        }
        const double* border = part.tiles.data() + (static_cast<std::size_t>(part.tile_begin[frames]) + f) * kTile;
        for (int i = 0; i < kFrameColumns; ++i) {
          if (columns[i] < 0) continue;
          for (int k = 0; k < kBorder; ++k) reduced.border[columns[i] * kBorder + k] -= border[i * kSimd8Width + k];
          reduced.gradient[columns[i]] += border[i * kSimd8Width + kBorder];
        }
      }
    }
  });
  for (const Part& part : parts_) {
    const double* corner = part.tiles.data() + (static_cast<std::size_t>(part.tile_begin[frames]) + frames) * kTile;
    for (int i = 0; i < kBorder; ++i) {
      for (int k = 0; k < kBorder; ++k) reduced.corner[i * kBorder + k] -= corner[i * kSimd8Width + k];
      reduced.gradient[size + i] += corner[i * kSimd8Width + kBorder];
    }
  }
}

StepSums LandmarkSystem::back_substitute(const double* camera_step, const double* extra, double* landmark_step) const {
  AlignedDoubles frame_step(static_cast<std::size_t>(problem_.num_frames) * kSimd8Width, 0.0);
  for (std::size_t f = 0; f < static_cast<std::size_t>(problem_.num_frames); ++f)
    for (std::size_t k = 0; k < kFrameColumns; ++k) {
      const int column = problem_.columns[f * kFrameColumns + k];
      if (column >= 0) frame_step[f * kSimd8Width + k] = camera_step[column];
    }
  const double* intrinsics_step = camera_step + problem_.num_columns;
  std::fill_n(landmark_step, 3 * static_cast<std::size_t>(problem_.num_landmarks), 0.0);
  std::vector<StepSums> sums(parts_.size());
  for_parts([&](std::size_t part, std::size_t) {
    StepSums own;
    for_chunks(part, [&](const LandmarkChunk& chunk) {
      if (chunk.frozen) return;
      double moved[3 * kChunkLandmarks] = {};
      landmark_passes::apply_coupling(chunk, coupling_.data() + chunk.first_pair * kWidth, frame_step.data(), moved);
      for (std::size_t n = 0; n < chunk.landmarks.size(); ++n) {
        const auto row = static_cast<std::size_t>(chunk.landmarks[n]);
        const double* landmark = landmarks_.data() + row * kWidth;
        double x[3];
        for (std::size_t j = 0; j < 3; ++j) {
          x[j] = landmark[6 + j] + moved[3 * n + j] + (extra != nullptr ? extra[3 * row + j] : 0.0);
          for (std::size_t k = 0; k < kBorder; ++k) x[j] += landmark[9 + kBorder * j + k] * intrinsics_step[k];
        }
        solve_lower(factors_.data() + 6 * row, x);
        solve_upper(factors_.data() + 6 * row, x);
        for (std::size_t j = 0; j < 3; ++j) {
          landmark_step[3 * row + j] = -x[j];
          own.slope -= landmark[6 + j] * x[j];
          own.damped += clamp(landmark[kDiagonal[j]], bounds_) * x[j] * x[j];
          own.squared += x[j] * x[j];
        }
      }
    });
    sums[part] = own;
  });
  StepSums total;
  for (const StepSums& own : sums) {
    total.slope += own.slope;
    total.damped += own.damped;
    total.squared += own.squared;
  }
  return total;
}

}  // namespace uni4d_fg
