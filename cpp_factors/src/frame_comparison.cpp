#include "frame_comparison.hpp"

#include <algorithm>
#include <cstddef>

#include "uni4d_fg/parallel.hpp"
#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

namespace {

constexpr int kGrainRows = 16;
constexpr int kChunk = 128;

/// Add what one other frame says of one row.
UNI4D_FG_WIDE_CLONES void compare_row(const float* __restrict inverse_depth, int y, int width,
                                      const float* __restrict map, int map_height, int map_width,
                                      const float* __restrict turn, const float* __restrict shift, float agree,
                                      float alike_bound, float* __restrict product, float* __restrict agreeing,
                                      float* __restrict seeing, float* __restrict alike) {
  const float yf = static_cast<float>(y);
  const float a0 = turn[1] * yf + turn[2], b0 = turn[4] * yf + turn[5], c0 = turn[7] * yf + turn[8];
  const float t0 = turn[0], t3 = turn[3], t6 = turn[6], s0 = shift[0], s1 = shift[1], s2 = shift[2];
  const float low = 1.0F / agree, alike_low = 1.0F / alike_bound;
  const int last_column = map_width - 1, last_row = map_height - 1;
  const float right = static_cast<float>(last_column), bottom = static_cast<float>(last_row);
  // In three loops per chunk, each of which becomes SIMD: where pixels fall, what is there, and what that says.
  int at[kChunk], across[kChunk], down[kChunk];
  float p[kChunk], q[kChunk], relative[kChunk], sample[kChunk];
  for (int begin = 0; begin < width; begin += kChunk) {
    const int count = width - begin < kChunk ? width - begin : kChunk;
    for (int k = 0; k < count; ++k) {
      const float xf = static_cast<float>(begin + k), rho = inverse_depth[begin + k];
      const float c = t6 * xf + c0 + rho * s2;
      const float u = (t0 * xf + a0 + rho * s0) / c, v = (t3 * xf + b0 + rho * s1) / c;
      const bool inside = (c > 0.0F) & (u >= 0.0F) & (v >= 0.0F) & (u <= right) & (v <= bottom);
      const float uc = inside ? u : 0.0F, vc = inside ? v : 0.0F;
      const int i = static_cast<int>(uc), j = static_cast<int>(vc);
      at[k] = j * map_width + i;
      across[k] = i < last_column ? 1 : 0;
      down[k] = j < last_row ? map_width : 0;
      p[k] = uc - static_cast<float>(i);
      q[k] = vc - static_cast<float>(j);
      relative[k] = inside ? rho / c : 0.0F;
    }
    for (int k = 0; k < count; ++k) {
      const float a = map[at[k]], b = map[at[k] + across[k]];
      const float c = map[at[k] + down[k]], d = map[at[k] + down[k] + across[k]];
      const float top = a + p[k] * (b - a), below = c + p[k] * (d - c);
      sample[k] = top + q[k] * (below - top);
    }
    for (int k = 0; k < count; ++k) {
      // The depth there over that of this frame's pixel seen from there; NaN compares as false throughout.
      const int x = begin + k;
      const float ratio = relative[k] / sample[k];
      const bool known = ratio > 0.0F, agrees = (ratio > low) & (ratio < agree);
      const bool same = (ratio > alike_low) & (ratio < alike_bound);
      const float factor = agrees ? ratio : 1.0F, agreed = agrees ? 1.0F : 0.0F;
      const float seen = known ? 1.0F : 0.0F, equal = same ? 1.0F : 0.0F;
      product[x] = product[x] * factor;
      agreeing[x] = agreeing[x] + agreed;
      seeing[x] = seeing[x] + seen;
      alike[x] = alike[x] + equal;
    }
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
        compare_row(inverse_depth + at, y, width, other.inverse_depth, other.height, other.width, other.turn, other.shift,
                    bounds.agree, bounds.alike, sums.product + at, sums.agreeing + at, sums.seeing + at,
                    sums.alike + at);
    }
  });
}

}  // namespace uni4d_fg
