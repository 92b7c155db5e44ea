#include "depth_edges.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>

#include "pixel_place.hpp"
#include "uni4d_fg/math.hpp"
#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

namespace {

constexpr int kNear = 4;  // half side of the window in which an edge is near, px
constexpr int kLanes = 8;
/// The window that is compared: every second pixel of 5x5, as on a chessboard, the nearest ones first.
constexpr std::array<std::array<int, 2>, 13> kTaps{
    {{0, 0}, {-1, -1}, {-1, 1}, {1, -1}, {1, 1}, {-2, 0}, {0, -2}, {0, 2}, {2, 0}, {-2, -2}, {-2, 2}, {2, -2}, {2, 2}}};
constexpr int kPadded = (kTaps.size() + kLanes - 1) / kLanes * kLanes;  // those beyond the window count nothing
constexpr float kEdge = 0.1F;                                           // range of log depth from which on there is one
constexpr std::array<int, 3> kReaches{2, 4, 7};  // depths are tried of the pixels so far away, px
constexpr float kAlike = 0.02F;                  // log depths that differ by less are one
constexpr float kLike = 0.08F;                   // standard deviation of the weights by difference of gray values
constexpr float kLargest = 0.15F;                // larger differences are all alike
constexpr float kShown = 0.5F;                   // a view that shows less of a window says nothing of it
constexpr float kBetter = 0.002F;                // another depth than a pixel's own is better by this at least

/// The pixels around one: where they are, their gray values, and how much they count.
struct Window {
  float u[kPadded], v[kPadded], gray[kPadded], weight[kPadded];
};

constexpr float kNothing = std::numeric_limits<float>::infinity();

/// How unlike a window and what a view shows of it on a plane of one inverse depth are: the weighted mean; infinite
/// where it shows too little.
UNI4D_FG_CLONES float unlikeness(const Window& window, const SweepView& view, int height, int width, float rho) {
  const float* t = view.turn;
  const float x0 = rho * view.shift[0], y0 = rho * view.shift[1], z0 = rho * view.shift[2];
  float p[kPadded], q[kPadded], top[2 * kPadded], low[2 * kPadded];
  int at[kPadded], inside[kPadded];
  for (int k = 0; k < kPadded; ++k) {
    const float u = window.u[k], v = window.v[k];
    const float a = t[0] * u + (t[1] * v + t[2] + x0), b = t[3] * u + (t[4] * v + t[5] + y0);
    const float c = t[6] * u + (t[7] * v + t[8] + z0);
    const PixelPlace place = pixel_place(a / c, b / c, c > 0.0F, height, width);
    at[k] = place.at;
    p[k] = place.p;
    q[k] = place.q;
    inside[k] = place.shown;
  }
  for (int k = 0; k < kPadded; ++k) {
    std::memcpy(&top[2 * k], view.image + at[k], 2 * sizeof(float));
    std::memcpy(&low[2 * k], view.image + at[k] + width, 2 * sizeof(float));
  }
  float totals[kPadded], shares[kPadded];
  for (int k = 0; k < kPadded; ++k) {
    const float above = top[2 * k] * (1.0F - p[k]) + top[2 * k + 1] * p[k];
    const float below = low[2 * k] * (1.0F - p[k]) + low[2 * k + 1] * p[k];
    const float value = above * (1.0F - q[k]) + below * q[k], difference = std::abs(value - window.gray[k]);
    const bool known = (inside[k] != 0) & (difference == difference);
    shares[k] = known ? window.weight[k] : 0.0F;
    totals[k] = shares[k] * (difference < kLargest ? difference : kLargest);
  }
  for (int half = kPadded / 2; half > 0; half /= 2)
    for (int k = 0; k < half; ++k) {
      totals[k] += totals[k + half];
      shares[k] += shares[k + half];
    }
  return shares[0] >= kShown ? totals[0] / shares[0] : kNothing;
}

class Edges {
 public:
  Edges(const float* inverse_depth, const float* image, const std::uint8_t* chosen, int height, int width,
        const std::vector<SweepView>& views)
      : inverse_depth_(inverse_depth), image_(image), chosen_(chosen), height_(height), width_(width), views_(views) {
    const std::size_t size = static_cast<std::size_t>(height) * static_cast<std::size_t>(width);
    least_.resize(size);
    most_.resize(size);
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x) {
        const float* begin = inverse_depth + at(y, std::max(x - kNear, 0));
        const float* end = inverse_depth + at(y, std::min(x + kNear, width - 1)) + 1;
        least_[at(y, x)] = *std::min_element(begin, end);
        most_[at(y, x)] = *std::max_element(begin, end);
      }
  }

  void row(int y, float* out) const {
    for (int x = 0; x < width_; ++x) {
      const float own = inverse_depth_[at(y, x)];
      out[x] = is_near(y, x) ? best(y, x, own) : own;
    }
  }

 private:
  std::size_t at(int y, int x) const {
    return static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x);
  }
  bool has(int y, int x) const { return y >= 0 && x >= 0 && y < height_ && x < width_; }

  bool is_near(int y, int x) const {
    if (chosen_[at(y, x)] == 0 || !std::isfinite(image_[at(y, x)])) return false;
    float least = least_[at(y, x)], most = most_[at(y, x)];
    for (int v = std::max(y - kNear, 0); v <= std::min(y + kNear, height_ - 1); ++v) {
      least = std::min(least, least_[at(v, x)]);
      most = std::max(most, most_[at(v, x)]);
    }
    static const float ratio = std::exp(kEdge);
    return most > least * ratio;
  }

  float best(int y, int x, float own) const {
    static const float alike = std::exp(kAlike);
    const Window window = around(y, x);
    std::array<float, 1 + 4 * kReaches.size()> tried{own};
    std::size_t count = 1;
    float found = own, least = cost(window, own) - kBetter;
    if (least == kNothing) return own;
    for (const int reach : kReaches) {
      const std::array<std::array<int, 2>, 4> steps{{{0, -reach}, {0, reach}, {-reach, 0}, {reach, 0}}};
      for (const auto& [dy, dx] : steps) {
        if (!has(y + dy, x + dx)) continue;
        const float other = inverse_depth_[at(y + dy, x + dx)];
        const bool known = std::any_of(tried.begin(), tried.begin() + count,
                                       [&](float one) { return other < one * alike && one < other * alike; });
        if (known) continue;
        tried[count++] = other;
        const float now = cost(window, other);
        if (now < least) {
          least = now;
          found = other;
        }
      }
    }
    return found;
  }

  Window around(int y, int x) const {
    Window window{};
    const float own = image_[at(y, x)];
    float total = 0.0F;
    for (std::size_t k = 0; k < kTaps.size(); ++k) {
      const int v = y + kTaps[k][0], u = x + kTaps[k][1];
      window.u[k] = static_cast<float>(u);
      window.v[k] = static_cast<float>(v);
      if (!has(v, u) || !std::isfinite(image_[at(v, u)])) continue;
      const float gray = image_[at(v, u)], unlike = (gray - own) / kLike;
      window.gray[k] = gray;
      window.weight[k] = std::exp(-0.5F * unlike * unlike);
      total += window.weight[k];
    }
    for (float& weight : window.weight) weight /= total;
    return window;
  }

  /// The mean of the two best views, as a part of them may not see what the image shows; infinite where fewer than two
  /// say anything.
  float cost(const Window& window, float rho) const {
    float first = kNothing, second = kNothing;
    for (const SweepView& view : views_) {
      const float unlike = unlikeness(window, view, height_, width_, rho);
      second = std::min(second, std::max(first, unlike));
      first = std::min(first, unlike);
    }
    return views_.size() > 1 ? 0.5F * (first + second) : first;
  }

  const float *inverse_depth_, *image_;
  const std::uint8_t* chosen_;
  int height_, width_;
  const std::vector<SweepView>& views_;
  std::vector<float> least_, most_;  // of the pixels near one in its row
};

}  // namespace

std::vector<float> depth_edges(const float* inverse_depth, const float* image, const std::uint8_t* chosen, int height,
                               int width, const std::vector<SweepView>& views, int threads) {
  std::vector<float> out(static_cast<std::size_t>(height) * static_cast<std::size_t>(width));
  const Edges edges(inverse_depth, image, chosen, height, width, views);
  parallel_for(height, threads, [&](int begin, int end, int) {
    for (int y = begin; y < end; ++y) edges.row(y, &out[static_cast<std::size_t>(y) * static_cast<std::size_t>(width)]);
  });
  return out;
}

}  // namespace uni4d_fg
