// Python entry points for noise and robust kernels: whiten and robust_energy.
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <numeric>

#include "arrays.hpp"
#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

namespace {

constexpr int kGrain = 2000;

using FloatArray = nb::ndarray<nb::numpy, double>;
using Linearized = std::pair<FloatArray, std::vector<FloatArray>>;

/// Noise, weight and kernel of a batch, checked.
struct Noise {
  Sigma sigma;
  View<double> weight;
  Kernel kernel;
};

Noise expect_noise(const AnyArray& sigma, const AnyArray& weight, int kernel, double threshold, std::int64_t rows,
                   int dim) {
  return {expect_sigma(sigma, "sigma", rows, dim), expect_weights(weight, "weight", rows),
          expect_kernel(kernel, threshold)};
}

/// Whiten one residual row into `out` and return its squared norm.
double whiten_row(const double* r, const Noise& noise, long n, int dim, double* inverse_sigma, double* out) {
  double squared = 0.0;
  for (int i = 0; i < dim; ++i) {
    inverse_sigma[i] = 1.0 / noise.sigma.view.data[noise.sigma.columns == 1 ? n : n * dim + i];
    out[i] = r[i] * inverse_sigma[i];
    squared += out[i] * out[i];
  }
  return squared;
}

Linearized whiten_batch(const AnyArray& residual, const std::vector<AnyArray>& jacobians, const AnyArray& sigma,
                        const AnyArray& weight, int kernel, double threshold, int threads) {
  const View<double> r = expect_floats(residual, "residual", {kAnyLength, kAnyLength});
  const int count = expect_count(r.rows(), "residual");
  const int dim = static_cast<int>(r.shape[1]);
  if (dim < 1 || dim > 16) refuse("residual: expected 1 to 16 columns, got " + std::to_string(dim));
  const Noise noise = expect_noise(sigma, weight, kernel, threshold, r.rows(), dim);
  const int workers = useful_threads(expect_threads(threads), count, kGrain);
  std::vector<View<double>> blocks;
  std::vector<NewArray> results;
  const auto n = static_cast<std::size_t>(count), d = static_cast<std::size_t>(dim);
  results.emplace_back(std::vector<std::size_t>{n, d});
  for (const AnyArray& jacobian : jacobians) {
    blocks.push_back(expect_floats(jacobian, "jacobians", {r.rows(), dim, kAnyLength}));
    results.emplace_back(std::vector<std::size_t>{n, d, static_cast<std::size_t>(blocks.back().shape[2])});
  }
  {
    nb::gil_scoped_release release;
    parallel_for(count, workers, [&](int begin, int end, int) {
      double inverse_sigma[16];
      for (long row = begin; row < end; ++row) {
        double* out = results[0].data() + row * dim;
        const double squared = whiten_row(r.data + row * dim, noise, row, dim, inverse_sigma, out);
        const double scale = irls_scale(noise.kernel, noise.weight.data[row], squared);
        for (int i = 0; i < dim; ++i) out[i] *= scale;
        for (std::size_t b = 0; b < blocks.size(); ++b) {
          const long width = blocks[b].shape[2];
          for (int i = 0; i < dim; ++i) {
            const double* from = blocks[b].data + (row * dim + i) * width;
            double* to = results[b + 1].data() + (row * dim + i) * width;
            for (long j = 0; j < width; ++j) to[j] = from[j] * (inverse_sigma[i] * scale);
          }
        }
      }
    });
  }
  std::vector<FloatArray> scaled;
  for (std::size_t b = 1; b < results.size(); ++b) scaled.push_back(results[b].release());
  return {results[0].release(), scaled};
}

double robust_energy(const AnyArray& residual, const AnyArray& sigma, const AnyArray& weight, int kernel,
                     double threshold, int threads) {
  const View<double> r = expect_floats(residual, "residual", {kAnyLength, kAnyLength});
  const int count = expect_count(r.rows(), "residual");
  const int dim = static_cast<int>(r.shape[1]);
  if (dim < 1 || dim > 16) refuse("residual: expected 1 to 16 columns, got " + std::to_string(dim));
  const Noise noise = expect_noise(sigma, weight, kernel, threshold, r.rows(), dim);
  const int workers = useful_threads(expect_threads(threads), count, kGrain);
  // Ranges of fixed length, added in order: the sum does not depend on the number of threads.
  std::vector<double> partial(static_cast<std::size_t>(count / kGrain + 1), 0.0);
  {
    nb::gil_scoped_release release;
    parallel_for(static_cast<int>(partial.size()), workers, [&](int first, int last, int) {
      double inverse_sigma[16], white[16];
      for (int range = first; range < last; ++range)
        for (long row = long{range} * kGrain; row < std::min<long>(count, (range + 1L) * kGrain); ++row)
          partial[static_cast<std::size_t>(range)] +=
              noise.weight.data[row] *
              rho(noise.kernel, whiten_row(r.data + row * dim, noise, row, dim, inverse_sigma, white));
    });
  }
  return std::accumulate(partial.begin(), partial.end(), 0.0);
}

}  // namespace

void bind_whitening(nb::module_& module) {
  module.def("whiten", &whiten_batch, nb::arg("residual"), nb::arg("jacobians"), nb::kw_only(), nb::arg("sigma"),
             nb::arg("weight"), nb::arg("kernel"), nb::arg("threshold"), nb::arg("threads") = 0,
             "Scale residuals (N, d) and Jacobians (N, d, dim) by 1 / sigma and by sqrt(weight w(s)), s the whitened "
             "norm.");
  module.def("robust_energy", &robust_energy, nb::arg("residual"), nb::kw_only(), nb::arg("sigma"), nb::arg("weight"),
             nb::arg("kernel"), nb::arg("threshold"), nb::arg("threads") = 0,
             "Return sum_n weight_n rho(|r_n / sigma_n|) of residuals (N, d).");
}

}  // namespace uni4d_fg
