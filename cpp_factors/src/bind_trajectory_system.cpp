#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <limits>
#include <mutex>
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

  CheckedRows(const std::vector<AnyArray>& slots, std::size_t num_slots, std::int64_t num_points) {
    if (slots.size() != num_slots) {
      refuse("rows: expected " + std::to_string(num_slots) + " arrays, one per slot, got " +
             std::to_string(slots.size()));
    }
    for (std::size_t s = 0; s < slots.size(); ++s) {
      const std::string name = "rows[" + std::to_string(s) + "]";
      const auto view = expect_rows(slots[s], name.c_str(), s == 0 ? kAnyLength : count, num_points);
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

  Checked(const std::vector<AnyArray>& slots, std::size_t num_slots, std::int64_t num_points, int dim,
          const AnyArray& sigma_array, const AnyArray& weight_array, int kernel_code, double threshold)
      : CheckedRows(slots, num_slots, num_points) {
    expect_count(4 * count, "rows[0]");
    sigma = expect_sigma(sigma_array, "sigma", count, dim);
    weight = expect_weights(weight_array, "weight", count);
    kernel = expect_kernel(kernel_code, threshold);
  }

  TrajectoryRows get() const {
    return {rows.data(), count, sigma.view.data, sigma.view.shape.size() == 2, weight.data, kernel};
  }
};

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

constexpr std::size_t kMostSlots = 8;
constexpr int kMostResiduals = 16;

void expect_planned(const TrajectorySystem& system) {
  if (!system.planned()) refuse("call plan() first");
}

void expect_not_planned(const TrajectorySystem& system) {
  if (system.planned()) refuse("no batch can be added after plan()");
}

class BoundTrajectorySystem {
  /// Call f with the system while no other thread does: calls share scratch memory. The interpreter's lock is released
  /// first, so that who holds one of the two never waits for the other.
  template <typename F>
  auto alone(F f) {
    nb::gil_scoped_release release;
    const std::lock_guard<std::mutex> one_at_a_time(mutex_);
    return f(system_);
  }

 public:
  BoundTrajectorySystem(const AnyArray& track, int threads) : system_(make_system(track, threads)) {}

  // What the constructor settles needs no lock.
  std::int64_t num_points() const { return system_.num_points(); }
  int threads() const { return system_.threads(); }

  int num_batches() {
    return alone([](TrajectorySystem& system) { return system.num_batches(); });
  }

  void add_dynamic_reprojection(const std::vector<AnyArray>& rows, const AnyArray& uv, const AnyArray& world_T_cam,
                                const AnyArray& intrinsics, const AnyArray& sigma, const AnyArray& weight, int kernel,
                                double threshold) {
    alone(expect_not_planned);
    const Checked checked(rows, 1, num_points(), 2, sigma, weight, kernel, threshold);
    const double* pixels = expect_floats(uv, "uv", {checked.count, 2}).data;
    const double* poses = expect_floats(world_T_cam, "world_T_cam", {checked.count, 4, 4}).data;
    const double* pinholes = expect_floats(intrinsics, "intrinsics", {checked.count, 4}).data;
    alone([&](TrajectorySystem& system) {
      expect_not_planned(system);
      system.add_dynamic_reprojection(checked.get(), pixels, poses, pinholes);
    });
  }

  void add_dynamic_depth_prior(const std::vector<AnyArray>& rows, const AnyArray& depth, const AnyArray& world_T_cam,
                               const AnyArray& log_scale, const AnyArray& sigma, const AnyArray& weight, int kernel,
                               double threshold) {
    alone(expect_not_planned);
    const Checked checked(rows, 1, num_points(), 1, sigma, weight, kernel, threshold);
    const auto cue = expect_floats(depth, "depth", {checked.count});
    expect_positive(cue, "depth");
    const double* poses = expect_floats(world_T_cam, "world_T_cam", {checked.count, 4, 4}).data;
    const double* scales = expect_floats(log_scale, "log_scale", {checked.count}).data;
    alone([&](TrajectorySystem& system) {
      expect_not_planned(system);
      system.add_dynamic_depth_prior(checked.get(), cue.data, poses, scales);
    });
  }

  void add_smoothness(const std::vector<AnyArray>& rows, const AnyArray& sigma, const AnyArray& weight, int kernel,
                      double threshold) {
    alone(expect_not_planned);
    if (rows.size() != 2 && rows.size() != 3) refuse("rows: expected 2 or 3 arrays, one per slot");
    const Checked checked(rows, rows.size(), num_points(), 3, sigma, weight, kernel, threshold);
    alone([&](TrajectorySystem& system) {
      expect_not_planned(system);
      system.add_smoothness(checked.get(), static_cast<int>(rows.size()));
    });
  }

  void add_arap(const std::vector<AnyArray>& rows, const AnyArray& sigma, const AnyArray& weight, int kernel,
                double threshold) {
    alone(expect_not_planned);
    const Checked checked(rows, 4, num_points(), 1, sigma, weight, kernel, threshold);
    alone([&](TrajectorySystem& system) {
      expect_not_planned(system);
      system.add_arap(checked.get());
    });
  }

  int add_linearized(const std::vector<AnyArray>& rows, int dim) {
    if (rows.empty() || rows.size() > kMostSlots) {
      refuse("rows: expected 1 to " + std::to_string(kMostSlots) + " arrays, one per slot, got " +
             std::to_string(rows.size()));
    }
    if (dim < 1 || dim > kMostResiduals) {
      refuse("dim: expected 1 to " + std::to_string(kMostResiduals) + ", got " + std::to_string(dim));
    }
    alone(expect_not_planned);
    const CheckedRows checked(rows, rows.size(), num_points());
    const auto slots = static_cast<int>(rows.size());
    expect_count(3 * checked.count * slots * dim, "rows[0]");
    return alone([&](TrajectorySystem& system) {
      expect_not_planned(system);
      system.add_linearized(checked.rows.data(), checked.count, slots, dim);
      return system.num_batches() - 1;
    });
  }

  void set_linearized(int index, const AnyArray& residual, const AnyArray& jacobians) {
    struct Size {
      std::int64_t count, dim, slots;
    };
    // A planned batch keeps its size.
    const Size size = alone([&](TrajectorySystem& system) {
      expect_planned(system);
      if (index < 0 || index >= system.num_batches() || !system.is_linearized(index)) {
        refuse("index: " + std::to_string(index) + " is no batch of add_linearized()");
      }
      return Size{system.num_factors(index), system.dim(index), system.num_slots(index)};
    });
    const auto r = expect_floats(residual, "residual", {size.count, size.dim});
    const auto j = expect_floats(jacobians, "jacobians", {size.count, size.dim, size.slots, 3});
    alone([&](TrajectorySystem& system) { system.set_linearized(index, r.data, j.data); });
  }

  void plan() {
    alone([](TrajectorySystem& system) {
      if (system.planned()) refuse("plan() can be called once");
      system.plan();
    });
  }

  void reweight(int batch, const AnyArray& weight, int kernel, double threshold) {
    const std::int64_t count = alone([&](TrajectorySystem& system) {
      expect_planned(system);
      if (batch < 0 || batch >= system.num_batches()) refuse("batch: there is none of this number");
      return system.num_factors(batch);
    });
    const auto weights = expect_weights(weight, "weight", count);
    const Kernel checked = expect_kernel(kernel, threshold);
    alone([&](TrajectorySystem& system) { system.reweight(batch, weights.data, checked); });
  }

  FloatArray energies(const AnyArray& points) {
    const double* data = expect_points(points);
    return to_array(alone([&](TrajectorySystem& system) { return system.energies(data); }));
  }

  LinearizeResult linearize(const AnyArray& points, double kernel_curvature) {
    const double* data = expect_points(points);
    if (!(kernel_curvature >= 0.0 && kernel_curvature < 1.0)) {
      refuse("kernel_curvature: must be at least 0 and below 1");
    }
    const auto [gradient, bad] = alone([&](TrajectorySystem& system) {
      if (const int batch = system.missing_linearization(); batch >= 0) {
        refuse("batch " + std::to_string(batch) + ": call set_linearized() before each linearize()");
      }
      const NonFinite found = system.linearize(data, kernel_curvature);
      return std::pair(system.gradient(), found);
    });
    std::optional<std::pair<int, std::int64_t>> failure;
    if (bad.any()) failure = {bad.batch, bad.row};
    return {to_array(gradient), failure};
  }

  std::optional<std::tuple<FloatArray, double, double, int>> solve(double damping, double min_diagonal,
                                                                   double max_diagonal, double cg_tolerance,
                                                                   int cg_max_iterations) {
    if (!(damping >= 0.0 && std::isfinite(damping))) refuse("damping: must be finite and not negative");
    if (!(min_diagonal >= 0.0 && max_diagonal >= min_diagonal)) {
      refuse("min_diagonal, max_diagonal: expected 0 <= min_diagonal <= max_diagonal");
    }
    if (!(cg_tolerance > 0.0 && cg_tolerance < 1.0)) refuse("cg_tolerance: must lie between 0 and 1");
    if (cg_max_iterations < 1) refuse("cg_max_iterations: must be at least 1");
    const std::optional<TrajectoryStep> step = alone([&](TrajectorySystem& system) {
      expect_linearized(system, "solve()");
      return system.solve(damping, min_diagonal, max_diagonal, cg_tolerance, cg_max_iterations);
    });
    if (!step) return std::nullopt;
    return std::make_tuple(to_array(step->delta), step->norm, step->predicted_decrease, step->iterations);
  }

  FloatArray multiply(const AnyArray& vector) {
    const auto view = expect_floats(vector, "vector", {3 * num_points()});
    NewArray out({static_cast<std::size_t>(3 * num_points())});
    alone([&](TrajectorySystem& system) {
      expect_linearized(system, "multiply()");
      system.multiply(view.data, out.data());
    });
    return out.release();
  }

  FloatArray diagonal_blocks() {
    NewArray out({static_cast<std::size_t>(num_points()), 3, 3});
    alone([&](TrajectorySystem& system) {
      expect_linearized(system, "diagonal_blocks()");
      for (std::int64_t p = 0; p < system.num_points(); ++p) {
        const auto b = system.diagonal_block(p);
        const double full[9] = {b[0], b[1], b[2], b[1], b[3], b[4], b[2], b[4], b[5]};
        std::copy_n(full, 9, out.data() + 9 * p);
      }
    });
    return out.release();
  }

 private:
  const double* expect_points(const AnyArray& points) {
    alone(expect_planned);
    return expect_floats(points, "points", {num_points(), 3}, false).data;
  }

  static void expect_linearized(const TrajectorySystem& system, const char* before) {
    if (!system.linearized()) refuse(std::string("linearize() must succeed before ") + before);
  }

  TrajectorySystem system_;
  std::mutex mutex_;
};

}  // namespace

void bind_trajectory_system(nb::module_& module) {
  using namespace nb::literals;
  using Bound = BoundTrajectorySystem;
  nb::class_<Bound>(module, "TrajectorySystem",
                    "Normal equations of many moving points, solved by preconditioned conjugate gradients. One call "
                    "runs at a time; a linearization and what follows from it belong to one thread.")
      .def(nb::init<const AnyArray&, int>(), "track"_a, "threads"_a = 0)
      .def("add_dynamic_reprojection", &Bound::add_dynamic_reprojection, "rows"_a, "uv"_a, "world_T_cam"_a,
           "intrinsics"_a, "sigma"_a, "weight"_a, "kernel"_a, "threshold"_a)
      .def("add_dynamic_depth_prior", &Bound::add_dynamic_depth_prior, "rows"_a, "depth"_a, "world_T_cam"_a,
           "log_scale"_a, "sigma"_a, "weight"_a, "kernel"_a, "threshold"_a)
      .def("add_smoothness", &Bound::add_smoothness, "rows"_a, "sigma"_a, "weight"_a, "kernel"_a, "threshold"_a)
      .def("add_arap", &Bound::add_arap, "rows"_a, "sigma"_a, "weight"_a, "kernel"_a, "threshold"_a)
      .def(
          "add_linearized", &Bound::add_linearized, "rows"_a, "dim"_a,
          "Add N factors of another type, rows[s] (N,) the points of slot s, with dim residuals each; return the index "
          "of the batch. Its energy counts as 0 and reweight leaves it alone.")
      .def("set_linearized", &Bound::set_linearized, "index"_a, "residual"_a, "jacobians"_a,
           "Give the next linearize the residuals (N, dim) and Jacobians (N, dim, slots, 3) of such a batch, whitened "
           "and with weights and kernels applied.")
      .def("plan", &Bound::plan)
      .def("reweight", &Bound::reweight, "batch"_a, "weight"_a, "kernel"_a, "threshold"_a)
      .def_prop_ro("num_points", &Bound::num_points)
      .def_prop_ro("num_batches", &Bound::num_batches)
      .def_prop_ro("threads", &Bound::threads)
      .def("energies", &Bound::energies, "points"_a)
      .def("linearize", &Bound::linearize, "points"_a, "kernel_curvature"_a = 0.0)
      .def("multiply", &Bound::multiply, "vector"_a)
      .def("diagonal_blocks", &Bound::diagonal_blocks)
      .def("solve", &Bound::solve, "damping"_a, "min_diagonal"_a, "max_diagonal"_a, "cg_tolerance"_a,
           "cg_max_iterations"_a);
}

}  // namespace uni4d_fg
