// Python entry point for patch_registration.hpp.
#include <nanobind/stl/pair.h>

#include <algorithm>

#include "arrays.hpp"
#include "patch_registration.hpp"

namespace uni4d_fg {

namespace {

using FloatArray = nb::ndarray<nb::numpy, double>;

std::pair<FloatArray, FloatArray> register_all(const AnyArray& templates, const AnyArray& rows, const AnyArray& image,
                                               const AnyArray& warp, const AnyArray& weight, double stiffness,
                                               int max_iterations, double convergence_px, int threads) {
  const View<double> w = expect_floats(weight, "weight", {kAnyLength, kAnyLength});
  const std::int64_t side = w.rows();
  if (side < 3 || side > 101 || side % 2 == 0 || w.shape[1] != side)
    refuse("weight: expected a square of odd side, 3 to 101");
  for (std::int64_t i = 0; i < w.size(); ++i)
    if (!(w.data[i] >= 0.0)) refuse("weight: a value is negative");
  const View<float> patches = expect_singles(templates, "templates", {kAnyLength, side + 2, side + 2});
  const View<std::uint8_t> gray = expect_bytes(image, "image", {kAnyLength, kAnyLength});
  const View<double> start = expect_floats(warp, "warp", {kAnyLength, 6});
  const View<std::int64_t> which = expect_rows(rows, "rows", start.rows(), patches.rows());
  if (!(stiffness >= 0.0) || !std::isfinite(stiffness)) refuse("stiffness: expected a finite number, 0 or more");
  if (max_iterations < 0) refuse("max_iterations: expected 0 or more");
  if (!(convergence_px >= 0.0)) refuse("convergence_px: expected 0 or more");
  const int count = expect_count(start.rows(), "warp");
  const int workers = expect_threads(threads);
  const GrayImage where{gray.data, expect_count(gray.shape[0], "image"), expect_count(gray.shape[1], "image")};
  const PatchSettings settings{static_cast<int>(side / 2), w.data, stiffness, max_iterations, convergence_px};
  NewArray found({static_cast<std::size_t>(count), 6}), correlation({static_cast<std::size_t>(count)});
  {
    nb::gil_scoped_release release;
    std::copy(start.data, start.data + start.size(), found.data());
    register_patches(patches.data, which.data, count, where, settings, workers, found.data(), correlation.data());
  }
  return {found.release(), correlation.release()};
}

}  // namespace

void bind_patch_registration(nb::module_& module) {
  module.def("register_patches", &register_all, nb::arg("templates"), nb::arg("rows"), nb::arg("image"),
             nb::arg("warp"), nb::kw_only(), nb::arg("weight"), nb::arg("stiffness"), nb::arg("max_iterations"),
             nb::arg("convergence_px"), nb::arg("threads") = 0,
             "Find the rows (N,) of templates (M, P + 2, P + 2) in an image (H, W) of bytes under affine warps, from warp "
             "(N, 6): u, v and the affine part by rows. Returns the warps and the correlations (N,), -1 where there is "
             "none.");
}

}  // namespace uni4d_fg
