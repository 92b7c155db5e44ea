#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <tuple>

#include "arrays.hpp"
#include "uni4d_fg/trajectory_system.hpp"

namespace uni4d_fg {
namespace {

using FloatArray = nb::ndarray<nb::numpy, double>;

/// Rows of a batch, checked and copied to the layout of TrajectorySystem.
struct CheckedRows {
  std::vector<std::int64_t> rows;
  std::int64_t count = 0;

  CheckedRows(const TrajectorySystem& system, const std::vector<AnyArray>& slots, std::size_t num_slots) {
    if (system.planned()) refuse("no batch can be added after plan()");
    if (slots.size() != num_slots) {
      refuse("rows: expected " + std::to_string(num_slots) + " arrays, one per slot, got " +
             std::to_string(slots.size()));
    }
    for (std::size_t s = 0; s < slots.size(); ++s) {
      const std::string name = "rows[" + std::to_string(s) + "]";
      const auto view = expect_rows(slots[s], name.c_str(), s == 0 ? kAnyLength : count, system.num_points());
      if (s == 0) {
        count = view.rows();
        rows.resize(static_cast<std::size_t>(count) * num_slots);
      }
      for (std::size_t n = 0; n < static_cast<std::size_t>(count); ++n) rows[n * num_slots + s] = view.data[n];
    }
  }
};

/// The same with noise and kernel.
struct Checked : CheckedRows {
  Sigma sigma;
  View<double> weight;
  Kernel kernel;

  Checked(const TrajectorySystem& system, const std::vector<AnyArray>& slots, std::size_t num_slots, int dim,
          const AnyArray& sigma_array, const AnyArray& weight_array, int kernel_code, double threshold)
      : CheckedRows(system, slots, num_slots) {
    expect_count(4 * count, "rows[0]");
    sigma = expect_sigma(sigma_array, "sigma", count, dim);
    weight = expect_weights(weight_array, "weight", count);
    kernel = expect_kernel(kernel_code, threshold);
  }

  TrajectoryRows get() const {
    return {rows.data(), count, sigma.view.data, sigma.view.shape.size() == 2, weight.data, kernel};
  }
};

const double* expect_points(const TrajectorySystem& system, const AnyArray& points) {
  if (!system.planned()) refuse("call plan() first");
  return expect_floats(points, "points", {system.num_points(), 3}, false).data;
}

FloatArray to_array(const std::vector<double>& values) {
  NewArray out({values.size()});
  std::copy(values.begin(), values.end(), out.data());
  return out.release();
}

TrajectorySystem make_system(const AnyArray& track, int threads) {
  const auto view = expect_rows(track, "track", kAnyLength, std::numeric_limits<std::int64_t>::max());
  expect_count(24 * view.rows(), "track");
  std::vector<std::int64_t> first;
  for (std::int64_t i = 0; i < view.rows(); ++i) {
    if (i == 0 || view.data[i] != view.data[i - 1]) first.push_back(view.data[i]);
  }
  std::sort(first.begin(), first.end());
  if (std::adjacent_find(first.begin(), first.end()) != first.end()) {
    refuse("track: points of one track must be consecutive");
  }
  return TrajectorySystem(view.data, view.rows(), expect_threads(threads));
}

using LinearizeResult = std::tuple<FloatArray, std::optional<std::pair<int, std::int64_t>>>;

LinearizeResult linearize(TrajectorySystem& system, const AnyArray& points, double kernel_curvature) {
  const double* data = expect_points(system, points);
  if (const int batch = system.missing_linearization(); batch >= 0) {
    refuse("batch " + std::to_string(batch) + ": call set_linearized() before each linearize()");
  }
  if (!(kernel_curvature >= 0.0 && kernel_curvature < 1.0)) refuse("kernel_curvature: must be at least 0 and below 1");
  NonFinite bad;
  {
    nb::gil_scoped_release release;
    bad = system.linearize(data, kernel_curvature);
  }
  std::optional<std::pair<int, std::int64_t>> failure;
  if (bad.any()) failure = {bad.batch, bad.row};
  return {to_array(system.gradient()), failure};
}

std::optional<std::tuple<FloatArray, double, double, int>> solve(TrajectorySystem& system, double damping,
                                                                 double min_diagonal, double max_diagonal,
                                                                 double cg_tolerance, int cg_max_iterations) {
  if (!system.linearized()) refuse("linearize() must succeed before solve()");
  if (!(damping >= 0.0 && std::isfinite(damping))) refuse("damping: must be finite and not negative");
  if (!(min_diagonal >= 0.0 && max_diagonal >= min_diagonal)) {
    refuse("min_diagonal, max_diagonal: expected 0 <= min_diagonal <= max_diagonal");
  }
  if (!(cg_tolerance > 0.0 && cg_tolerance < 1.0)) refuse("cg_tolerance: must lie between 0 and 1");
  if (cg_max_iterations < 1) refuse("cg_max_iterations: must be at least 1");
  std::optional<TrajectoryStep> step;
  {
    nb::gil_scoped_release release;
    step = system.solve(damping, min_diagonal, max_diagonal, cg_tolerance, cg_max_iterations);
  }
  if (!step) return std::nullopt;
  return std::make_tuple(to_array(step->delta), step->norm, step->predicted_decrease, step->iterations);
}

FloatArray multiply(const TrajectorySystem& system, const AnyArray& vector) {
  if (!system.linearized()) refuse("linearize() must succeed before multiply()");
  const auto view = expect_floats(vector, "vector", {3 * system.num_points()});
  NewArray out({static_cast<std::size_t>(3 * system.num_points())});
  {
    nb::gil_scoped_release release;
    system.multiply(view.data, out.data());
  }
  return out.release();
}

FloatArray diagonal_blocks(const TrajectorySystem& system) {
  if (!system.linearized()) refuse("linearize() must succeed before diagonal_blocks()");
  NewArray out({static_cast<std::size_t>(system.num_points()), 3, 3});
  for (std::int64_t p = 0; p < system.num_points(); ++p) {
    const auto b = system.diagonal_block(p);
    const double full[9] = {b[0], b[1], b[2], b[1], b[3], b[4], b[2], b[4], b[5]};
    std::copy_n(full, 9, out.data() + 9 * p);
  }
  return out.release();
}

constexpr std::size_t kMostSlots = 8;
constexpr int kMostResiduals = 16;

int add_linearized(TrajectorySystem& system, const std::vector<AnyArray>& rows, int dim) {
  if (rows.empty() || rows.size() > kMostSlots) {
    refuse("rows: expected 1 to " + std::to_string(kMostSlots) + " arrays, one per slot, got " +
           std::to_string(rows.size()));
  }
  if (dim < 1 || dim > kMostResiduals) {
    refuse("dim: expected 1 to " + std::to_string(kMostResiduals) + ", got " + std::to_string(dim));
  }
  const CheckedRows checked(system, rows, rows.size());
  const auto slots = static_cast<int>(rows.size());
  expect_count(3 * checked.count * slots * dim, "rows[0]");
  system.add_linearized(checked.rows.data(), checked.count, slots, dim);
  return system.num_batches() - 1;
}

void set_linearized(TrajectorySystem& system, int index, const AnyArray& residual, const AnyArray& jacobians) {
  if (!system.planned()) refuse("call plan() first");
  if (index < 0 || index >= system.num_batches() || !system.is_linearized(index)) {
    refuse("index: " + std::to_string(index) + " is no batch of add_linearized()");
  }
  const std::int64_t count = system.num_factors(index), dim = system.dim(index);
  const auto r = expect_floats(residual, "residual", {count, dim});
  const auto j = expect_floats(jacobians, "jacobians", {count, dim, system.num_slots(index), 3});
  nb::gil_scoped_release release;
  system.set_linearized(index, r.data, j.data);
}

}  // namespace

void bind_trajectory_system(nb::module_& module) {
  using namespace nb::literals;
  nb::class_<TrajectorySystem>(module, "TrajectorySystem",
                               "Normal equations of many moving points, solved by preconditioned conjugate gradients.")
      .def(
          "__init__",
          [](TrajectorySystem* self, const AnyArray& track, int threads) {
            new (self) TrajectorySystem(make_system(track, threads));
          },
          "track"_a, "threads"_a = 0)
      .def(
          "add_dynamic_reprojection",
          [](TrajectorySystem& self, const std::vector<AnyArray>& rows, const AnyArray& uv, const AnyArray& world_T_cam,
             const AnyArray& intrinsics, const AnyArray& sigma, const AnyArray& weight, int kernel, double threshold) {
            const Checked checked(self, rows, 1, 2, sigma, weight, kernel, threshold);
            self.add_dynamic_reprojection(checked.get(), expect_floats(uv, "uv", {checked.count, 2}).data,
                                          expect_floats(world_T_cam, "world_T_cam", {checked.count, 4, 4}).data,
                                          expect_floats(intrinsics, "intrinsics", {checked.count, 4}).data);
          },
          "rows"_a, "uv"_a, "world_T_cam"_a, "intrinsics"_a, "sigma"_a, "weight"_a, "kernel"_a, "threshold"_a)
      .def(
          "add_dynamic_depth_prior",
          [](TrajectorySystem& self, const std::vector<AnyArray>& rows, const AnyArray& depth,
             const AnyArray& world_T_cam, const AnyArray& log_scale, const AnyArray& sigma, const AnyArray& weight,
             int kernel, double threshold) {
            const Checked checked(self, rows, 1, 1, sigma, weight, kernel, threshold);
            const auto cue = expect_floats(depth, "depth", {checked.count});
            expect_positive(cue, "depth");
            self.add_dynamic_depth_prior(checked.get(), cue.data,
                                         expect_floats(world_T_cam, "world_T_cam", {checked.count, 4, 4}).data,
                                         expect_floats(log_scale, "log_scale", {checked.count}).data);
          },
          "rows"_a, "depth"_a, "world_T_cam"_a, "log_scale"_a, "sigma"_a, "weight"_a, "kernel"_a, "threshold"_a)
      .def(
          "add_smoothness",
          [](TrajectorySystem& self, const std::vector<AnyArray>& rows, const AnyArray& sigma, const AnyArray& weight,
             int kernel, double threshold) {
            if (rows.size() != 2 && rows.size() != 3) refuse("rows: expected 2 or 3 arrays, one per slot");
            const Checked checked(self, rows, rows.size(), 3, sigma, weight, kernel, threshold);
            self.add_smoothness(checked.get(), static_cast<int>(rows.size()));
          },
          "rows"_a, "sigma"_a, "weight"_a, "kernel"_a, "threshold"_a)
      .def(
          "add_arap",
          [](TrajectorySystem& self, const std::vector<AnyArray>& rows, const AnyArray& sigma, const AnyArray& weight,
             int kernel, double threshold) {
            const Checked checked(self, rows, 4, 1, sigma, weight, kernel, threshold);
            self.add_arap(checked.get());
          },
          "rows"_a, "sigma"_a, "weight"_a, "kernel"_a, "threshold"_a)
      .def(
          "add_linearized", &add_linearized, "rows"_a, "dim"_a,
          "Add N factors of another type, rows[s] (N,) the points of slot s, with dim residuals each; return the index "
          "of the batch. Its energy counts as 0 and reweight leaves it alone.")
      .def("set_linearized", &set_linearized, "index"_a, "residual"_a, "jacobians"_a,
           "Give the next linearize the residuals (N, dim) and Jacobians (N, dim, slots, 3) of such a batch, whitened "
           "and "
           "with weights and kernels applied.")
      .def("plan",
           [](TrajectorySystem& self) {
             if (self.planned()) refuse("plan() can be called once");
             nb::gil_scoped_release release;
             self.plan();
           })
      .def(
          "reweight",
          [](TrajectorySystem& self, int batch, const AnyArray& weight, int kernel, double threshold) {
            if (!self.planned()) refuse("call plan() first");
            if (batch < 0 || batch >= self.num_batches()) refuse("batch: there is none of this number");
            const auto weights = expect_weights(weight, "weight", self.num_factors(batch));
            self.reweight(batch, weights.data, expect_kernel(kernel, threshold));
          },
          "batch"_a, "weight"_a, "kernel"_a, "threshold"_a)
      .def_prop_ro("num_points", &TrajectorySystem::num_points)
      .def_prop_ro("num_batches", &TrajectorySystem::num_batches)
      .def_prop_ro("threads", &TrajectorySystem::threads)
      .def(
          "energies",
          [](const TrajectorySystem& self, const AnyArray& points) {
            const double* data = expect_points(self, points);
            std::vector<double> out;
            {
              nb::gil_scoped_release release;
              out = self.energies(data);
            }
            return to_array(out);
          },
          "points"_a)
      .def("linearize", &linearize, "points"_a, "kernel_curvature"_a = 0.0)
      .def("multiply", &multiply, "vector"_a)
      .def("diagonal_blocks", &diagonal_blocks)
      .def("solve", &solve, "damping"_a, "min_diagonal"_a, "max_diagonal"_a, "cg_tolerance"_a, "cg_max_iterations"_a);
}

}  // namespace uni4d_fg
