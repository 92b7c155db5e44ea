#include "patch_registration.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "uni4d_fg/parallel.hpp"
#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

namespace {

constexpr int kGrain = 64;
constexpr int kParameters = 6;
constexpr double kLeastVariance = 1.0;     // gray levels squared: what has less contrast is not registered
constexpr double kLeastInside = 0.5;       // part of the weight that must lie inside the image
constexpr double kLargestStepPx = 5.0;     // a longer one is no refinement
constexpr double kLeastDeterminant = 0.1;  // of an affine step

/// Pixels of one patch, padded to whole SIMD values by pixels of weight zero. Floats will do: gray levels are relative
/// to the mean of the template, and places in the image to the pixel around which they lie.
struct Workspace {
  int blocks;
  float mean = 0.0F;  ///< Of the template, gray levels.
  std::vector<float> x, y, weight, value, gradient_x, gradient_y, sampled, used, fu, fv;
  std::vector<int> at;                      ///< Upper left of the four pixels around a place; 0 outside of the image.
  std::vector<std::uint16_t> upper, lower;  ///< The two pixels of each row, the left one in the low byte.

  explicit Workspace(const PatchSettings& settings) {
    const int side = 2 * settings.half + 1;
    blocks = (side * side + kSimdFloatWidth - 1) / kSimdFloatWidth;
    const auto size = static_cast<std::size_t>(blocks * kSimdFloatWidth);
    for (auto* array : {&x, &y, &weight, &value, &gradient_x, &gradient_y, &sampled, &used, &fu, &fv})
      array->assign(size, 0.0F);
    at.assign(size, 0);
    upper.assign(size, 0);
    lower.assign(size, 0);
    for (int i = 0; i < side * side; ++i) {
      x[static_cast<std::size_t>(i)] = static_cast<float>(i % side - settings.half);
      y[static_cast<std::size_t>(i)] = static_cast<float>(i / side - settings.half);
    }
  }
};

struct Moments {
  double weight = 0, sampled_mean = 0, sampled_variance = 0, mean = 0, variance = 0, covariance = 0;
};

/// Lower Cholesky factor in place; false if the matrix is not positive definite.
bool factorize(double* a) {
  for (int i = 0; i < kParameters; ++i)
    for (int j = 0; j <= i; ++j) {
      double s = a[i * kParameters + j];
      for (int k = 0; k < j; ++k) s -= a[i * kParameters + k] * a[j * kParameters + k];
      if (i == j) {
        if (!(s > 1e-12)) return false;
        a[i * kParameters + i] = std::sqrt(s);
      } else {
        a[i * kParameters + j] = s / a[j * kParameters + j];
      }
    }
  return true;
}

void solve(const double* l, double* b) {
  for (int i = 0; i < kParameters; ++i) {
    for (int k = 0; k < i; ++k) b[i] -= l[i * kParameters + k] * b[k];
    b[i] /= l[i * kParameters + i];
  }
  for (int i = kParameters - 1; i >= 0; --i) {
    for (int k = i + 1; k < kParameters; ++k) b[i] -= l[k * kParameters + i] * b[k];
    b[i] /= l[i * kParameters + i];
  }
}

/// Values, gradients and weights of a template; pixels without all of them weigh nothing. Returns the sum of the
/// weights.
double load_template(const float* patch, const PatchSettings& settings, Workspace& work) {
  const int side = 2 * settings.half + 1, stride = side + 2;
  double total = 0.0, sum = 0.0;
  for (int row = 0, i = 0; row < side; ++row)
    for (int column = 0; column < side; ++column, ++i) {
      const float* at = patch + (row + 1) * stride + column + 1;
      const float by_x = 0.5F * (at[1] - at[-1]), by_y = 0.5F * (at[stride] - at[-stride]);
      const bool whole = std::isfinite(by_x + by_y + at[0]);
      const auto n = static_cast<std::size_t>(i);
      work.value[n] = whole ? at[0] : 0.0F;
      work.gradient_x[n] = whole ? by_x : 0.0F;
      work.gradient_y[n] = whole ? by_y : 0.0F;
      work.weight[n] = whole ? static_cast<float>(settings.weight[i]) : 0.0F;
      total += work.weight[n];
      sum += work.weight[n] * work.value[n];
    }
  work.mean = total > 0.0 ? static_cast<float>(sum / total) : 0.0F;
  for (float& value : work.value) value -= work.mean;
  return total;
}

/// Hessian of the weighted squared differences.
template <int kBytes>
UNI4D_FG_INLINE void sum_hessian(const Workspace& work, double* out) {
  SimdFloat<kBytes> sums[21];
  for (SimdFloat<kBytes>& s : sums) s = SimdFloat<kBytes>{};
  for (int b = 0; b < work.blocks; ++b) {
    const auto at = static_cast<std::size_t>(b * kSimdFloatWidth);
    const SimdFloat<kBytes> x = load<SimdFloat<kBytes>>(&work.x[at]), y = load<SimdFloat<kBytes>>(&work.y[at]),
                            w = load<SimdFloat<kBytes>>(&work.weight[at]);
    const SimdFloat<kBytes> gx = load<SimdFloat<kBytes>>(&work.gradient_x[at]),
                            gy = load<SimdFloat<kBytes>>(&work.gradient_y[at]);
    const SimdFloat<kBytes> row[kParameters] = {gx, gy, gx * x, gx * y, gy * x, gy * y};
    for (int i = 0, n = 0; i < kParameters; ++i) {
      const SimdFloat<kBytes> weighted = w * row[i];
      for (int j = 0; j <= i; ++j, ++n) sums[n] += weighted * row[j];
    }
  }
  for (int i = 0, n = 0; i < kParameters; ++i)
    for (int j = 0; j <= i; ++j, ++n) out[i * kParameters + j] = sum(sums[n]);
}

/// An affine warp as the pixel around which it lies, and what is added to that.
struct Place {
  int left, top;
  float u, v, a, b, c, d;
};

/// Find the four pixels around where each pixel of the patch lies: the upper left of them, and how far it is from
/// there. Those that are not all in the image weigh nothing, and are taken from its beginning.
UNI4D_FG_WIDE_CLONES void locate(const Place& place, int width, int height, int size, const float* __restrict x,
                                 const float* __restrict y, const float* __restrict weight, int* __restrict at,
                                 float* __restrict fu, float* __restrict fv, float* __restrict used) {
  const int first_column = -place.left, last_column = width - 1 - place.left, first_row = -place.top;
  const int last_row = height - 1 - place.top, origin = place.top * width + place.left;
  for (int i = 0; i < size; ++i) {
    const float u = place.u + place.a * x[i] + place.b * y[i], v = place.v + place.c * x[i] + place.d * y[i];
    const float whole_u = std::floor(u), whole_v = std::floor(v);
    const int column = static_cast<int>(whole_u), row = static_cast<int>(whole_v);
    // A number and no truth value, so that nothing branches.
    const int inside = static_cast<int>(column >= first_column) & static_cast<int>(row >= first_row) &
                       static_cast<int>(column < last_column) & static_cast<int>(row < last_row);
    fu[i] = u - whole_u;
    fv[i] = v - whole_v;
    at[i] = inside * (row * width + column + origin);
    used[i] = weight[i] * static_cast<float>(inside);
  }
}

/// Take pairs of neighboring pixels.
void gather(const std::uint8_t* from, int size, const int* __restrict at, std::uint16_t* __restrict pairs) {
  for (int i = 0; i < size; ++i) std::memcpy(pairs + i, from + at[i], sizeof(std::uint16_t));
}

/// Bilinear gray levels, less the mean of the template, from the two pixels above and the two below.
UNI4D_FG_WIDE_CLONES void interpolate(int size, float mean, const std::uint16_t* __restrict upper,
                                      const std::uint16_t* __restrict lower, const float* __restrict fu,
                                      const float* __restrict fv, float* __restrict sampled) {
  for (int i = 0; i < size; ++i) {
    const auto p = static_cast<float>(upper[i] & 255), q = static_cast<float>(upper[i] >> 8);
    const auto r = static_cast<float>(lower[i] & 255), s = static_cast<float>(lower[i] >> 8);
    const float above = p + fu[i] * (q - p), below = r + fu[i] * (s - r);
    sampled[i] = above + fv[i] * (below - above) - mean;
  }
}

/// Sample the image under a warp; pixels that fall outside weigh nothing in `used`.
void sample(const GrayImage& image, const double* warp, Workspace& work) {
  const double left = std::floor(warp[0]), top = std::floor(warp[1]);
  const Place place{static_cast<int>(left),
                    static_cast<int>(top),
                    static_cast<float>(warp[0] - left),
                    static_cast<float>(warp[1] - top),
                    static_cast<float>(warp[2]),
                    static_cast<float>(warp[3]),
                    static_cast<float>(warp[4]),
                    static_cast<float>(warp[5])};
  const int size = work.blocks * kSimdFloatWidth;
  locate(place, image.width, image.height, size, work.x.data(), work.y.data(), work.weight.data(), work.at.data(),
         work.fu.data(), work.fv.data(), work.used.data());
  gather(image.data, size, work.at.data(), work.upper.data());
  gather(image.data + image.width, size, work.at.data(), work.lower.data());
  interpolate(size, work.mean, work.upper.data(), work.lower.data(), work.fu.data(), work.fv.data(),
              work.sampled.data());
}

/// Weighted means, variances and covariance of what was sampled and of the template, where both are known.
template <int kBytes>
UNI4D_FG_INLINE Moments sum_moments(const Workspace& work) {
  SimdFloat<kBytes> sums[6];
  for (SimdFloat<kBytes>& s : sums) s = SimdFloat<kBytes>{};
  for (int b = 0; b < work.blocks; ++b) {
    const auto i = static_cast<std::size_t>(b * kSimdFloatWidth);
    const SimdFloat<kBytes> w = load<SimdFloat<kBytes>>(&work.used[i]),
                            value = load<SimdFloat<kBytes>>(&work.sampled[i]);
    const SimdFloat<kBytes> first = load<SimdFloat<kBytes>>(&work.value[i]);
    const SimdFloat<kBytes> weighted = w * value, other = w * first;
    sums[0] += w;
    sums[1] += weighted;
    sums[2] += weighted * value;
    sums[3] += other;
    sums[4] += other * first;
    sums[5] += other * value;
  }
  Moments out;
  out.weight = sum(sums[0]);
  if (!(out.weight > 0.0)) return out;
  out.sampled_mean = sum(sums[1]) / out.weight;
  out.sampled_variance = sum(sums[2]) / out.weight - out.sampled_mean * out.sampled_mean;
  out.mean = sum(sums[3]) / out.weight;
  out.variance = sum(sums[4]) / out.weight - out.mean * out.mean;
  out.covariance = sum(sums[5]) / out.weight - out.mean * out.sampled_mean;
  return out;
}

template <int kBytes>
UNI4D_FG_INLINE void sum_gradient(const Workspace& work, const Moments& moments, double* out) {
  const auto gain = static_cast<float>(std::sqrt(moments.variance / moments.sampled_variance));
  const auto offset = static_cast<float>(moments.mean - gain * moments.sampled_mean);
  SimdFloat<kBytes> sums[kParameters];
  for (SimdFloat<kBytes>& s : sums) s = SimdFloat<kBytes>{};
  for (int b = 0; b < work.blocks; ++b) {
    const auto at = static_cast<std::size_t>(b * kSimdFloatWidth);
    const SimdFloat<kBytes> x = load<SimdFloat<kBytes>>(&work.x[at]), y = load<SimdFloat<kBytes>>(&work.y[at]);
    const SimdFloat<kBytes> difference =
        gain * load<SimdFloat<kBytes>>(&work.sampled[at]) - load<SimdFloat<kBytes>>(&work.value[at]) + offset;
    const SimdFloat<kBytes> weighted = load<SimdFloat<kBytes>>(&work.used[at]) * difference;
    const SimdFloat<kBytes> by_x = weighted * load<SimdFloat<kBytes>>(&work.gradient_x[at]);
    const SimdFloat<kBytes> by_y = weighted * load<SimdFloat<kBytes>>(&work.gradient_y[at]);
    sums[0] += by_x;
    sums[1] += by_y;
    sums[2] += by_x * x;
    sums[3] += by_x * y;
    sums[4] += by_y * x;
    sums[5] += by_y * y;
  }
  for (int i = 0; i < kParameters; ++i) out[i] = sum(sums[i]);
}

UNI4D_FG_DISPATCH(void, hessian, (const Workspace& work, double* out), (work, out), sum_hessian<kBytes>(work, out))

UNI4D_FG_DISPATCH(Moments, compare, (const Workspace& work), (work), return sum_moments<kBytes>(work))

UNI4D_FG_DISPATCH(void, gradient, (const Workspace& work, const Moments& moments, double* out), (work, moments, out),
                  sum_gradient<kBytes>(work, moments, out))

/// Replace a warp W by W o D^{-1} for the step D; returns the moved distance of the center, infinite if there is none.
double compose(const double* step, double* warp) {
  const double a = 1.0 + step[2], b = step[3], c = step[4], d = 1.0 + step[5], determinant = a * d - b * c;
  if (!(determinant > kLeastDeterminant)) return INFINITY;
  const double i0 = d / determinant, i1 = -b / determinant, i2 = -c / determinant, i3 = a / determinant;
  const double x = -(i0 * step[0] + i1 * step[1]), y = -(i2 * step[0] + i3 * step[1]);
  const double u = warp[2] * x + warp[3] * y, v = warp[4] * x + warp[5] * y;
  const double old[4] = {warp[2], warp[3], warp[4], warp[5]};
  warp[0] += u;
  warp[1] += v;
  warp[2] = old[0] * i0 + old[1] * i2;
  warp[3] = old[0] * i1 + old[1] * i3;
  warp[4] = old[2] * i0 + old[3] * i2;
  warp[5] = old[2] * i1 + old[3] * i3;
  return std::sqrt(u * u + v * v);
}

/// Whether a warp is one whose pixels can be told in whole numbers; the patch is outside of the image if it is not.
bool is_near(const double* warp, const GrayImage& image) {
  if (image.width < 2 || image.height < 2) return false;
  for (int i = 0; i < 2; ++i)
    if (!(std::abs(warp[i]) < 1e6)) return false;
  for (int i = 2; i < kParameters; ++i)
    if (!(std::abs(warp[i]) < 1e3)) return false;
  return true;
}

/// Register one template; returns its correlation, -1 if there is none.
double register_one(const float* patch, const GrayImage& image, const PatchSettings& settings, Workspace& work,
                    double* warp) {
  const double total = load_template(patch, settings, work);
  double system[kParameters * kParameters], step[kParameters];
  hessian(work, system);
  const double stiffness = settings.stiffness * total * settings.half * settings.half;
  for (int i = 2; i < kParameters; ++i) system[i * kParameters + i] += stiffness;
  if (!factorize(system)) return -1.0;
  const double start[4] = {warp[2], warp[3], warp[4], warp[5]};
  double moved = INFINITY;
  for (int iteration = 0;; ++iteration) {
    if (!is_near(warp, image)) return -1.0;
    sample(image, warp, work);
    const Moments moments = compare(work);
    if (!(moments.weight >= kLeastInside * total) || !(moments.sampled_variance > kLeastVariance) ||
        !(moments.variance > kLeastVariance))
      return -1.0;
    if (iteration == settings.max_iterations || moved < settings.convergence_px)
      return moments.covariance / std::sqrt(moments.sampled_variance * moments.variance);
    gradient(work, moments, step);
    for (int i = 0; i < 4; ++i) step[i + 2] += stiffness * (warp[i + 2] - start[i]);
    solve(system, step);
    moved = compose(step, warp);
    if (!(moved < kLargestStepPx)) return -1.0;
  }
}

}  // namespace

void register_patches(const float* templates, const std::int64_t* rows, int count, const GrayImage& image,
                      const PatchSettings& settings, int threads, double* warp, double* correlation) {
  const long stride = static_cast<long>(2 * settings.half + 3) * (2 * settings.half + 3);
  parallel_for(count, useful_threads(threads, count, kGrain), [&](int begin, int end, int) {
    Workspace work(settings);
    for (long n = begin; n < end; ++n)
      correlation[n] = register_one(templates + rows[n] * stride, image, settings, work, warp + n * kParameters);
  });
}

}  // namespace uni4d_fg
