#include "plane_sweep.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "uni4d_fg/math.hpp"
#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

namespace {

constexpr int kUnknown = 128;  // matching cost where nothing is known: halfway between like and unlike
constexpr int kNoViewYet = 255;
constexpr int kBandRows = 40;
constexpr int kChunk = 128;  // pixels of a row that are worked on together
constexpr int kNarrow = 1;   // half side of the window over which gray values are compared themselves

/// What the matching of a band of rows works in.
struct Band {
  std::vector<float> warped, seen, sum_w, sum_ww, sum_rw, sum_ad;
  std::vector<std::uint8_t> first, second;
};

/// Sample one row of a view at a plane. `seen` is 1 where the view has a value, else 0.
UNI4D_FG_CLONES void warp_row(const float* __restrict image, int height, int width, const float* __restrict turn,
                              const float* __restrict shift, float rho, int y, float* __restrict out,
                              float* __restrict seen) {
  const float yf = static_cast<float>(y);
  const float a = turn[1] * yf + turn[2] + rho * shift[0];
  const float b = turn[4] * yf + turn[5] + rho * shift[1];
  const float c = turn[7] * yf + turn[8] + rho * shift[2];
  const float t0 = turn[0], t3 = turn[3], t6 = turn[6];
  const float right = static_cast<float>(width - 1), bottom = static_cast<float>(height - 1);
  for (int x = 0; x < width; ++x) {
    const float xf = static_cast<float>(x);
    const float z = t6 * xf + c;
    const float inverse = 1.0F / z, u = (t0 * xf + a) * inverse, v = (t3 * xf + b) * inverse;
    const bool inside = (z > 0.0F) & (u >= 0.0F) & (v >= 0.0F) & (u <= right) & (v <= bottom);
    const float uc = inside ? u : 0.0F, vc = inside ? v : 0.0F;
    int i = static_cast<int>(uc), j = static_cast<int>(vc);
    i = i < width - 2 ? i : width - 2;
    j = j < height - 2 ? j : height - 2;
    const float p = uc - static_cast<float>(i), q = vc - static_cast<float>(j);
    const int at = j * width + i;
    const float top = image[at] * (1.0F - p) + image[at + 1] * p;
    const float low = image[at + width] * (1.0F - p) + image[at + width + 1] * p;
    const float value = top * (1.0F - q) + low * q;
    const bool known = inside & (value == value);
    out[x] = known ? value : 0.0F;
    seen[x] = known ? 1.0F : 0.0F;
  }
}

/// Sum (2 radius + 1) neighbors of a row of values, of their squares and of their products with the reference.
UNI4D_FG_CLONES void sum_rows(const float* __restrict warped, const float* __restrict reference, int width, int radius,
                              float* __restrict w, float* __restrict ww, float* __restrict rw) {
  for (int x = 0; x < width; ++x) w[x] = ww[x] = rw[x] = 0.0F;
  for (int k = -radius; k <= radius; ++k) {
    const int begin = std::max(0, -k), end = std::min(width, width - k);
    for (int x = begin; x < end; ++x) {
      const float value = warped[x + k];
      w[x] += value;
      ww[x] += value * value;
      rw[x] += value * reference[x + k];
    }
  }
}

/// Sum (2 kNarrow + 1) neighbors of the differences between two rows, each at most `largest`.
UNI4D_FG_CLONES void sum_differences(const float* __restrict warped, const float* __restrict reference, int width,
                                     float largest, float* __restrict sum) {
  for (int x = 0; x < width; ++x) sum[x] = 0.0F;
  for (int k = -kNarrow; k <= kNarrow; ++k) {
    const int begin = std::max(0, -k), end = std::min(width, width - k);
    for (int x = begin; x < end; ++x) {
      const float difference = std::abs(warped[x + k] - reference[x + k]);
      sum[x] += difference < largest ? difference : largest;
    }
  }
}

/// What the cost of a row is made of.
struct RowSums {
  const float *w[16], *ww[16], *rw[16];  // (2 radius + 1) rows of what `sum_rows` gave
  const float* ad[2 * kNarrow + 1];      // and of what `sum_differences` gave
};

/// The matching cost of one row.
UNI4D_FG_CLONES void match_row(const RowSums& sums, int width, const SweepOptions& options,
                               const float* __restrict mean, const float* __restrict variance,
                               const float* __restrict seen, std::uint8_t* __restrict out) {
  const int radius = options.radius, rows = 2 * radius + 1;
  const float share = 1.0F / static_cast<float>(rows * rows), noise2 = options.noise * options.noise;
  constexpr auto kCompared = static_cast<float>((2 * kNarrow + 1) * (2 * kNarrow + 1));
  const float of_difference = options.difference_share * 255.0F / (options.largest_difference * kCompared);
  const float of_correlation = 1.0F - options.difference_share;
  // In separate loops per chunk: each of them becomes SIMD, which one loop over all of it does not.
  float a[kChunk], b[kChunk], c[kChunk], e[kChunk], cost[kChunk];
  for (int begin = 0; begin < width; begin += kChunk) {
    const int count = std::min(kChunk, width - begin);
    for (int k = 0; k < rows; ++k) {
      const float *__restrict wk = sums.w[k] + begin, *__restrict wwk = sums.ww[k] + begin,
                  *__restrict rwk = sums.rw[k] + begin;
      if (k == 0) std::fill_n(a, count, 0.0F), std::fill_n(b, count, 0.0F), std::fill_n(c, count, 0.0F);
      for (int i = 0; i < count; ++i) {
        a[i] += wk[i];
        b[i] += wwk[i];
        c[i] += rwk[i];
      }
    }
    std::fill_n(e, count, 0.0F);
    for (const float* row : sums.ad) {
      const float* __restrict ad = row + begin;
      for (int i = 0; i < count; ++i) e[i] += ad[i];
    }
    for (int i = 0; i < count; ++i) {
      const float sum = a[i] * share, other = b[i] * share - sum * sum;
      const float spread = other > 0.0F ? other : 0.0F;
      const float zncc = (c[i] * share - sum * mean[begin + i]) / std::sqrt((variance[begin + i] + noise2) * (spread + noise2));
      const float unlike = (1.0F - zncc) * 127.5F, low = unlike > 0.0F ? unlike : 0.0F;
      const float bounded = of_correlation * (low < 255.0F ? low : 255.0F) + of_difference * e[i] + 0.5F;
      const int x = begin + i;
      const bool known = (seen[x] > 0.0F) & (x >= radius) & (x < width - radius) & (variance[x] >= 0.0F);
      cost[i] = known ? bounded : static_cast<float>(kUnknown);
    }
    for (int i = 0; i < count; ++i) out[begin + i] = static_cast<std::uint8_t>(static_cast<int>(cost[i]));
  }
}

UNI4D_FG_CLONES void keep_two(const std::uint8_t* __restrict cost, int count, std::uint8_t* __restrict first,
                              std::uint8_t* __restrict second) {
  for (int x = 0; x < count; ++x) {
    const std::uint8_t c = cost[x], low = first[x];
    const std::uint8_t rest = std::max(c, low);
    first[x] = std::min(c, low);
    second[x] = std::min(second[x], rest);
  }
}

class Matching {
 public:
  Matching(const float* image, int height, int width, const std::vector<SweepView>& views,
           const std::vector<float>& planes, const SweepOptions& options)
      : height_(height), width_(width), views_(views), planes_(planes), options_(options), image_(size()),
        mean_(size()), variance_(size()) {
    for (std::size_t i = 0; i < size(); ++i) image_[i] = image[i] == image[i] ? image[i] : 0.0F;
    describe(image);
  }

  /// Costs of rows [begin, end) of all pixels and planes, planes innermost.
  void band(int begin, int end, Band& work, std::uint8_t* costs) const {
    const int radius = options_.radius, width = width_, depth = static_cast<int>(planes_.size());
    const int top = std::max(0, begin - radius), low = std::min(height_, end + radius), rows = low - top;
    const auto cells = static_cast<std::size_t>(rows) * static_cast<std::size_t>(width);
    for (auto* buffer : {&work.warped, &work.seen, &work.sum_w, &work.sum_ww, &work.sum_rw, &work.sum_ad})
      buffer->resize(cells);
    const auto out_cells = static_cast<std::size_t>(end - begin) * static_cast<std::size_t>(width);
    work.first.resize(out_cells);
    work.second.resize(out_cells);
    std::vector<std::uint8_t> line(static_cast<std::size_t>(width));
    const bool two = views_.size() > 2;
    for (int d = 0; d < depth; ++d) {
      std::fill(work.first.begin(), work.first.end(), static_cast<std::uint8_t>(kNoViewYet));
      std::fill(work.second.begin(), work.second.end(), static_cast<std::uint8_t>(kNoViewYet));
      for (const SweepView& view : views_) {
        for (int y = top; y < low; ++y) {
          const std::size_t at = offset(y - top);
          warp_row(view.image, height_, width, view.turn, view.shift, planes_[static_cast<std::size_t>(d)], y,
                   &work.warped[at], &work.seen[at]);
          sum_rows(&work.warped[at], &image_[offset(y)], width, radius, &work.sum_w[at], &work.sum_ww[at],
                   &work.sum_rw[at]);
          sum_differences(&work.warped[at], &image_[offset(y)], width, options_.largest_difference, &work.sum_ad[at]);
        }
        for (int y = begin; y < end; ++y) {
          const std::size_t to = offset(y - begin);
          if (y < radius || y >= height_ - radius) {
            std::fill(line.begin(), line.end(), static_cast<std::uint8_t>(kUnknown));
          } else {
            RowSums sums;
            for (int k = 0; k <= 2 * radius; ++k) {
              const std::size_t from = offset(y - radius + k - top);
              sums.w[k] = &work.sum_w[from];
              sums.ww[k] = &work.sum_ww[from];
              sums.rw[k] = &work.sum_rw[from];
            }
            for (int k = 0; k <= 2 * kNarrow; ++k) sums.ad[k] = &work.sum_ad[offset(y - kNarrow + k - top)];
            match_row(sums, width, options_, &mean_[offset(y)], &variance_[offset(y)], &work.seen[offset(y - top)],
                      line.data());
          }
          keep_two(line.data(), width, &work.first[to], &work.second[to]);
        }
      }
      for (std::size_t i = 0; i < out_cells; ++i) {
        const int cost = two ? (work.first[i] + work.second[i] + 1) / 2 : work.first[i];
        costs[(offset(begin) + i) * static_cast<std::size_t>(depth) + static_cast<std::size_t>(d)] =
            static_cast<std::uint8_t>(cost);
      }
    }
  }

 private:
  std::size_t size() const { return static_cast<std::size_t>(height_) * static_cast<std::size_t>(width_); }
  std::size_t offset(int row) const { return static_cast<std::size_t>(row) * static_cast<std::size_t>(width_); }

  /// Mean and variance of every window of the reference; a variance of -1 where it is not to be matched.
  void describe(const float* image) {
    const int r = options_.radius;
    const float share = 1.0F / static_cast<float>((2 * r + 1) * (2 * r + 1));
    for (int y = 0; y < height_; ++y)
      for (int x = 0; x < width_; ++x) {
        const std::size_t at = offset(y) + static_cast<std::size_t>(x);
        float sum = 0.0F, squares = 0.0F;
        const bool inside = x >= r && y >= r && x < width_ - r && y < height_ - r && image[at] == image[at];
        for (int j = -r; inside && j <= r; ++j)
          for (int i = -r; i <= r; ++i) {
            const float value = image_[offset(y + j) + static_cast<std::size_t>(x + i)];
            sum += value;
            squares += value * value;
          }
        mean_[at] = sum * share;
        variance_[at] = inside ? std::max(squares * share - mean_[at] * mean_[at], 0.0F) : -1.0F;
      }
  }

  int height_, width_;
  const std::vector<SweepView>& views_;
  const std::vector<float>& planes_;
  const SweepOptions& options_;
  std::vector<float> image_, mean_, variance_;
};

/// One step of a path: out = cost + min(previous, neighbors + small, least + large) - least; returns the least of out.
UNI4D_FG_CLONES std::uint16_t path_step(const std::uint8_t* __restrict cost, const std::uint16_t* __restrict previous,
                                        std::uint16_t least, int depth, std::uint16_t small, std::uint16_t large,
                                        std::uint16_t* __restrict out, std::uint16_t* __restrict total) {
  const auto jump = static_cast<std::uint16_t>(least + large);
  std::uint16_t found = std::numeric_limits<std::uint16_t>::max();
  for (int d = 0; d < depth; ++d) {  // previous[-1] and previous[depth] are there, and large
    const auto down = static_cast<std::uint16_t>(previous[d - 1] + small);
    const auto up = static_cast<std::uint16_t>(previous[d + 1] + small);
    std::uint16_t best = previous[d] < down ? previous[d] : down;
    best = best < up ? best : up;
    best = best < jump ? best : jump;
    const auto value = static_cast<std::uint16_t>(cost[d] + best - least);
    out[d] = value;
    total[d] = static_cast<std::uint16_t>(total[d] + value);
    found = found < value ? found : value;
  }
  return found;
}

/// Four of the eight paths: those that come from the left and from above, or, backwards, from the right and below.
class Aggregation {
 public:
  Aggregation(const std::vector<std::uint8_t>& cost, const float* image, int height, int width, int depth,
              const SweepOptions& options)
      : cost_(cost), image_(image), height_(height), width_(width), depth_(depth), pitch_(depth + 2),
        options_(options) {}

  void run(bool backward, std::vector<std::uint16_t>& total) const {
    constexpr std::uint16_t kWall = 30000;  // besides the first and the last plane
    const auto cells = static_cast<std::size_t>(width_ + 2) * static_cast<std::size_t>(pitch_);
    std::vector<std::uint16_t> rows[2], side[2];
    std::vector<std::uint16_t> least[2];
    for (int k = 0; k < 2; ++k) {
      rows[k].assign(3 * cells, kWall);
      side[k].assign(static_cast<std::size_t>(pitch_), kWall);
      least[k].assign(3 * static_cast<std::size_t>(width_ + 2), 0);
    }
    const int sign = backward ? -1 : 1;
    for (int i = 0; i < height_; ++i) {
      const int y = backward ? height_ - 1 - i : i, now = i % 2, before = 1 - now;
      std::uint16_t side_least = 0;
      for (int k = 0; k < width_; ++k) {
        const int x = backward ? width_ - 1 - k : k;
        const std::uint8_t* cost = &cost_[at(y, x)];
        std::uint16_t* sum = &total[at(y, x)];
        std::uint16_t *to = &side[k % 2][1], *from = &side[1 - k % 2][1];
        if (k == 0) start(from, side_least);
        side_least = path_step(cost, from, side_least, depth_, small(), large(y, x, 0, sign), to, sum);
        for (int path = 0; path < 3; ++path) {
          const int dx = path - 1;  // the pixel above is at x - dx
          const auto base = static_cast<std::size_t>(path) * cells + 1;
          const auto column = static_cast<std::size_t>(x + 1), other = static_cast<std::size_t>(x - dx + 1);
          const auto place = static_cast<std::size_t>(path) * static_cast<std::size_t>(width_ + 2);
          std::uint16_t* row_to = &rows[now][base + column * static_cast<std::size_t>(pitch_)];
          std::uint16_t* row_from = &rows[before][base + other * static_cast<std::size_t>(pitch_)];
          std::uint16_t low = least[before][place + other];
          const bool inside = i > 0 && x - dx >= 0 && x - dx < width_;
          if (!inside) start(row_from, low);
          least[now][place + column] = path_step(cost, row_from, low, depth_, small(),
                                                 inside ? large(y, x, sign, dx) : zero(), row_to, sum);
        }
      }
    }
  }

 private:
  static std::uint16_t zero() { return 0; }
  std::uint16_t small() const { return static_cast<std::uint16_t>(options_.small_step); }
  std::size_t at(int y, int x) const {
    return (static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x)) *
           static_cast<std::size_t>(depth_);
  }
  void start(std::uint16_t* from, std::uint16_t& least) const {
    std::fill(from, from + depth_, static_cast<std::uint16_t>(0));
    least = 0;
  }
  /// Penalty of a large change between a pixel and that `dy` rows and `dx` columns before it.
  std::uint16_t large(int y, int x, int dy, int dx) const {
    const int v = y - dy, u = x - dx;
    if (u < 0 || v < 0 || u >= width_ || v >= height_) return 0;
    const float a = image_[static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x)];
    const float b = image_[static_cast<std::size_t>(v) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(u)];
    const float difference = a == a && b == b ? std::abs(a - b) : 0.0F;
    const float penalty = static_cast<float>(options_.large_step) / (1.0F + difference / options_.edge_contrast);
    return static_cast<std::uint16_t>(std::max(penalty, static_cast<float>(options_.small_step)));
  }

  const std::vector<std::uint8_t>& cost_;
  const float* image_;
  int height_, width_, depth_, pitch_;
  const SweepOptions& options_;
};

/// Least aggregated cost of one pixel, refined by a parabola, and the least one that is not beside it.
void choose(const std::uint16_t* a, const std::uint16_t* b, const std::uint8_t* match, int depth, float* plane,
            float* cost, float* rival, float* matching) {
  int best = 0, least = std::numeric_limits<int>::max();
  for (int d = 0; d < depth; ++d) {
    const int value = a[d] + b[d];
    if (value < least) {
      least = value;
      best = d;
    }
  }
  int second = std::numeric_limits<int>::max();
  for (int d = 0; d < depth; ++d)
    if (d < best - 2 || d > best + 2) second = std::min(second, a[d] + b[d]);
  float refined = static_cast<float>(best);
  if (best > 0 && best < depth - 1) {
    const int before = a[best - 1] + b[best - 1], after = a[best + 1] + b[best + 1];
    const int bend = before + after - 2 * least;
    if (bend > 0) refined += 0.5F * static_cast<float>(before - after) / static_cast<float>(bend);
  }
  *plane = refined;
  *cost = static_cast<float>(least);
  *rival = second == std::numeric_limits<int>::max() ? static_cast<float>(least) : static_cast<float>(second);
  *matching = static_cast<float>(match[best]);
}

}  // namespace

SweepResult plane_sweep(const float* image, int height, int width, const std::vector<SweepView>& views,
                        const std::vector<float>& inverse_depth, const SweepOptions& options) {
  const auto size = static_cast<std::size_t>(height) * static_cast<std::size_t>(width);
  const int depth = static_cast<int>(inverse_depth.size());
  const auto d = static_cast<std::size_t>(depth);
  std::vector<std::uint8_t> costs(size * d);
  {
    const Matching matching(image, height, width, views, inverse_depth, options);
    const int bands = (height + kBandRows - 1) / kBandRows;
    parallel_for(bands, options.threads, [&](int begin, int end, int) {
      Band work;
      for (int band = begin; band < end; ++band)
        matching.band(band * kBandRows, std::min(height, (band + 1) * kBandRows), work, costs.data());
    });
  }
  std::vector<std::uint16_t> totals[2];
  {
    const Aggregation aggregation(costs, image, height, width, depth, options);
    parallel_for(2, std::min(options.threads, 2), [&](int begin, int end, int) {
      for (int half = begin; half < end; ++half) {
        totals[half].assign(size * d, 0);
        aggregation.run(half == 1, totals[half]);
      }
    });
  }
  SweepResult result;
  for (auto* field : {&result.plane, &result.cost, &result.rival, &result.match}) field->resize(size);
  parallel_for(height * width, options.threads, [&](int begin, int end, int) {
    for (auto i = static_cast<std::size_t>(begin); i < static_cast<std::size_t>(end); ++i)
      choose(&totals[0][i * d], &totals[1][i * d], &costs[i * d], depth, &result.plane[i], &result.cost[i],
             &result.rival[i], &result.match[i]);
  });
  return result;
}

}  // namespace uni4d_fg
