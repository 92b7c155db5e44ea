#include "moved_evidence.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

namespace {

constexpr float kMedianOfSquare = 0.455F;  // of the square of a standard normal variable

using Floats = std::vector<float>;

/// Index of a pixel beyond an image's edge, which mirrors at the outermost pixel.
int mirrored(int i, int count) {
  if (count == 1) return 0;
  while (i < 0 || i >= count) i = i < 0 ? -i : 2 * count - 2 - i;
  return i;
}

UNI4D_FG_WIDE_CLONES void replace_row(const float* __restrict entering, const float* __restrict leaving, int width,
                                      double* __restrict sums) {
  for (int x = 0; x < width; ++x) sums[x] += static_cast<double>(entering[x]) - static_cast<double>(leaving[x]);
}

UNI4D_FG_WIDE_CLONES void sum_along(const double* __restrict padded, int width, int side, double share,
                                    double* __restrict total, float* __restrict out) {
  for (int x = 0; x < width; ++x) total[x] = padded[x];
  for (int k = 1; k < side; ++k)
    for (int x = 0; x < width; ++x) total[x] += padded[x + k];
  for (int x = 0; x < width; ++x) out[x] = static_cast<float>(total[x] * share);
}

/// Means over windows. Sums over columns move on from row to row, in double precision, so that they do not drift.
void box_mean(const Floats& values, int height, int width, int side, Floats& out) {
  const int before = side / 2, after = side - 1 - before;
  const double share = 1.0 / (static_cast<double>(side) * side);
  const auto w = static_cast<std::size_t>(width);
  const auto row = [&](int y) { return &values[static_cast<std::size_t>(mirrored(y, height)) * w]; };
  std::vector<double> sums(w, 0.0), total(w), padded(w + static_cast<std::size_t>(side) - 1);
  for (int y = -before - 1; y < after; ++y)
    for (std::size_t x = 0; x < w; ++x) sums[x] += static_cast<double>(row(y)[x]);
  for (int y = 0; y < height; ++y) {
    replace_row(row(y + after), row(y - before - 1), width, sums.data());
    std::copy(sums.begin(), sums.end(), padded.begin() + before);
    for (int x = -before; x < 0; ++x)
      padded[static_cast<std::size_t>(x + before)] = sums[static_cast<std::size_t>(mirrored(x, width))];
    for (int x = width; x < width + after; ++x)
      padded[static_cast<std::size_t>(x + before)] = sums[static_cast<std::size_t>(mirrored(x, width))];
    sum_along(padded.data(), width, side, share, total.data(), &out[static_cast<std::size_t>(y) * w]);
  }
}

/// Median; the mean of the two in the middle of an even number. `values` are put in another order.
float median(Floats& values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  if (values.size() % 2 == 1) return *middle;
  return 0.5F * (*middle + *std::max_element(values.begin(), middle));
}

/// log(a) of a >= 1, to 2e-7; in such a form that loops over it become SIMD.
inline float logarithm(float a) {
  std::uint32_t bits;
  std::memcpy(&bits, &a, sizeof(bits));
  bits += 0x3F800000U - 0x3F3504F3U;  // a = 2^k m, m in [sqrt(1/2), sqrt(2))
  const auto k = static_cast<float>(static_cast<int>(bits >> 23) - 127);
  bits = (bits & 0x007FFFFFU) + 0x3F3504F3U;
  float m;
  std::memcpy(&m, &bits, sizeof(m));
  const float s = (m - 1.0F) / (m + 1.0F), z = s * s;  // log m = 2 artanh s
  return k * 0.69314718F + 2.0F * s * (1.0F + z * (1.0F / 3 + z * (1.0F / 5 + z * (1.0F / 7 + z * (1.0F / 9)))));
}

/// Log of the ratio of two normal densities: wide enough for what has moved, and for what has not.
UNI4D_FG_WIDE_CLONES void log_odds(const float* __restrict squared, const float* __restrict variance,
                                   const float* __restrict contrast, std::size_t count, float* __restrict out) {
  for (std::size_t i = 0; i < count; ++i) {
    const float wider = variance[i] + 2.0F * contrast[i];
    out[i] = 0.5F * (squared[i] / variance[i] - squared[i] / wider - logarithm(wider / variance[i]));
  }
}

/// Take what all pixels share off the differences of colors, and add up their squares.
UNI4D_FG_WIDE_CLONES void squares_of_rest(const float* __restrict color, const float* __restrict seen,
                                          const float* __restrict shared, std::size_t count, float* __restrict out) {
  for (std::size_t i = 0; i < count; ++i) {
    const float r = color[3 * i] - seen[3 * i] - shared[0], g = color[3 * i + 1] - seen[3 * i + 1] - shared[1];
    const float b = color[3 * i + 2] - seen[3 * i + 2] - shared[2];
    out[i] = r * r + g * g + b * b;
  }
}

/// Add what an error of depth does to a difference of colors.
UNI4D_FG_WIDE_CLONES void with_depth(const ComparedPixels& p, std::size_t count, float* __restrict out) {
  const float* __restrict du = p.du;
  const float* __restrict dv = p.dv;
  const float* __restrict sigma = p.sigma;
  const float* __restrict gxx = p.gxx;
  const float* __restrict gxy = p.gxy;
  const float* __restrict gyy = p.gyy;
  const float* __restrict variance = p.variance;
  for (std::size_t i = 0; i < count; ++i) {
    const float x = sigma[i] * du[i], y = sigma[i] * dv[i];
    out[i] = variance[i] + (x * x * gxx[i] + 2.0F * x * y * gxy[i] + y * y * gyy[i]);
  }
}

/// Products over colors of what is seen, evened out, with a frame's colors and with itself.
UNI4D_FG_WIDE_CLONES void products_with_lit(const float* __restrict color, const float* __restrict seen,
                                            const float* __restrict shared, std::size_t count, float* __restrict common,
                                            float* __restrict power) {
  for (std::size_t i = 0; i < count; ++i) {
    const float r = seen[3 * i] + shared[0], g = seen[3 * i + 1] + shared[1], b = seen[3 * i + 2] + shared[2];
    common[i] = r * color[3 * i] + g * color[3 * i + 1] + b * color[3 * i + 2];
    power[i] = r * r + g * g + b * b;
  }
}

/// Squares of what a shadow leaves of a difference of colors. `common` becomes the gain.
UNI4D_FG_WIDE_CLONES void squares_in_shadow(const float* __restrict color, const float* __restrict seen,
                                            const float* __restrict shared, float deepest,
                                            const float* __restrict power, std::size_t count, float* __restrict common,
                                            float* __restrict out) {
  for (std::size_t i = 0; i < count; ++i) {
    const float gain = common[i] / (power[i] > 1.0F ? power[i] : 1.0F);
    const float low = gain > deepest ? gain : deepest, bounded = low < 1.0F ? low : 1.0F;
    const float r = color[3 * i] - bounded * (seen[3 * i] + shared[0]);
    const float g = color[3 * i + 1] - bounded * (seen[3 * i + 1] + shared[1]);
    const float b = color[3 * i + 2] - bounded * (seen[3 * i + 2] + shared[2]);
    common[i] = gain;
    out[i] = r * r + g * g + b * b;
  }
}

/// What is in a shadow is no more suspicious than that leaves it.
UNI4D_FG_WIDE_CLONES void forgive_shadows(const float* __restrict gain, const float* __restrict texture,
                                          const float* __restrict variance, const float* __restrict in_shadow,
                                          float lit, std::size_t count, float* __restrict evidence) {
  for (std::size_t i = 0; i < count; ++i) {
    const bool shaded = (gain[i] < lit) & (2.0F * texture[i] > variance[i]) & (in_shadow[i] < evidence[i]);
    evidence[i] = shaded ? in_shadow[i] : evidence[i];
  }
}

/// The pixel of the other frame that is nearest to where each one is seen; -1 for none.
UNI4D_FG_WIDE_CLONES void find_places(const ComparedPixels& p, std::size_t count, int* __restrict out) {
  const float right = static_cast<float>(p.width - 2), low = static_cast<float>(p.height - 2);
  const float* __restrict u = p.u;
  const float* __restrict v = p.v;
  for (std::size_t i = 0; i < count; ++i) {
    const bool inside = (u[i] >= 1.0F) & (u[i] <= right) & (v[i] >= 1.0F) & (v[i] <= low);
    const float x = inside ? u[i] : 1.0F, y = inside ? v[i] : 1.0F;
    const int column = static_cast<int>(std::nearbyint(x)), row = static_cast<int>(std::nearbyint(y));
    out[i] = inside ? row * p.width + column : -1;
  }
}

class Comparison {
 public:
  Comparison(const ComparedPixels& pixels, const EvidenceOptions& options)
      : p_(pixels),
        options_(options),
        count_(static_cast<std::size_t>(pixels.height) * static_cast<std::size_t>(pixels.width)),
        places_(count_) {
    find_places(p_, count_, places_.data());
    for (int y = 0; y < p_.height; y += options.step)
      for (int x = 0; x < p_.width; x += options.step) {
        const std::size_t at =
            static_cast<std::size_t>(y) * static_cast<std::size_t>(p_.width) + static_cast<std::size_t>(x);
        if (places_[at] >= 0) sample_.push_back(at);
      }
  }

  void run(float* out) const {
    std::fill_n(out, count_, 0.0F);
    if (sample_.empty()) return;
    float shared[3];  // exposure
    for (std::size_t c = 0; c < 3; ++c)
      shared[c] = median_of([&](std::size_t at) { return p_.color[3 * at + c] - p_.seen[3 * at + c]; });
    Floats squares(count_), squared(count_), variance(count_), evidence(count_);
    squares_of_rest(p_.color, p_.seen, shared, count_, squares.data());
    mean_over(squares, options_.patch, squared);
    with_depth(p_, count_, variance.data());
    // Blur and noise of this pair of frames: most of the image is static.
    const float ratio = median_of([&](std::size_t at) { return squared[at] / variance[at]; }) / kMedianOfSquare;
    for (float& each : variance) each *= std::max(1.0F, ratio);
    log_odds(squared.data(), variance.data(), p_.contrast, count_, evidence.data());
    if (p_.texture != nullptr) {
      Floats gain(count_), power(count_), in_shadow(count_);
      products_with_lit(p_.color, p_.seen, shared, count_, squares.data(), squared.data());
      mean_over(squares, options_.shadow_window, gain);
      mean_over(squared, options_.shadow_window, power);
      squares_in_shadow(p_.color, p_.seen, shared, options_.deepest_shadow, power.data(), count_, gain.data(),
                        squares.data());
      mean_over(squares, options_.patch, squared);
      log_odds(squared.data(), variance.data(), p_.texture, count_, in_shadow.data());
      forgive_shadows(gain.data(), p_.texture, variance.data(), in_shadow.data(), options_.lit, count_,
                      evidence.data());
    }
    for (std::size_t i = 0; i < count_; ++i)
      if (places_[i] >= 0 && !(p_.nearest[places_[i]] < options_.nearer * p_.z[i]))
        out[i] = std::min(std::max(evidence[i], options_.least), options_.most);
  }

 private:
  template <typename F>
  float median_of(F value) const {
    Floats values(sample_.size());
    std::transform(sample_.begin(), sample_.end(), values.begin(), value);
    return median(values);
  }
  void mean_over(const Floats& values, int side, Floats& out) const {
    box_mean(values, p_.height, p_.width, side, out);
  }

  const ComparedPixels& p_;
  const EvidenceOptions& options_;
  std::size_t count_;
  std::vector<int> places_;  // of `find_places`
  std::vector<std::size_t> sample_;
};

}  // namespace

void moved_evidence(const ComparedPixels& pixels, const EvidenceOptions& options, float* out) {
  Comparison(pixels, options).run(out);
}

}  // namespace uni4d_fg
