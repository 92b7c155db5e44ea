#include "guided_upsampling.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "exp_minus.hpp"
#include "uni4d_fg/parallel.hpp"
#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

namespace {

constexpr int kGrainRows = 16;
constexpr int kChunk = 128;
constexpr int kTaps = 3;  // pixels of the map that are looked at, in each direction
constexpr float kLeastWeight = 1e-12F;

/// Where the pixels of one side fall in the map: for each of the taps, which pixel that is and how much it weighs.
struct Taps {
  std::vector<int> at[kTaps];
  std::vector<float> weight[kTaps];

  Taps(int size, int coarse_size, float sigma) {
    for (int k = 0; k < kTaps; ++k) {
      at[k].resize(static_cast<std::size_t>(size));
      weight[k].resize(static_cast<std::size_t>(size));
      for (int i = 0; i < size; ++i) {
        const float place = (static_cast<float>(i) + 0.5F) * (static_cast<float>(coarse_size) / static_cast<float>(size)) - 0.5F;
        const int nearest = static_cast<int>(std::nearbyint(place)) + k - kTaps / 2;
        const int inside = std::min(std::max(nearest, 0), coarse_size - 1);
        const float away = (static_cast<float>(inside) - place) / sigma;
        at[k][static_cast<std::size_t>(i)] = inside;
        weight[k][static_cast<std::size_t>(i)] = std::exp(-0.5F * away * away);
      }
    }
  }
};

/// Add what one tap says to the sums of one row. Colors are planar, a row after the other: three times `width`.
UNI4D_FG_WIDE_CLONES void add_tap(const float* __restrict values, const float* __restrict red,
                                  const float* __restrict green, const float* __restrict blue,
                                  const int* __restrict at, const float* __restrict near, float row_weight,
                                  const float* __restrict guide, int width, float scale, float* __restrict total,
                                  float* __restrict weights) {
  // In two loops per chunk, each of which becomes SIMD: what the map has there, and what that weighs.
  float sample[kChunk], unlike[kChunk];
  for (int begin = 0; begin < width; begin += kChunk) {
    const int count = width - begin < kChunk ? width - begin : kChunk;
    for (int k = 0; k < count; ++k) {
      const int x = begin + k, j = at[x];
      const float r = guide[x] - red[j], g = guide[width + x] - green[j], b = guide[2 * width + x] - blue[j];
      sample[k] = values[j];
      unlike[k] = scale * (r * r + g * g + b * b);
    }
    for (int k = 0; k < count; ++k) {
      const int x = begin + k;
      const float bounded = unlike[k] < kFarthest ? unlike[k] : kFarthest;
      const float weight = row_weight * near[x] * exp_minus(bounded) + kLeastWeight;
      const bool known = sample[k] - sample[k] == 0.0F;
      const float share = known ? weight : 0.0F, value = known ? sample[k] : 0.0F;
      total[x] = total[x] + share * value;
      weights[x] = weights[x] + share;
    }
  }
}

}  // namespace

void upsample_guided(const CoarseMap& coarse, const std::uint8_t* image, int height, int width,
                     const GuidedWeights& weights, int threads, float* out) {
  const Taps rows(height, coarse.height, weights.spatial), columns(width, coarse.width, weights.spatial);
  const float scale = 0.5F / (weights.color * weights.color);
  const auto side = static_cast<std::size_t>(width), coarse_side = static_cast<std::size_t>(coarse.width);
  std::vector<float> planar(3 * static_cast<std::size_t>(coarse.height) * coarse_side);
  for (std::size_t row = 0; row < static_cast<std::size_t>(coarse.height); ++row)
    for (std::size_t x = 0; x < coarse_side; ++x)
      for (std::size_t k = 0; k < 3; ++k)
        planar[(3 * row + k) * coarse_side + x] = coarse.colors[3 * (row * coarse_side + x) + k];
  parallel_for(height, useful_threads(threads, height, kGrainRows), [&](int begin, int end, int) {
    std::vector<float> guide(3 * side), total(side), sum(side);
    for (auto y = static_cast<std::size_t>(begin); y < static_cast<std::size_t>(end); ++y) {
      for (std::size_t x = 0; x < side; ++x)
        for (std::size_t k = 0; k < 3; ++k) guide[k * side + x] = static_cast<float>(image[3 * (y * side + x) + k]);
      std::fill(total.begin(), total.end(), 0.0F);
      std::fill(sum.begin(), sum.end(), 0.0F);
      for (int v = 0; v < kTaps; ++v) {
        const std::size_t from = static_cast<std::size_t>(rows.at[v][y]) * coarse_side;
        for (int u = 0; u < kTaps; ++u)
          add_tap(coarse.values + from, &planar[3 * from], &planar[3 * from + coarse_side],
                  &planar[3 * from + 2 * coarse_side], columns.at[u].data(), columns.weight[u].data(),
                  rows.weight[v][y], guide.data(), width, scale, total.data(), sum.data());
      }
      for (std::size_t x = 0; x < side; ++x) out[y * side + x] = total[x] / sum[x];
    }
  });
}

}  // namespace uni4d_fg
