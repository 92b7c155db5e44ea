// Python entry point of guided_median.hpp.
#include "arrays.hpp"
#include "guided_median.hpp"

namespace uni4d_fg {

namespace {

nb::ndarray<nb::numpy, float> median(const AnyArray& values, const AnyArray& weights, const AnyArray& slopes,
                                     const AnyArray& colors, const AnyArray& chosen, int reach, int step,
                                     double spatial, double steepest) {
  const View<float> map = expect_singles(values, "values", {kAnyLength, kAnyLength});
  const std::int64_t rows = map.shape[0], columns = map.shape[1];
  const View<float> weight = expect_singles(weights, "weights", {rows, columns});
  const View<float> slope = expect_singles(slopes, "slopes", {rows, columns, 2});
  const View<float> color = expect_singles(colors, "colors", {rows, columns, 3});
  const View<std::uint8_t> wanted = expect_bytes(chosen, "chosen", {rows, columns});
  if (map.size() > 100'000'000) refuse("values: has more than 1e8 pixels");
  if (reach < 0 || reach > 64 || step < 1) refuse("reach, step: expected 0 to 64 and at least 1");
  if (!(spatial > 0.0)) refuse("spatial: expected a positive number");
  if (!(steepest >= 0.0 && steepest < 1.0)) refuse("steepest: expected 0 to below 1");
  const WeightedMap weighted{map.data,   weight.data,
                             slope.data, color.data,
                             expect_count(rows, "values"), expect_count(columns, "values")};
  const MedianWindow window{reach - reach % step, step, static_cast<float>(spatial), static_cast<float>(steepest)};
  NewArrayOf<float> out({static_cast<std::size_t>(rows), static_cast<std::size_t>(columns)});
  {
    nb::gil_scoped_release release;
    guided_median(weighted, wanted.data, window, out.data());
  }
  return out.release();
}

}  // namespace

void bind_guided_median(nb::module_& module) {
  module.def("guided_median", &median, nb::arg("values"), nb::arg("weights"), nb::arg("slopes"), nb::arg("colors"),
             nb::arg("chosen"), nb::kw_only(), nb::arg("reach"), nb::arg("step"), nb::arg("spatial"),
             nb::arg("steepest"),
             "A map (h, w) with a weighted median of every step-th pixel of a window of half side reach where chosen "
             "(h, w), bytes, is not 0. Weights (h, w) are 0 where the map is missing; they fall by distance, with "
             "standard deviation spatial, px, and by difference of colors (h, w, 3), with one of sqrt(0.5). Values are "
             "continued by their slopes (h, w, 2), parts of themselves a pixel down and a pixel right, but changed by "
             "at most the part steepest.");
}

}  // namespace uni4d_fg
