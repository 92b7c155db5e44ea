#include "plane_matching.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "pixel_place.hpp"
#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

namespace {

constexpr int kUnknown = 128;  // halfway between like and unlike
constexpr int kNoViewYet = 255;
constexpr int kChunk = 128;  // pixels of a row that are worked on together
constexpr int kNarrow = 1;   // half side of the window over which gray values are compared themselves
constexpr int kMargin = 8;   // zeros before a row, of which windows of up to 15 px are summed
constexpr int kMostRows = 2 * 7 + 1;

static_assert(kChunk % kSimdFloatWidth == 0);

int rounded_up(int width) { return (width + kSimdFloatWidth - 1) / kSimdFloatWidth * kSimdFloatWidth; }

/// A plane as one row of the reference sees it: pixel x lies at (a x + b) / (e x + f), (c x + d) / (e x + f).
struct RowTransfer {
  float a, b, c, d, e, f;
};

/// Where pixels of a row lie in an image: the upper left of the four around them, and how far they are from there.
UNI4D_FG_WIDE_CLONES void locate(const RowTransfer& row, int height, int width, int begin, int count,
                                 int* __restrict at, float* __restrict p, float* __restrict q, int* __restrict seen) {
  for (int k = 0; k < count; ++k) {
    const float x = static_cast<float>(begin + k), z = row.e * x + row.f, inverse = 1.0F / z;
    const PixelPlace place =
        pixel_place((row.a * x + row.b) * inverse, (row.c * x + row.d) * inverse, z > 0.0F, height, width);
    at[k] = place.at;
    p[k] = place.p;
    q[k] = place.q;
    seen[k] = place.shown;
  }
}

/// Copy the two values of a row, and of the one below it, that lie around each pixel: two loads instead of four, and
/// none by the processor's gathers, which are slower.
void fetch(const float* image, int width, const int* at, int count, float* top, float* low) {
  for (int k = 0; k < count; ++k) {
    std::memcpy(top + 2 * k, image + at[k], 2 * sizeof(float));
    std::memcpy(low + 2 * k, image + at[k] + width, 2 * sizeof(float));
  }
}

/// Values between the four of each pixel; `seen` is 1 where there is one, else 0.
UNI4D_FG_WIDE_CLONES void interpolate(const float* __restrict top, const float* __restrict low,
                                      const float* __restrict p, const float* __restrict q,
                                      const int* __restrict inside, int count, float* __restrict out,
                                      float* __restrict seen) {
  for (int k = 0; k < count; ++k) {
    const float above = top[2 * k] * (1.0F - p[k]) + top[2 * k + 1] * p[k];
    const float below = low[2 * k] * (1.0F - p[k]) + low[2 * k + 1] * p[k];
    const float value = above * (1.0F - q[k]) + below * q[k];
    const bool known = (inside[k] != 0) & (value == value);
    out[k] = known ? value : 0.0F;
    seen[k] = known ? 1.0F : 0.0F;
  }
}

/// Sums over a row's windows: of its values, of their squares, of their products with the reference, and, over the
/// narrow windows, of the differences from it, each at most `largest`.
template <int kBytes>
UNI4D_FG_INLINE void add_up_row(const float* row, const float* reference, int width, int radius, float largest,
                                float* values, float* squares, float* products, float* differences) {
  using Number = SimdFloat<kBytes>;
  for (int x = 0; x < width; x += kSimdFloatWidth) {
    Number value{}, square{}, product{}, difference{};
    for (int k = -radius; k <= radius; ++k) {
      const Number own = load<Number>(row + x + k), other = load<Number>(reference + x + k);
      value += own;
      square += own * own;
      product += own * other;
    }
    for (int k = -kNarrow; k <= kNarrow; ++k)
      difference += at_most(magnitude(load<Number>(row + x + k) - load<Number>(reference + x + k)), largest);
    store(value, values + x);
    store(square, squares + x);
    store(product, products + x);
    store(difference, differences + x);
  }
}

UNI4D_FG_DISPATCH(void, sum_row,
                  (const float* row, const float* reference, int width, int radius, float largest, float* values,
                   float* squares, float* products, float* differences),
                  (row, reference, width, radius, largest, values, squares, products, differences),
                  add_up_row<kBytes>(row, reference, width, radius, largest, values, squares, products, differences))

/// Add rows up, pixel by pixel.
template <int kBytes>
UNI4D_FG_INLINE void add_up_rows(const float* const* rows, int count, int begin, int width, float* out) {
  using Number = SimdFloat<kBytes>;
  for (int x = 0; x < width; x += kSimdFloatWidth) {
    Number total{};
    for (int k = 0; k < count; ++k) total += load<Number>(rows[k] + begin + x);
    store(total, out + x);
  }
}

UNI4D_FG_DISPATCH(void, sum_rows, (const float* const* rows, int count, int begin, int width, float* out),
                  (rows, count, begin, width, out), add_up_rows<kBytes>(rows, count, begin, width, out))

/// Sums over the windows of some pixels of a row.
struct WindowSums {
  float values[kChunk], squares[kChunk], products[kChunk], differences[kChunk];
};

/// The matching cost of some pixels of a row, from the sums over their windows.
UNI4D_FG_WIDE_CLONES void judge(const WindowSums& sums, const SweepOptions& options, int count,
                                const float* __restrict mean, const float* __restrict variance,
                                const float* __restrict seen, std::uint8_t* __restrict out) {
  const int rows = 2 * options.radius + 1;
  const float share = 1.0F / static_cast<float>(rows * rows), noise2 = options.noise * options.noise;
  constexpr auto kCompared = static_cast<float>((2 * kNarrow + 1) * (2 * kNarrow + 1));
  const float of_difference = options.difference_share * 255.0F / (options.largest_difference * kCompared);
  const float of_correlation = 1.0F - options.difference_share;
  float cost[kChunk];  // loops of their own: each of them becomes SIMD, which one loop over all of it does not
  for (int i = 0; i < count; ++i) {
    const float sum = sums.values[i] * share, other = sums.squares[i] * share - sum * sum;
    const float spread = other > 0.0F ? other : 0.0F;
    const float zncc =
        (sums.products[i] * share - sum * mean[i]) / std::sqrt((variance[i] + noise2) * (spread + noise2));
    const float unlike = (1.0F - zncc) * 127.5F, low = unlike > 0.0F ? unlike : 0.0F;
    const float bounded = of_correlation * (low < 255.0F ? low : 255.0F) + of_difference * sums.differences[i] + 0.5F;
    const bool known = (seen[i] > 0.0F) & (variance[i] >= 0.0F);
    cost[i] = known ? bounded : static_cast<float>(kUnknown);
  }
  for (int i = 0; i < count; ++i) out[i] = static_cast<std::uint8_t>(static_cast<int>(cost[i]));
}

UNI4D_FG_WIDE_CLONES void keep_two(const std::uint8_t* __restrict cost, int count, std::uint8_t* __restrict first,
                                   std::uint8_t* __restrict second) {
  for (int x = 0; x < count; ++x) {
    const std::uint8_t c = cost[x], low = first[x];
    const std::uint8_t rest = std::max(c, low);
    first[x] = std::min(c, low);
    second[x] = std::min(second[x], rest);
  }
}

}  // namespace

/// The last rows that were sampled, as many as a window has: they stay in the nearest cache.
struct PlaneMatching::Ring {
  Ring(int rows, int row_pitch)
      : count(rows),
        pitch(static_cast<std::size_t>(row_pitch)),
        warped(pitch + 2 * kMargin),
        seen(at(rows - 1) + pitch),
        values(seen),
        squares(seen),
        products(seen),
        differences(seen) {}

  std::size_t at(int y) const { return static_cast<std::size_t>(y % count) * pitch; }

  int count;
  std::size_t pitch;
  std::vector<float> warped, seen, values, squares, products, differences;
};

std::size_t PlaneMatching::padded(int row) const {
  return static_cast<std::size_t>(row) * static_cast<std::size_t>(pitch_ + 2 * kMargin) + kMargin;
}

PlaneMatching::PlaneMatching(const float* image, int height, int width, const std::vector<SweepView>& views,
                             const std::vector<float>& planes, const SweepOptions& options)
    : height_(height),
      width_(width),
      pitch_(rounded_up(width)),
      views_(views),
      planes_(planes),
      options_(options),
      image_(static_cast<std::size_t>(height) * static_cast<std::size_t>(pitch_ + 2 * kMargin)),
      mean_(static_cast<std::size_t>(height) * static_cast<std::size_t>(width)),
      variance_(mean_.size()) {
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const float value =
          image[static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x)];
      image_[padded(y) + static_cast<std::size_t>(x)] = value == value ? value : 0.0F;
    }
  describe(image);
}

/// Mean and variance of every window of the reference; a variance of -1 where it is not to be matched.
void PlaneMatching::describe(const float* image) {
  const int r = options_.radius;
  const float share = 1.0F / static_cast<float>((2 * r + 1) * (2 * r + 1));
  for (int y = 0; y < height_; ++y)
    for (int x = 0; x < width_; ++x) {
      const std::size_t at = offset(y) + static_cast<std::size_t>(x);
      float sum = 0.0F, squares = 0.0F;
      const bool inside = x >= r && y >= r && x < width_ - r && y < height_ - r && image[at] == image[at];
      for (int j = -r; inside && j <= r; ++j)
        for (int i = -r; i <= r; ++i) {
          const float value = image_[padded(y + j) + static_cast<std::size_t>(x + i)];
          sum += value;
          squares += value * value;
        }
      mean_[at] = sum * share;
      variance_[at] = inside ? std::max(squares * share - mean_[at] * mean_[at], 0.0F) : -1.0F;
    }
}

/// Sample a row of a view at a plane, and sum it over windows.
void PlaneMatching::sample(const SweepView& view, float plane, int y, Ring& ring) const {
  const float *turn = view.turn, *shift = view.shift, row = static_cast<float>(y);
  const RowTransfer transfer{turn[0], turn[1] * row + turn[2] + plane * shift[0],
                             turn[3], turn[4] * row + turn[5] + plane * shift[1],
                             turn[6], turn[7] * row + turn[8] + plane * shift[2]};
  float *const warped = &ring.warped[kMargin], *const seen = &ring.seen[ring.at(y)];
  int at[kChunk], inside[kChunk];
  float p[kChunk], q[kChunk], top[2 * kChunk], low[2 * kChunk];
  for (int begin = 0; begin < width_; begin += kChunk) {
    const int count = std::min(kChunk, width_ - begin);
    locate(transfer, height_, width_, begin, count, at, p, q, inside);
    fetch(view.image, width_, at, count, top, low);
    interpolate(top, low, p, q, inside, count, warped + begin, seen + begin);
  }
  sum_row(warped, &image_[padded(y)], width_, options_.radius, options_.largest_difference, &ring.values[ring.at(y)],
          &ring.squares[ring.at(y)], &ring.products[ring.at(y)], &ring.differences[ring.at(y)]);
}

/// Write the costs of a row whose windows' rows are the last ones that were sampled.
void PlaneMatching::match(int y, const Ring& ring, std::uint8_t* out) const {
  const int radius = options_.radius;
  const float *values[kMostRows], *squares[kMostRows], *products[kMostRows], *differences[2 * kNarrow + 1];
  for (int k = 0; k <= 2 * radius; ++k) {
    const std::size_t from = ring.at(y - radius + k);
    values[k] = &ring.values[from];
    squares[k] = &ring.squares[from];
    products[k] = &ring.products[from];
  }
  for (int k = 0; k <= 2 * kNarrow; ++k) differences[k] = &ring.differences[ring.at(y - kNarrow + k)];
  WindowSums sums;
  for (int begin = 0; begin < width_; begin += kChunk) {
    const int count = std::min(kChunk, width_ - begin), rows = 2 * radius + 1;
    sum_rows(values, rows, begin, count, sums.values);
    sum_rows(squares, rows, begin, count, sums.squares);
    sum_rows(products, rows, begin, count, sums.products);
    sum_rows(differences, 2 * kNarrow + 1, begin, count, sums.differences);
    const std::size_t at = offset(y) + static_cast<std::size_t>(begin);
    judge(sums, options_, count, &mean_[at], &variance_[at], &ring.seen[ring.at(y)] + begin, out + begin);
  }
}

void PlaneMatching::band(int begin, int end, std::uint8_t* costs) const {
  const int radius = options_.radius, depth = static_cast<int>(planes_.size());
  const int top = std::max(0, begin - radius), low = std::min(height_, end + radius);
  const std::size_t cells = offset(end) - offset(begin);
  Ring ring(2 * radius + 1, pitch_);
  std::vector<std::uint8_t> line(static_cast<std::size_t>(width_)), first(cells), second(cells);
  const bool two = views_.size() > 2;
  for (int d = 0; d < depth; ++d) {
    std::fill(first.begin(), first.end(), static_cast<std::uint8_t>(kNoViewYet));
    std::fill(second.begin(), second.end(), static_cast<std::uint8_t>(kNoViewYet));
    const auto keep = [&](int y) {
      keep_two(line.data(), width_, &first[offset(y - begin)], &second[offset(y - begin)]);
    };
    for (const SweepView& view : views_) {
      for (int y = top; y < low; ++y) {
        sample(view, planes_[static_cast<std::size_t>(d)], y, ring);
        if (y - radius < std::max(begin, radius)) continue;
        match(y - radius, ring, line.data());
        keep(y - radius);
      }
      std::fill(line.begin(), line.end(), static_cast<std::uint8_t>(kUnknown));
      for (int y = begin; y < end; ++y)
        if (y < radius || y >= height_ - radius) keep(y);
    }
    for (std::size_t i = 0; i < cells; ++i) {
      const int cost = two ? (first[i] + second[i] + 1) / 2 : first[i];
      costs[(offset(begin) + i) * static_cast<std::size_t>(depth) + static_cast<std::size_t>(d)] =
          static_cast<std::uint8_t>(cost);
    }
  }
}

}  // namespace uni4d_fg
