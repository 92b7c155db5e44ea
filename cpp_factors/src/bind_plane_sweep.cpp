// Python entry points of multi-view depth: plane_sweep and depth_edges.
#include <nanobind/stl/tuple.h>

#include <tuple>

#include "arrays.hpp"
#include "depth_edges.hpp"
#include "plane_sweep.hpp"
#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

namespace {

using FloatArray = nb::ndarray<nb::numpy, double>;

std::vector<float> narrowed(const View<double>& view) { return std::vector<float>(view.data, view.data + view.size()); }

FloatArray widened(const std::vector<float>& values, int height, int width) {
  NewArray out({static_cast<std::size_t>(height), static_cast<std::size_t>(width)});
  for (std::size_t i = 0; i < values.size(); ++i) out.data()[i] = static_cast<double>(values[i]);
  return out.release();
}

/// An image and those that it is compared with, in single precision.
struct Compared {
  int height = 0, width = 0;
  std::vector<float> image, others;
  std::vector<SweepView> views;
};

Compared expect_compared(const AnyArray& image, const AnyArray& others, const AnyArray& turns, const AnyArray& shifts) {
  const View<double> reference = expect_floats(image, "image", {kAnyLength, kAnyLength}, false);
  const std::int64_t rows = reference.shape[0], columns = reference.shape[1];
  Compared out;
  out.height = expect_count(rows, "image");
  out.width = expect_count(columns, "image");
  if (out.height < 2 || out.width < 2) refuse("image: is smaller than two pixels");
  if (static_cast<double>(out.height) * out.width > 1e8) refuse("image: has more than 1e8 pixels");
  const View<double> sources = expect_floats(others, "others", {kAnyLength, rows, columns}, false);
  const std::int64_t count = sources.shape[0];
  const View<double> turn = expect_floats(turns, "turns", {count, 3, 3}),
                     shift = expect_floats(shifts, "shifts", {count, 3});
  if (count < 1 || count > 64) refuse("others: expected 1 to 64 images, got " + std::to_string(count));
  out.image = narrowed(reference);
  out.others = narrowed(sources);
  out.views.resize(static_cast<std::size_t>(count));
  for (std::size_t v = 0; v < out.views.size(); ++v) {
    out.views[v].image = out.others.data() + v * out.image.size();
    for (std::size_t i = 0; i < 9; ++i) out.views[v].turn[i] = static_cast<float>(turn.data[9 * v + i]);
    for (std::size_t i = 0; i < 3; ++i) out.views[v].shift[i] = static_cast<float>(shift.data[3 * v + i]);
  }
  return out;
}

std::tuple<FloatArray, FloatArray, FloatArray, FloatArray> sweep(const AnyArray& image, const AnyArray& others,
                                                                 const AnyArray& turns, const AnyArray& shifts,
                                                                 const AnyArray& inverse_depth, int radius,
                                                                 double noise, double difference_share,
                                                                 double largest_difference, int small_step,
                                                                 int large_step, double edge_contrast, int threads) {
  const Compared compared = expect_compared(image, others, turns, shifts);
  const int height = compared.height, width = compared.width;
  if (radius < 1 || radius > 7) refuse("radius: expected 1 to 7, got " + std::to_string(radius));
  if (height < 2 * radius + 1 || width < 2 * radius + 1) refuse("image: is smaller than the window");
  const View<double> planes = expect_floats(inverse_depth, "inverse_depth", {kAnyLength});
  if (planes.rows() < 4 || planes.rows() > 256)
    refuse("inverse_depth: expected 4 to 256 planes, got " + std::to_string(planes.rows()));
  if (small_step < 0 || large_step < small_step || large_step > 1000)
    refuse("small_step, large_step: expected 0 <= small_step <= large_step <= 1000");
  if (!(noise > 0.0) || !(edge_contrast > 0.0)) refuse("noise, edge_contrast: expected positive numbers");
  if (!(difference_share >= 0.0 && difference_share <= 1.0)) refuse("difference_share: expected 0 to 1");
  if (!(largest_difference > 0.0)) refuse("largest_difference: expected a positive number");
  SweepOptions options;
  options.radius = radius;
  options.noise = static_cast<float>(noise);
  options.difference_share = static_cast<float>(difference_share);
  options.largest_difference = static_cast<float>(largest_difference);
  options.small_step = small_step;
  options.large_step = large_step;
  options.edge_contrast = static_cast<float>(edge_contrast);
  options.threads = expect_threads(threads);
  SweepResult result;
  {
    nb::gil_scoped_release release;
    result = plane_sweep(compared.image.data(), height, width, compared.views, narrowed(planes), options);
  }
  return {widened(result.plane, height, width), widened(result.cost, height, width),
          widened(result.rival, height, width), widened(result.match, height, width)};
}

FloatArray edges(const AnyArray& inverse_depth, const AnyArray& image, const AnyArray& chosen, const AnyArray& others,
                 const AnyArray& turns, const AnyArray& shifts, int threads) {
  const Compared compared = expect_compared(image, others, turns, shifts);
  const View<double> inverse = expect_floats(inverse_depth, "inverse_depth", {compared.height, compared.width});
  const View<std::uint8_t> wanted = expect_bytes(chosen, "chosen", {compared.height, compared.width});
  for (std::size_t i = 0; i < compared.image.size(); ++i)
    if (!(inverse.data[i] > 0.0)) refuse("inverse_depth: expected positive numbers");
  const int workers = expect_threads(threads);
  std::vector<float> out;
  {
    nb::gil_scoped_release release;
    out = depth_edges(narrowed(inverse).data(), compared.image.data(), wanted.data, compared.height, compared.width,
                      compared.views, workers);
  }
  return widened(out, compared.height, compared.width);
}

}  // namespace

void bind_plane_sweep(nb::module_& module) {
  module.def("plane_sweep", &sweep, nb::arg("image"), nb::arg("others"), nb::arg("turns"), nb::arg("shifts"),
             nb::arg("inverse_depth"), nb::kw_only(), nb::arg("radius"), nb::arg("noise"), nb::arg("difference_share"),
             nb::arg("largest_difference"), nb::arg("small_step"), nb::arg("large_step"), nb::arg("edge_contrast"),
             nb::arg("threads") = 0,
             "Multi-view depth of an image (H, W) from others (V, H, W), NaN where nothing is to be matched, that see "
             "its pixel x at inverse depth rho at turns (V, 3, 3) x + rho shifts (V, 3). Returns, (H, W) each: the "
             "best plane as a number between those of inverse_depth (D,), its aggregated cost, that of the best plane "
             "elsewhere, and the matching cost, 0 to 255.");
  module.def("depth_edges", &edges, nb::arg("inverse_depth"), nb::arg("image"), nb::arg("chosen"), nb::arg("others"),
             nb::arg("turns"), nb::arg("shifts"), nb::kw_only(), nb::arg("threads") = 0,
             "Inverse depth (H, W), positive, in which pixels near edges, of those that are chosen (H, W), have the "
             "best one of those around them; images and where they see each other as in plane_sweep.");
}

}  // namespace uni4d_fg
