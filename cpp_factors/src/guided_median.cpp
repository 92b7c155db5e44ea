#include "guided_median.hpp"

#include <algorithm>
#include <cstddef>
#include <vector>

#include "exp_minus.hpp"
#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

namespace {

UNI4D_FG_WIDE_CLONES void weigh(const float* __restrict unlike, const float* __restrict weights, int count,
                                float* __restrict out) {
  for (int k = 0; k < count; ++k) out[k] = weights[k] * exp_minus(unlike[k] < kFarthest ? unlike[k] : kFarthest);
}

/// Sort the values, carrying their weights along: there are few, and their neighbors' order is often theirs.
void sort_with_weights(float* values, float* weights, int count) {
  for (int i = 1; i < count; ++i) {
    const float value = values[i], weight = weights[i];
    int at = i;
    for (; at > 0 && values[at - 1] > value; --at) {
      values[at] = values[at - 1];
      weights[at] = weights[at - 1];
    }
    values[at] = value;
    weights[at] = weight;
  }
}

/// The first of the sorted values with half of the weight up to it.
float middle_of(const float* values, const float* weights, int count) {
  float total = 0.0F, mass = 0.0F;
  for (int k = 0; k < count; ++k) total += weights[k];
  for (int k = 0; k < count; ++k) {
    mass += weights[k];
    if (mass >= 0.5F * total) return values[k];
  }
  return values[count - 1];
}

}  // namespace

void guided_median(const WeightedMap& map, const std::uint8_t* chosen, const MedianWindow& window, float* out) {
  const int side = 2 * window.reach / window.step + 1;
  const auto most = static_cast<std::size_t>(side * side);
  std::vector<float> values(most), weights(most), unlike(most), weighed(most);
  const float scale = 0.5F / (window.spatial * window.spatial);
  for (int y = 0; y < map.height; ++y)
    for (int x = 0; x < map.width; ++x) {
      const std::ptrdiff_t own = static_cast<std::ptrdiff_t>(y) * map.width + x;
      out[own] = map.values[own];
      if (chosen[own] == 0) continue;
      const float* color = map.colors + 3 * own;
      std::size_t count = 0;
      for (int dy = -window.reach; dy <= window.reach; dy += window.step) {
        if (y + dy < 0 || y + dy >= map.height) continue;
        for (int dx = -window.reach; dx <= window.reach; dx += window.step) {
          const std::ptrdiff_t at = own + static_cast<std::ptrdiff_t>(dy) * map.width + dx;
          if (x + dx < 0 || x + dx >= map.width || !(map.weights[at] > 0.0F)) continue;
          const float* other = map.colors + 3 * at;
          const float r = other[0] - color[0], g = other[1] - color[1], b = other[2] - color[2];
          const float* slope = map.slopes + 2 * at;
          const float back = -(static_cast<float>(dy) * slope[0] + static_cast<float>(dx) * slope[1]);
          values[count] = map.values[at] * (1.0F + std::clamp(back, -window.steepest, window.steepest));
          weights[count] = map.weights[at];
          unlike[count] = r * r + g * g + b * b + scale * static_cast<float>(dy * dy + dx * dx);
          ++count;
        }
      }
      if (count == 0) continue;
      const int found = static_cast<int>(count);
      weigh(unlike.data(), weights.data(), found, weighed.data());
      sort_with_weights(values.data(), weighed.data(), found);
      out[own] = middle_of(values.data(), weighed.data(), found);
    }
}

}  // namespace uni4d_fg
