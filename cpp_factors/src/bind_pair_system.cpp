// Python face of PairSystem.
#include <nanobind/stl/pair.h>

#include "arrays.hpp"
#include "pair_system.hpp"

namespace uni4d_fg {

namespace {

/// Check the columns of free entries: each of [0, size) at most once, -1 for frozen ones.
std::vector<std::int64_t> expect_columns(const AnyArray& array, const char* name,
                                         std::initializer_list<std::int64_t> shape, int size) {
  const View<std::int64_t> view = expect_integers(array, name, shape);
  std::vector<std::int64_t> columns(view.data, view.data + view.size());
  for (const std::int64_t column : columns)
    if (column < -1 || column >= size)
      refuse(std::string(name) + ": column " + std::to_string(column) + " lies outside [-1, " + std::to_string(size) +
             ")");
  return columns;
}

const double* expect_poses(const PairSystem& system, const AnyArray& poses) {
  return expect_floats(poses, "poses", {system.num_poses(), 4, 4}).data;
}

constexpr int kMostColumns = 1 << 14;

}  // namespace

void bind_pair_system(nb::module_& module) {
  nb::class_<PairSystem>(module, "PairSystem",
                         "Depth reprojection factors of frame pairs with shared intrinsics: energy, Hessian, gradient. "
                         "Nothing changes after the constructor: any number of threads may call.")
      .def(
          "__init__",
          [](PairSystem* self, const AnyArray& source, const AnyArray& target, const AnyArray& uv_source,
             const AnyArray& depth, const AnyArray& uv_target, const AnyArray& sigma, const AnyArray& weight,
             int kernel, double threshold, const AnyArray& pose_columns, const AnyArray& intrinsics_columns, int size,
             int threads) {
            if (size < 0 || size > kMostColumns)
              refuse("size: expected a number in [0, " + std::to_string(kMostColumns) + "], got " +
                     std::to_string(size));
            const std::int64_t poses = expect_integers(pose_columns, "pose_columns", {kAnyLength, 6}).rows();
            const View<std::int64_t> sources = expect_rows(source, "source", kAnyLength, poses);
            PairRows rows;
            rows.count = expect_count(sources.rows(), "source");
            rows.source = sources.data;
            rows.target = expect_rows(target, "target", rows.count, poses).data;
            rows.uv_source = expect_floats(uv_source, "uv_source", {rows.count, 2}).data;
            rows.depth = expect_floats(depth, "depth", {rows.count}).data;
            rows.uv_target = expect_floats(uv_target, "uv_target", {rows.count, 2}).data;
            const Sigma sigmas = expect_sigma(sigma, "sigma", rows.count, 2);
            rows.sigma = sigmas.view.data;
            rows.sigma_columns = sigmas.columns;
            rows.weight = expect_weights(weight, "weight", rows.count).data;
            const Kernel checked_kernel = expect_kernel(kernel, threshold);
            std::vector<std::int64_t> pose_at = expect_columns(pose_columns, "pose_columns", {poses, 6}, size);
            std::vector<std::int64_t> intrinsics_at =
                expect_columns(intrinsics_columns, "intrinsics_columns", {4}, size);
            const int workers = expect_threads(threads);
            nb::gil_scoped_release release;
            new (self) PairSystem(expect_count(poses, "pose_columns"), rows, checked_kernel, std::move(pose_at),
                                  std::move(intrinsics_at), size, workers);
          },
          nb::kw_only(), nb::arg("source"), nb::arg("target"), nb::arg("uv_source"), nb::arg("depth"),
          nb::arg("uv_target"), nb::arg("sigma"), nb::arg("weight"), nb::arg("kernel"), nb::arg("threshold"),
          nb::arg("pose_columns"), nb::arg("intrinsics_columns"), nb::arg("size"), nb::arg("threads") = 0,
          "Take N factors between poses; the columns place every entry of the poses (T, 6) and of the intrinsics (4,) "
          "among `size` free entries, -1 for frozen ones.")
      .def(
          "energy",
          [](const PairSystem& self, const AnyArray& poses, const AnyArray& intrinsics) {
            const double* pose_data = expect_poses(self, poses);
            const double* intrinsics_data = expect_floats(intrinsics, "intrinsics", {4}).data;
            nb::gil_scoped_release release;
            return self.energy(pose_data, intrinsics_data);
          },
          nb::arg("poses"), nb::arg("intrinsics"),
          "Return sum_n weight_n rho(|r_n / sigma_n|) at poses (T, 4, 4) and intrinsics (4,).")
      .def(
          "linearize",
          [](const PairSystem& self, const AnyArray& poses, const AnyArray& intrinsics) {
            const double* pose_data = expect_poses(self, poses);
            const double* intrinsics_data = expect_floats(intrinsics, "intrinsics", {4}).data;
            const auto size = static_cast<std::size_t>(self.size());
            NewArray hessian({size, size}), gradient({size});
            {
              nb::gil_scoped_release release;
              self.linearize(pose_data, intrinsics_data, hessian.data(), gradient.data());
            }
            return std::pair(hessian.release(), gradient.release());
          },
          nb::arg("poses"), nb::arg("intrinsics"),
          "Return the Hessian J^T J (size, size) and the gradient J^T r (size,), kernels applied (IRLS).");
}

}  // namespace uni4d_fg
