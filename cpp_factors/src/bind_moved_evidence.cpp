// Python entry point of moved_evidence.hpp.
#include <nanobind/stl/pair.h>

#include <utility>

#include "arrays.hpp"
#include "moved_evidence.hpp"

namespace uni4d_fg {

namespace {

using SingleArray = nb::ndarray<nb::numpy, float>;

SingleArray compare(const AnyArray& color, const AnyArray& seen, const AnyArray& u, const AnyArray& v,
                    const AnyArray& du, const AnyArray& dv, const AnyArray& z, const AnyArray& sigma_depth,
                    const AnyArray& gxx, const AnyArray& gxy, const AnyArray& gyy, const AnyArray& variance,
                    const AnyArray& contrast, const nb::object& texture, const AnyArray& nearest, int patch,
                    int shadow_window, double deepest_shadow, double lit, double nearer,
                    std::pair<double, double> limits, int step) {
  const View<float> own = expect_singles(color, "color", {kAnyLength, kAnyLength, 3});
  ComparedPixels pixels;
  pixels.height = expect_count(own.shape[0], "color");
  pixels.width = expect_count(own.shape[1], "color");
  if (own.size() == 0) refuse("color: is empty");
  if (static_cast<double>(pixels.height) * pixels.width > 1e8) refuse("color: has more than 1e8 pixels");
  const auto map = [&](const AnyArray& array, const char* name) {
    return expect_singles(array, name, {own.shape[0], own.shape[1]}).data;
  };
  pixels.color = own.data;
  pixels.seen = expect_singles(seen, "seen", {own.shape[0], own.shape[1], 3}).data;
  pixels.u = map(u, "u");
  pixels.v = map(v, "v");
  pixels.du = map(du, "du");
  pixels.dv = map(dv, "dv");
  pixels.z = map(z, "z");
  pixels.sigma = map(sigma_depth, "sigma_depth");
  pixels.gxx = map(gxx, "gxx");
  pixels.gxy = map(gxy, "gxy");
  pixels.gyy = map(gyy, "gyy");
  pixels.variance = map(variance, "variance");
  pixels.contrast = map(contrast, "contrast");
  pixels.texture = texture.is_none() ? nullptr : map({texture}, "texture");
  pixels.nearest = map(nearest, "nearest");
  if (patch < 1 || patch > 1000 || shadow_window < 1 || shadow_window > 1000)
    refuse("patch, shadow_window: expected 1 to 1000");
  if (step < 1) refuse("step: expected a positive number");
  EvidenceOptions options;
  options.patch = patch;
  options.shadow_window = shadow_window;
  options.deepest_shadow = static_cast<float>(deepest_shadow);
  options.lit = static_cast<float>(lit);
  options.nearer = static_cast<float>(nearer);
  options.least = static_cast<float>(limits.first);
  options.most = static_cast<float>(limits.second);
  options.step = step;
  NewArrayOf<float> out({static_cast<std::size_t>(pixels.height), static_cast<std::size_t>(pixels.width)});
  float* data = out.data();
  {
    nb::gil_scoped_release release;
    moved_evidence(pixels, options, data);
  }
  return out.release();
}

}  // namespace

void bind_moved_evidence(nb::module_& module) {
  module.def("moved_evidence", &compare, nb::arg("color"), nb::arg("seen"), nb::arg("u"), nb::arg("v"), nb::arg("du"),
             nb::arg("dv"), nb::arg("z"), nb::arg("sigma_depth"), nb::arg("gxx"), nb::arg("gxy"), nb::arg("gyy"),
             nb::arg("variance"), nb::arg("contrast"), nb::arg("texture").none(), nb::arg("nearest"), nb::kw_only(),
             nb::arg("patch"), nb::arg("shadow_window"), nb::arg("deepest_shadow"), nb::arg("lit"), nb::arg("nearer"),
             nb::arg("limits"), nb::arg("step"),
             "Log odds (H, W), float32, that pixels of a frame with colors (H, W, 3) are not where a static scene has "
             "them in another, which has the colors seen (H, W, 3) there, at pixels u, v whose change by log depth is "
             "du, dv, and whose least depth around is nearest; (H, W) each, as are the predicted depth z, its "
             "sigma_depth, products of gradients, the variance of a difference of colors, and the contrast around. "
             "With a texture (H, W) a pixel may be one of the other frame in a shadow.");
}

}  // namespace uni4d_fg
