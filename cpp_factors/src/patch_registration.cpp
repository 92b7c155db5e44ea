#include "patch_registration.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "uni4d_fg/parallel.hpp"
#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

namespace {

constexpr int kGrain = 64;
constexpr int kParameters = 6;
constexpr double kLeastVariance = 1.0;    // gray levels squared: what has less contrast is not registered
constexpr double kLeastInside = 0.5;      // part of the weight that must lie inside the image
constexpr double kLargestStepPx = 5.0;    // a longer one is no refinement
constexpr double kLeastDeterminant = 0.1; // of an affine step

/// Pixels of one patch, padded to whole SIMD values by pixels of weight zero.
struct Workspace {
  int blocks;
  std::vector<double> x, y, weight, value, gradient_x, gradient_y, sampled, used;

  explicit Workspace(const PatchSettings& settings) {
    const int side = 2 * settings.half + 1;
    blocks = (side * side + kSimd8Width - 1) / kSimd8Width;
    const auto size = static_cast<std::size_t>(blocks * kSimd8Width);
    for (auto* array : {&x, &y, &weight, &value, &gradient_x, &gradient_y, &sampled, &used}) array->assign(size, 0.0);
    for (int i = 0; i < side * side; ++i) {
      x[static_cast<std::size_t>(i)] = i % side - settings.half;
      y[static_cast<std::size_t>(i)] = i / side - settings.half;
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

/// Values, gradients and weights of a template; pixels without all of them weigh nothing.
void load_template(const float* patch, const PatchSettings& settings, Workspace& work) {
  const int side = 2 * settings.half + 1, stride = side + 2;
  for (int row = 0, i = 0; row < side; ++row)
    for (int column = 0; column < side; ++column, ++i) {
      const float* at = patch + (row + 1) * stride + column + 1;
      const double by_x = 0.5 * (static_cast<double>(at[1]) - at[-1]);
      const double by_y = 0.5 * (static_cast<double>(at[stride]) - at[-stride]);
      const bool whole = std::isfinite(by_x + by_y + at[0]);
      const auto n = static_cast<std::size_t>(i);
      work.value[n] = whole ? at[0] : 0.0;
      work.gradient_x[n] = whole ? by_x : 0.0;
      work.gradient_y[n] = whole ? by_y : 0.0;
      work.weight[n] = whole ? settings.weight[i] : 0.0;
    }
}

/// Hessian of the weighted squared differences; returns the sum of the weights.
UNI4D_FG_WIDE_CLONES double hessian(const Workspace& work, double* out) {
  Simd8 sums[21], total{};
  for (Simd8& s : sums) s = Simd8{};
  for (int b = 0; b < work.blocks; ++b) {
    const auto at = static_cast<std::size_t>(b * kSimd8Width);
    const Simd8 x = load_simd8(&work.x[at]), y = load_simd8(&work.y[at]), w = load_simd8(&work.weight[at]);
    const Simd8 gx = load_simd8(&work.gradient_x[at]), gy = load_simd8(&work.gradient_y[at]);
    const Simd8 row[kParameters] = {gx, gy, gx * x, gx * y, gy * x, gy * y};
    for (int i = 0, n = 0; i < kParameters; ++i) {
      const Simd8 weighted = w * row[i];
      for (int j = 0; j <= i; ++j, ++n) sums[n] += weighted * row[j];
    }
    total += w;
  }
  for (int i = 0, n = 0; i < kParameters; ++i)
    for (int j = 0; j <= i; ++j, ++n) out[i * kParameters + j] = sum(sums[n]);
  return sum(total);
}

/// Sample the image under a warp; pixels that fall outside weigh nothing in `used`.
UNI4D_FG_WIDE_CLONES Moments sample(const GrayImage& image, const double* warp, Workspace& work) {
  const double right = image.width - 1, bottom = image.height - 1;
  Simd8 sums[6];
  for (Simd8& s : sums) s = Simd8{};
  for (int b = 0; b < work.blocks; ++b) {
    const auto at = static_cast<std::size_t>(b * kSimd8Width);
    const Simd8 x = load_simd8(&work.x[at]), y = load_simd8(&work.y[at]);
    const Simd8 u = warp[0] + warp[2] * x + warp[3] * y, v = warp[1] + warp[4] * x + warp[5] * y;
    Simd8 w = load_simd8(&work.weight[at]), fu{}, fv{}, p[4] = {};
    for (int l = 0; l < kSimd8Width; ++l) {
      if (!(u[l] >= 0.0 && v[l] >= 0.0 && u[l] < right && v[l] < bottom)) {
        w[l] = 0.0;
        continue;
      }
      const int column = static_cast<int>(u[l]), row = static_cast<int>(v[l]);
      const double* from = image.data + static_cast<long>(row) * image.width + column;
      fu[l] = u[l] - column;
      fv[l] = v[l] - row;
      p[0][l] = from[0];
      p[1][l] = from[1];
      p[2][l] = from[image.width];
      p[3][l] = from[image.width + 1];
    }
    const Simd8 above = p[0] + fu * (p[1] - p[0]), below = p[2] + fu * (p[3] - p[2]);
    const Simd8 value = above + fv * (below - above), first = load_simd8(&work.value[at]);
    store_simd8(value, &work.sampled[at]);
    store_simd8(w, &work.used[at]);
    sums[0] += w;
    sums[1] += w * value;
    sums[2] += w * value * value;
    sums[3] += w * first;
    sums[4] += w * first * first;
    sums[5] += w * first * value;
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

UNI4D_FG_WIDE_CLONES void gradient(const Workspace& work, const Moments& moments, double* out) {
  const double gain = std::sqrt(moments.variance / moments.sampled_variance);
  Simd8 sums[kParameters];
  for (Simd8& s : sums) s = Simd8{};
  for (int b = 0; b < work.blocks; ++b) {
    const auto at = static_cast<std::size_t>(b * kSimd8Width);
    const Simd8 x = load_simd8(&work.x[at]), y = load_simd8(&work.y[at]);
    const Simd8 difference = gain * (load_simd8(&work.sampled[at]) - broadcast(moments.sampled_mean)) -
                             (load_simd8(&work.value[at]) - broadcast(moments.mean));
    const Simd8 weighted = load_simd8(&work.used[at]) * difference;
    const Simd8 by_x = weighted * load_simd8(&work.gradient_x[at]), by_y = weighted * load_simd8(&work.gradient_y[at]);
    sums[0] += by_x;
    sums[1] += by_y;
    sums[2] += by_x * x;
    sums[3] += by_x * y;
    sums[4] += by_y * x;
    sums[5] += by_y * y;
  }
  for (int i = 0; i < kParameters; ++i) out[i] = sum(sums[i]);
}

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

/// Register one template; returns its correlation, -1 if there is none.
double register_one(const float* patch, const GrayImage& image, const PatchSettings& settings, Workspace& work,
                    double* warp) {
  load_template(patch, settings, work);
  double system[kParameters * kParameters], step[kParameters];
  const double total = hessian(work, system);
  const double stiffness = settings.stiffness * total * settings.half * settings.half;
  for (int i = 2; i < kParameters; ++i) system[i * kParameters + i] += stiffness;
  if (!factorize(system)) return -1.0;
  const double start[4] = {warp[2], warp[3], warp[4], warp[5]};
  double moved = INFINITY;
  for (int iteration = 0;; ++iteration) {
    const Moments moments = sample(image, warp, work);
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
