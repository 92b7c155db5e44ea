// Python entry point of frame_comparison.hpp.
#include "arrays.hpp"
#include "frame_comparison.hpp"

namespace uni4d_fg {

namespace {

using SingleArray = nb::ndarray<nb::numpy, float>;

SingleArray compare(const AnyArray& inverse_depth, const nb::list& others, const AnyArray& turns,
                    const AnyArray& shifts, double agree, double alike, int threads) {
  const View<float> own = expect_singles(inverse_depth, "inverse_depth", {kAnyLength, kAnyLength});
  const int height = expect_count(own.shape[0], "inverse_depth"), width = expect_count(own.shape[1], "inverse_depth");
  if (static_cast<double>(height) * width > 1e8) refuse("inverse_depth: has more than 1e8 pixels");
  const auto count = static_cast<std::int64_t>(others.size());
  const View<double> turn = expect_floats(turns, "turns", {count, 3, 3});
  const View<double> shift = expect_floats(shifts, "shifts", {count, 3});
  if (!(agree >= 1.0) || !(alike >= 1.0)) refuse("agree, alike: expected ratios of 1 or more");
  std::vector<ComparedFrame> frames(others.size());
  for (std::size_t n = 0; n < frames.size(); ++n) {
    const View<float> map = expect_singles({nb::borrow(others[n])}, "others", {kAnyLength, kAnyLength});
    if (map.size() == 0) refuse("others: a map is empty");
    if (map.size() > 100'000'000) refuse("others: a map has more than 1e8 pixels");
    frames[n].inverse_depth = map.data;
    frames[n].height = expect_count(map.shape[0], "others");
    frames[n].width = expect_count(map.shape[1], "others");
    for (std::size_t i = 0; i < 9; ++i) frames[n].turn[i] = static_cast<float>(turn.data[9 * n + i]);
    for (std::size_t i = 0; i < 3; ++i) frames[n].shift[i] = static_cast<float>(shift.data[3 * n + i]);
  }
  const ComparisonBounds bounds{static_cast<float>(agree), static_cast<float>(alike)};
  const int workers = expect_threads(threads);
  NewArrayOf<float> out({4, static_cast<std::size_t>(height), static_cast<std::size_t>(width)});
  const std::int64_t size = own.size();
  float* data = out.data();
  {
    nb::gil_scoped_release release;
    compare_frames(own.data, height, width, frames, bounds, workers,
                   {data, data + size, data + 2 * size, data + 3 * size});
  }
  return out.release();
}

}  // namespace

void bind_frame_comparison(nb::module_& module) {
  module.def("compare_frames", &compare, nb::arg("inverse_depth"), nb::arg("others"), nb::arg("turns"),
             nb::arg("shifts"), nb::kw_only(), nb::arg("agree"), nb::arg("alike"), nb::arg("threads") = 0,
             "Compare the inverse depth (H, W) of a frame with a list of that of others (Hn, Wn), NaN where missing, "
             "that see its pixel x at inverse depth rho at turns (N, 3, 3) x + rho shifts (N, 3). Returns float32 "
             "(4, H, W): the product of the depth ratios of the frames that agree, as the ratio is below agree and "
             "above its inverse, how many agree, how many have depth there, and how many are alike, by the other bound.");
}

}  // namespace uni4d_fg
