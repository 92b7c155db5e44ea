#include "plane_sweep.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "plane_matching.hpp"
#include "uni4d_fg/math.hpp"
#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

namespace {

constexpr float kLeastSmallStep = 6.0F;  // across an edge a change by one plane is not free

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
      : cost_(cost),
        image_(image),
        height_(height),
        width_(width),
        depth_(depth),
        pitch_(depth + 2),
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
        const Penalty along = penalty(y, x, 0, sign);
        side_least = path_step(cost, from, side_least, depth_, along.small, along.large, to, sum);
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
          const Penalty across = penalty(y, x, sign, dx);
          least[now][place + column] = path_step(cost, row_from, low, depth_, across.small, across.large, row_to, sum);
        }
      }
    }
  }

 private:
  struct Penalty {
    std::uint16_t small, large;
  };
  std::size_t at(int y, int x) const {
    return (static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x)) *
           static_cast<std::size_t>(depth_);
  }
  void start(std::uint16_t* from, std::uint16_t& least) const {
    std::fill(from, from + depth_, static_cast<std::uint16_t>(0));
    least = 0;
  }
  /// Penalties of a change between a pixel and that `dy` rows and `dx` columns before it: lower across edges.
  Penalty penalty(int y, int x, int dy, int dx) const {
    const int v = y - dy, u = x - dx;
    if (u < 0 || v < 0 || u >= width_ || v >= height_) return {0, 0};
    const float a =
        image_[static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x)];
    const float b =
        image_[static_cast<std::size_t>(v) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(u)];
    const float difference = a == a && b == b ? std::abs(a - b) : 0.0F;
    const float flatness = 1.0F / (1.0F + difference / options_.edge_contrast);
    const float flat = static_cast<float>(options_.small_step);
    const float small = std::max(flat * flatness, std::min(flat, kLeastSmallStep));
    return {static_cast<std::uint16_t>(small),
            static_cast<std::uint16_t>(std::max(static_cast<float>(options_.large_step) * flatness, small))};
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
    const PlaneMatching matching(image, height, width, views, inverse_depth, options);
    // As many bands for each thread; what is found does not depend on them.
    const int rows_of_all = PlaneMatching::kBandRows * std::max(1, options.threads);
    const int bands = std::max(1, options.threads) * std::max(1, (height + rows_of_all / 2) / rows_of_all);
    parallel_for(bands, options.threads, [&](int begin, int end, int) {
      for (int band = begin; band < end; ++band)
        matching.band(range_begin(height, bands, band), range_begin(height, bands, band + 1), costs.data());
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
