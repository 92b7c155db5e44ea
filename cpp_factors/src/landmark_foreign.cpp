// What a LandmarkSystem takes from, and tells, factors of types that it does not know.
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

#include "landmark_cholesky.hpp"
#include "landmark_passes.hpp"
#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

using landmark_passes::kWidth;

namespace {

/// Landmarks that are worth a thread.
constexpr int kGrain = 256;
/// Places of a 3x3 block's entries, row by row, in the six values xx xy xz yy yz zz.
constexpr int kPlaceOf[9] = {0, 1, 2, 1, 3, 4, 2, 4, 5};

}  // namespace

double LandmarkSystem::add_to_landmarks(std::int64_t count, const std::int64_t* rows, const double* blocks,
                                        const double* gradients) {
  reduced_ = false;
  // Rows may repeat: one thread, in their order.
  for (std::int64_t i = 0; i < count; ++i) {
    double* landmark = landmarks_.data() + rows[i] * kWidth;
    const double* block = blocks + 9 * i;
    for (int row = 0; row < 3; ++row)
      for (int column = row; column < 3; ++column)
        landmark[kPlaceOf[3 * row + column]] += 0.5 * (block[3 * row + column] + block[3 * column + row]);
    for (int k = 0; k < 3; ++k) landmark[6 + k] += gradients[3 * i + k];
  }
  double largest = 0.0;
  for (std::size_t i = 0; i < problem_.landmark_free.size(); ++i) {
    if (problem_.landmark_free[i] == 0) continue;
    for (std::size_t k = 6; k < 9; ++k) largest = std::max(largest, std::abs(landmarks_[i * kWidth + k]));
  }
  return largest;
}

/// List the pairs landmark by landmark; the plan has them frame by frame within each chunk.
void LandmarkSystem::index_pairs() {
  pairs_begin_.assign(static_cast<std::size_t>(problem_.num_landmarks), 0);
  pairs_end_ = pairs_begin_;
  pairs_of_landmark_.resize(static_cast<std::size_t>(plan_.num_pairs));
  // All pairs of a landmark are in its chunk: those of a chunk fill one range, counted first and then filled.
  for (const LandmarkChunk& chunk : plan_.chunks) {
    if (chunk.frozen) continue;
    std::int64_t count[kChunkLandmarks] = {};
    for (const std::uint8_t landmark : chunk.pair_landmark) count[landmark] += 1;
    std::int64_t begin = chunk.first_pair;
    for (std::size_t i = 0; i < chunk.landmarks.size(); ++i) {
      const auto row = static_cast<std::size_t>(chunk.landmarks[i]);
      pairs_begin_[row] = pairs_end_[row] = begin;
      begin += count[i];
    }
    for (std::size_t f = 0; f < chunk.frames.size(); ++f)
      for (int i = chunk.frame_begin[f]; i < chunk.frame_begin[f + 1]; ++i) {
        const std::uint8_t landmark = chunk.pair_landmark[static_cast<std::size_t>(i)];
        const auto row = static_cast<std::size_t>(chunk.landmarks[landmark]);
        pairs_of_landmark_[static_cast<std::size_t>(pairs_end_[row]++)] = {chunk.first_pair + i, chunk.frames[f]};
      }
  }
}

void LandmarkSystem::add_to_coupling(std::int64_t count, const std::int64_t* frames, const std::int64_t* rows,
                                     const double* blocks) {
  if (pairs_begin_.empty()) index_pairs();
  std::vector<double*> places(static_cast<std::size_t>(count));
  for (std::size_t i = 0; i < places.size(); ++i) {
    const auto row = static_cast<std::size_t>(rows[i]);
    const auto begin = pairs_of_landmark_.begin() + pairs_begin_[row],
               end = pairs_of_landmark_.begin() + pairs_end_[row];
    const auto found = std::lower_bound(
        begin, end, frames[i], [](const LandmarkPair& pair, std::int64_t frame) { return pair.frame < frame; });
    if (found == end || found->frame != frames[i])
      throw std::invalid_argument("entry " + std::to_string(i) + ": no factor of the problem reads landmark " +
                                  std::to_string(rows[i]) + " and frame " + std::to_string(frames[i]));
    places[i] = coupling_.data() + found->pair * kWidth;
  }
  reduced_ = false;
  const double* block = blocks;
  for (double* place : places)
    for (int j = 0; j < 3; ++j)
      for (int k = 0; k < kFrameColumns; ++k) place[j * kSimd8Width + k] += *block++;
}

void LandmarkSystem::whitened_coupling(std::int64_t count, const std::int64_t* rows, double* out) {
  using landmark_cholesky::solve_lower;
  if (pairs_begin_.empty()) index_pairs();
  const auto size = static_cast<std::size_t>(problem_.num_columns), width = size + kBorder + 1;
  const int items = static_cast<int>(count);
  parallel_for(items, useful_threads(threads_, items, kGrain), [&](int first, int last, int) {
    for (int i = first; i < last; ++i) {
      const auto row = static_cast<std::size_t>(rows[i]);
      const double* factor = factors_.data() + 6 * row;
      double* line[3];
      for (std::size_t j = 0; j < 3; ++j) line[j] = out + (3 * static_cast<std::size_t>(i) + j) * width;
      std::fill_n(line[0], 3 * width, 0.0);
      const auto put = [&](std::size_t column, double* x) {
        solve_lower(factor, x);
        for (std::size_t j = 0; j < 3; ++j) line[j][column] = x[j];
      };
      for (std::int64_t p = pairs_begin_[row]; p < pairs_end_[row]; ++p) {
        const LandmarkPair& pair = pairs_of_landmark_[static_cast<std::size_t>(p)];
        const double* coupling = coupling_.data() + pair.pair * kWidth;
        const int* columns = problem_.columns.data() + static_cast<std::size_t>(pair.frame) * kFrameColumns;
        for (int k = 0; k < kFrameColumns; ++k) {
          if (columns[k] < 0) continue;
          double x[3] = {coupling[k], coupling[kSimd8Width + k], coupling[2 * kSimd8Width + k]};
          put(static_cast<std::size_t>(columns[k]), x);
        }
      }
      const double* landmark = landmarks_.data() + row * kWidth;
      for (std::size_t k = 0; k < kBorder; ++k) {
        double x[3] = {landmark[9 + k], landmark[9 + kBorder + k], landmark[9 + 2 * kBorder + k]};
        put(size + k, x);
      }
      double gradient[3] = {landmark[6], landmark[7], landmark[8]};
      put(size + kBorder, gradient);
    }
  });
}

void LandmarkSystem::inverse_factors(std::int64_t count, const std::int64_t* rows, double* out) const {
  for (std::int64_t i = 0; i < count; ++i) {
    const double* factor = factors_.data() + 6 * rows[i];
    for (int column = 0; column < 3; ++column) {
      double x[3] = {column == 0 ? 1.0 : 0.0, column == 1 ? 1.0 : 0.0, column == 2 ? 1.0 : 0.0};
      landmark_cholesky::solve_lower(factor, x);
      for (int row = 0; row < 3; ++row) out[9 * i + 3 * row + column] = x[row];
    }
  }
}

}  // namespace uni4d_fg
