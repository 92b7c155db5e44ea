// Python entry point of guided_upsampling.hpp.
#include "arrays.hpp"
#include "guided_upsampling.hpp"

namespace uni4d_fg {

namespace {

nb::ndarray<nb::numpy, float> upsample(const AnyArray& values, const AnyArray& colors, const AnyArray& image,
                                       double spatial, double color, int threads) {
  const View<float> map = expect_singles(values, "values", {kAnyLength, kAnyLength});
  const View<float> small = expect_singles(colors, "colors", {map.shape[0], map.shape[1], 3});
  const View<std::uint8_t> large = expect_bytes(image, "image", {kAnyLength, kAnyLength, 3});
  if (map.size() == 0) refuse("values: is empty");
  if (map.size() > 100'000'000 || large.size() > 300'000'000) refuse("values, image: have more than 1e8 pixels");
  if (!(spatial > 0.0) || !(color > 0.0)) refuse("spatial, color: expected positive numbers");
  const int height = expect_count(large.shape[0], "image"), width = expect_count(large.shape[1], "image");
  const CoarseMap coarse{map.data, small.data, expect_count(map.shape[0], "values"),
                         expect_count(map.shape[1], "values")};
  const GuidedWeights weights{static_cast<float>(spatial), static_cast<float>(color)};
  const int workers = expect_threads(threads);
  NewArrayOf<float> out({static_cast<std::size_t>(height), static_cast<std::size_t>(width)});
  {
    nb::gil_scoped_release release;
    upsample_guided(coarse, large.data, height, width, weights, workers, out.data());
  }
  return out.release();
}

}  // namespace

void bind_guided_upsampling(nb::module_& module) {
  module.def("upsample_guided", &upsample, nb::arg("values"), nb::arg("colors"), nb::arg("image"), nb::kw_only(),
             nb::arg("spatial"), nb::arg("color"), nb::arg("threads") = 0,
             "Bring a map (h, w), NaN where missing, to the size of an image (H, W, 3) of bytes, with colors (h, w, 3), "
             "the image at the map's size, of 255: a mean over nine values, weighted by distance and by color, with "
             "standard deviations spatial (pixels of the map) and color (of 255).");
}

}  // namespace uni4d_fg
