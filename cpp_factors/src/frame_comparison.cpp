#include "frame_comparison.hpp"

#include <algorithm>
#include <cstddef>

#include "uni4d_fg/parallel.hpp"
#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

namespace {

constexpr int kGrainRows = 16;

/// Add what one other frame says of one row.
UNI4D_FG_WIDE_CLONES void compare_row(const float* __restrict inverse_depth, int y, int width,
                                      const ComparedFrame& other, float low, float high, float alike_low,
                                      float alike_high, float* __restrict product, float* __restrict agreeing,
                                      float* __restrict seeing, float* __restrict alike) {
  const float yf = static_cast<float>(y);
  const float a0 = other.turn[1] * yf + other.turn[2], b0 = other.turn[4] * yf + other.turn[5];
  const float c0 = other.turn[7] * yf + other.turn[8];
  const float t0 = other.turn[0], t3 = other.turn[3], t6 = other.turn[6];
  const float s0 = other.shift[0], s1 = other.shift[1], s2 = other.shift[2];
  const int last_column = other.width - 1, last_row = other.height - 1, stride = other.width;
  const float right = static_cast<float>(last_column), bottom = static_cast<float>(last_row);
  const float* __restrict map = other.inverse_depth;
  for (int x = 0; x < width; ++x) {
    const float xf = static_cast<float>(x), rho = inverse_depth[x];
    const float c = t6 * xf + c0 + rho * s2;
    const float u = (t0 * xf + a0 + rho * s0) / c, v = (t3 * xf + b0 + rho * s1) / c;
    const bool inside = (c > 0.0F) & (u >= 0.0F) & (v >= 0.0F) & (u <= right) & (v <= bottom);
    const float uc = inside ? u : 0.0F, vc = inside ? v : 0.0F;
    const int i = static_cast<int>(uc), j = static_cast<int>(vc);
    const int across = i < last_column ? 1 : 0, down = j < last_row ? stride : 0;
    const float p = uc - static_cast<float>(i), q = vc - static_cast<float>(j);
    const int at = j * stride + i;
    const float top = map[at] + p * (map[at + across] - map[at]);
    const float low_row = map[at + down] + p * (map[at + down + across] - map[at + down]);
    const float sample = top + q * (low_row - top);
    // The depth there over that of this frame's pixel seen from there; NaN compares as false throughout.
    const float ratio = rho / (c * sample);
    const bool known = inside & (ratio > 0.0F);
    const bool agrees = known & (ratio > low) & (ratio < high);
    product[x] *= agrees ? ratio : 1.0F;
    agreeing[x] += agrees ? 1.0F : 0.0F;
    seeing[x] += known ? 1.0F : 0.0F;
    alike[x] += (known & (ratio > alike_low) & (ratio < alike_high)) ? 1.0F : 0.0F;
  }
}

}  // namespace

void compare_frames(const float* inverse_depth, int height, int width, const std::vector<ComparedFrame>& others,
                    const ComparisonBounds& bounds, int threads, const ComparisonSums& sums) {
  parallel_for(height, useful_threads(threads, height, kGrainRows), [&](int begin, int end, int) {
    for (int y = begin; y < end; ++y) {
      const auto at = static_cast<std::size_t>(y) * static_cast<std::size_t>(width);
      std::fill_n(sums.product + at, width, 1.0F);
      for (float* counts : {sums.agreeing, sums.seeing, sums.alike}) std::fill_n(counts + at, width, 0.0F);
      for (const ComparedFrame& other : others)
        compare_row(inverse_depth + at, y, width, other, 1.0F / bounds.agree, bounds.agree, 1.0F / bounds.alike,
                    bounds.alike, sums.product + at, sums.agreeing + at, sums.seeing + at, sums.alike + at);
    }
  });
}

}  // namespace uni4d_fg
