#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <limits>
#include <memory>
#include <mutex>
#include <optional>
#include <tuple>

#include "arrays.hpp"
#include "uni4d_fg/landmark_system.hpp"

namespace uni4d_fg {

namespace {

/// pose, landmark, measured, sigma, weight, kernel code, threshold.
using BatchArguments = std::tuple<AnyArray, AnyArray, AnyArray, AnyArray, AnyArray, int, double>;

LandmarkBatch read_batch(const BatchArguments& arguments, const LandmarkProblem& problem, bool depth) {
  const auto& [pose, landmark, measured, sigma, weight, kernel, threshold] = arguments;
  LandmarkBatch batch;
  const auto pose_view = expect_rows(pose, "pose", kAnyLength, problem.num_frames);
  batch.count = pose_view.rows();
  batch.pose = pose_view.data;
  batch.landmark = expect_rows(landmark, "landmark", batch.count, problem.num_landmarks).data;
  // What is measured may be NaN or infinite: the linearization reports it.
  batch.measured = depth ? expect_floats(measured, "depth", {batch.count}, false).data
                         : expect_floats(measured, "uv", {batch.count, 2}, false).data;
  const Sigma checked = expect_sigma(sigma, "sigma", batch.count, depth ? 1 : 2);
  batch.sigma = checked.view.data;
  batch.sigma_columns = checked.columns;
  batch.weight = expect_weights(weight, "weight", batch.count).data;
  batch.kernel = expect_kernel(kernel, threshold);
  return batch;
}

/// Check that the columns that are not -1 count up from 0.
void read_columns(const AnyArray& array, LandmarkProblem& problem) {
  const auto view = expect_integers(array, "columns", {problem.num_frames, kFrameColumns});
  const std::int64_t* data = view.data;
  const auto size = static_cast<std::size_t>(view.size());
  for (std::size_t i = 0; i < size; ++i) {
    if (data[i] != -1 && data[i] != problem.num_columns)
      refuse("columns: entry " + std::to_string(i) + " (flat index) is " + std::to_string(data[i]) + ", not -1 or " +
             std::to_string(problem.num_columns));
    problem.columns.push_back(static_cast<int>(data[i]));
    if (data[i] != -1) problem.num_columns += 1;
  }
}

class BoundLandmarkSystem {
  /// Call f with the system while no other thread does: calls share scratch memory. The interpreter's lock is released
  /// first, so that who holds one of the two never waits for the other.
  template <typename F>
  auto alone(F f) {
    nb::gil_scoped_release release;
    const std::lock_guard<std::mutex> one_at_a_time(mutex_);
    return f(*system_);
  }

 public:
  BoundLandmarkSystem(const std::vector<BatchArguments>& reprojection, const std::vector<BatchArguments>& depth,
                      std::int64_t num_frames, const AnyArray& landmark_free, const AnyArray& columns,
                      bool intrinsics_free, std::int64_t stored_rows, bool banded, int threads) {
    const int workers = expect_threads(threads);
    LandmarkProblem problem;
    if (num_frames < 0 || num_frames >= (std::int64_t{1} << 25))
      refuse("num_frames: expected a number in [0, 2^25), got " + std::to_string(num_frames));
    problem.num_frames = static_cast<int>(num_frames);
    const auto free = expect_rows(landmark_free, "landmark_free", kAnyLength, 2);
    problem.num_landmarks = expect_count(free.rows(), "landmark_free");
    problem.landmark_free.assign(free.data, free.data + free.rows());
    std::int64_t total = 0;
    for (const BatchArguments& arguments : reprojection) {
      problem.reprojection.push_back(read_batch(arguments, problem, false));
      total += problem.reprojection.back().count;
    }
    for (const BatchArguments& arguments : depth) {
      problem.depth.push_back(read_batch(arguments, problem, true));
      total += problem.depth.back().count;
    }
    expect_count(total, "factors");
    read_columns(columns, problem);
    problem.intrinsics_free = intrinsics_free;
    const int least = banded ? std::min(1, problem.num_columns) : problem.num_columns;
    if (stored_rows < least || stored_rows > problem.num_columns)
      refuse("stored_rows: expected a number in [" + std::to_string(least) + ", " +
             std::to_string(problem.num_columns) + "], got " + std::to_string(stored_rows));
    problem.stored_rows = static_cast<int>(stored_rows);
    problem.banded = banded;
    nb::gil_scoped_release release;
    system_ = std::make_unique<LandmarkSystem>(std::move(problem), workers);
  }

  nb::object energies(const AnyArray& world_T_cam, const AnyArray& intrinsics, const AnyArray& log_scale,
                      const AnyArray& landmarks) {
    const LandmarkState state = read_state(world_T_cam, intrinsics, log_scale, landmarks);
    NewArray out({static_cast<std::size_t>(system_->num_batches())});
    alone([&](LandmarkSystem& system) { system.energies(state, out.data()); });
    return nb::cast(out.release());
  }

  nb::object settle_landmarks(const AnyArray& world_T_cam, const AnyArray& intrinsics, const AnyArray& log_scale,
                              const AnyArray& landmarks, int iterations, double min_diagonal, double max_diagonal) {
    const LandmarkState state = read_state(world_T_cam, intrinsics, log_scale, landmarks);
    if (iterations < 0) refuse("iterations: expected a number that is not negative, got " + std::to_string(iterations));
    expect_damping_bounds(min_diagonal, max_diagonal);
    NewArray out({static_cast<std::size_t>(system_->problem().num_landmarks), 3});
    alone([&](LandmarkSystem& system) {
      system.settle_landmarks(state, {0.0, min_diagonal, max_diagonal}, iterations, out.data());
    });
    return nb::cast(out.release());
  }

  nb::tuple linearize(const AnyArray& world_T_cam, const AnyArray& intrinsics, const AnyArray& log_scale,
                      const AnyArray& landmarks) {
    const LandmarkState state = read_state(world_T_cam, intrinsics, log_scale, landmarks);
    NewSystem out(system_->problem());
    const LinearizeResult result = alone([&](LandmarkSystem& system) { return system.linearize(state, out.view()); });
    return nb::make_tuple(out.core.release(), out.border.release(), out.corner.release(), out.gradient.release(),
                          result.landmark_gradient_max, result.finite);
  }

  nb::tuple landmark_blocks() {
    const auto count = static_cast<std::size_t>(system_->problem().num_landmarks);
    NewArray blocks({count, 3, 3}), gradients({count, 3});
    alone([&](LandmarkSystem& system) {
      expect_linearized(system);
      system.landmark_blocks(blocks.data(), gradients.data());
    });
    return nb::make_tuple(blocks.release(), gradients.release());
  }

  double add_to_landmarks(const AnyArray& rows, const AnyArray& blocks, const AnyArray& gradients) {
    alone(expect_linearized);
    const auto landmarks = expect_free_landmarks(rows);
    const double* block_data = expect_floats(blocks, "blocks", {landmarks.rows(), 3, 3}).data;
    const double* gradient_data = expect_floats(gradients, "gradients", {landmarks.rows(), 3}).data;
    return alone([&](LandmarkSystem& system) {
      expect_linearized(system);
      return system.add_to_landmarks(landmarks.rows(), landmarks.data, block_data, gradient_data);
    });
  }

  void add_to_coupling(const AnyArray& frames, const AnyArray& rows, const AnyArray& blocks) {
    alone(expect_linearized);
    const auto landmarks = expect_free_landmarks(rows);
    const auto seen_by = expect_rows(frames, "frames", landmarks.rows(), system_->problem().num_frames);
    const double* data = expect_floats(blocks, "blocks", {landmarks.rows(), 3, kFrameColumns}).data;
    alone([&](LandmarkSystem& system) {
      expect_linearized(system);
      system.add_to_coupling(landmarks.rows(), seen_by.data, landmarks.data, data);
    });
  }

  nb::object whitened_coupling(const AnyArray& rows) {
    const char* name = "whitened_coupling";
    alone([&](LandmarkSystem& system) { expect_reduced(system, name); });
    const auto landmarks = expect_free_landmarks(rows);
    const auto width = static_cast<std::size_t>(system_->problem().num_columns) + kBorder + 1;
    NewArray out({static_cast<std::size_t>(landmarks.rows()), 3, width});
    alone([&](LandmarkSystem& system) {
      expect_reduced(system, name);
      system.whitened_coupling(landmarks.rows(), landmarks.data, out.data());
    });
    return nb::cast(out.release());
  }

  nb::object inverse_factors(const AnyArray& rows) {
    const char* name = "inverse_factors";
    alone([&](LandmarkSystem& system) { expect_reduced(system, name); });
    const auto landmarks = expect_free_landmarks(rows);
    NewArray out({static_cast<std::size_t>(landmarks.rows()), 3, 3});
    alone([&](LandmarkSystem& system) {
      expect_reduced(system, name);
      system.inverse_factors(landmarks.rows(), landmarks.data, out.data());
    });
    return nb::cast(out.release());
  }

  nb::object reduce(double damping, double min_diagonal, double max_diagonal, const AnyArray& core,
                    const AnyArray& border, const AnyArray& corner, const AnyArray& gradient) {
    alone(expect_linearized);
    if (!std::isfinite(damping) || damping < 0.0)
      refuse("damping: expected a finite number that is not negative, got " + std::to_string(damping));
    expect_damping_bounds(min_diagonal, max_diagonal);
    const LandmarkProblem& problem = system_->problem();
    const std::int64_t size = problem.num_columns;
    // Read only, although the type that input and output share says otherwise.
    auto read = [](const AnyArray& array, const char* name, std::initializer_list<std::int64_t> shape) {
      return const_cast<double*>(expect_floats(array, name, shape, false).data);
    };
    const CameraSystem hessian{read(core, "core", {size, problem.stored_rows}), read(border, "border", {size, kBorder}),
                               read(corner, "corner", {kBorder, kBorder}),
                               read(gradient, "gradient", {size + kBorder})};
    NewSystem out(problem);
    const bool positive = alone([&](LandmarkSystem& system) {
      expect_linearized(system);
      return system.reduce({damping, min_diagonal, max_diagonal}, hessian, out.view());
    });
    if (!positive) return nb::none();
    return nb::make_tuple(out.core.release(), out.border.release(), out.corner.release(), out.gradient.release());
  }

  nb::tuple back_substitute(const AnyArray& camera_step, const std::optional<AnyArray>& extra) {
    const char* name = "back_substitute";
    alone([&](LandmarkSystem& system) { expect_reduced(system, name); });
    const LandmarkProblem& problem = system_->problem();
    const auto step = expect_floats(camera_step, "camera_step", {problem.num_columns + kBorder}, false);
    const double* extra_data = extra ? expect_floats(*extra, "extra", {problem.num_landmarks, 3}, false).data : nullptr;
    NewArray out({static_cast<std::size_t>(problem.num_landmarks), 3});
    const StepSums sums = alone([&](LandmarkSystem& system) {
      expect_reduced(system, name);
      return system.back_substitute(step.data, extra_data, out.data());
    });
    return nb::make_tuple(out.release(), sums.slope, sums.damped, sums.squared);
  }

  std::int64_t num_pairs() const { return system_->num_pairs(); }

 private:
  struct NewSystem {
    NewArray core, border, corner, gradient;
    explicit NewSystem(const LandmarkProblem& problem)
        : core({static_cast<std::size_t>(problem.num_columns), static_cast<std::size_t>(problem.stored_rows)}),
          border({static_cast<std::size_t>(problem.num_columns), kBorder}),
          corner({kBorder, kBorder}),
          gradient({static_cast<std::size_t>(problem.num_columns) + kBorder}) {}
    CameraSystem view() { return {core.data(), border.data(), corner.data(), gradient.data()}; }
  };

  LandmarkState read_state(const AnyArray& world_T_cam, const AnyArray& intrinsics, const AnyArray& log_scale,
                           const AnyArray& landmarks) const {
    const LandmarkProblem& problem = system_->problem();
    // A state that is not finite has an energy that is not finite: the solver decides, not the boundary.
    return {expect_floats(world_T_cam, "world_T_cam", {problem.num_frames, 4, 4}, false).data,
            expect_floats(intrinsics, "intrinsics", {4}, false).data,
            expect_floats(log_scale, "log_scale", {problem.num_frames}, false).data,
            expect_floats(landmarks, "landmarks", {problem.num_landmarks, 3}, false).data};
  }

  /// Check rows of landmarks: in range and free.
  View<std::int64_t> expect_free_landmarks(const AnyArray& rows) const {
    const LandmarkProblem& problem = system_->problem();
    const auto view = expect_rows(rows, "rows", kAnyLength, problem.num_landmarks);
    for (std::int64_t i = 0; i < view.rows(); ++i)
      if (problem.landmark_free[static_cast<std::size_t>(view.data[i])] == 0)
        refuse("rows: entry " + std::to_string(i) + " is landmark " + std::to_string(view.data[i]) +
               ", which is frozen");
    return view;
  }

  static void expect_damping_bounds(double min_diagonal, double max_diagonal) {
    if (!(min_diagonal >= 0.0) || !(max_diagonal >= min_diagonal))
      refuse("min_diagonal, max_diagonal: expected 0 <= min <= max, got " + std::to_string(min_diagonal) + " and " +
             std::to_string(max_diagonal));
  }

  static void expect_linearized(const LandmarkSystem& system) {
    if (!system.linearized()) refuse("call linearize first");
  }

  static void expect_reduced(const LandmarkSystem& system, const char* name) {
    if (!system.reduced()) refuse(std::string(name) + ": call reduce first");
  }

  std::unique_ptr<LandmarkSystem> system_;
  std::mutex mutex_;
};

}  // namespace

void bind_landmark_system(nb::module_& module) {
  nb::class_<BoundLandmarkSystem>(module, "LandmarkSystem",
                                  "The landmark Schur complement of bundle adjustment. One call runs at a time; a "
                                  "linearization and what follows from it belong to one thread.")
      .def(nb::init<const std::vector<BatchArguments>&, const std::vector<BatchArguments>&, std::int64_t,
                    const AnyArray&, const AnyArray&, bool, std::int64_t, bool, int>(),
           nb::arg("reprojection"), nb::arg("depth"), nb::arg("num_frames"), nb::arg("landmark_free"),
           nb::arg("columns"), nb::arg("intrinsics_free"), nb::arg("stored_rows"), nb::arg("banded"),
           nb::arg("threads") = 0,
           "Plan the factors: batches are (pose, landmark, uv or depth, sigma, weight, kernel code, threshold).")
      .def("energies", &BoundLandmarkSystem::energies, nb::arg("world_T_cam"), nb::arg("intrinsics"),
           nb::arg("log_scale"), nb::arg("landmarks"), "Energy per batch, reprojection batches first.")
      .def("settle_landmarks", &BoundLandmarkSystem::settle_landmarks, nb::arg("world_T_cam"), nb::arg("intrinsics"),
           nb::arg("log_scale"), nb::arg("landmarks"), nb::arg("iterations"), nb::arg("min_diagonal"),
           nb::arg("max_diagonal"),
           "Return landmarks (N, 3), every free one moved towards its own minimum under resting cameras.")
      .def("linearize", &BoundLandmarkSystem::linearize, nb::arg("world_T_cam"), nb::arg("intrinsics"),
           nb::arg("log_scale"), nb::arg("landmarks"),
           "Return core, border, corner, gradient, largest landmark gradient, and whether all is finite.")
      .def("landmark_blocks", &BoundLandmarkSystem::landmark_blocks,
           "Return the landmarks' Hessian blocks (N, 3, 3) and gradients (N, 3) of the last linearization.")
      .def("add_to_landmarks", &BoundLandmarkSystem::add_to_landmarks, nb::arg("rows"), nb::arg("blocks"),
           nb::arg("gradients"),
           "Add what other factors give to free landmarks rows (n,): V += blocks (n, 3, 3) and g += gradients (n, 3), "
           "whitened and with their kernels, after linearize and before reduce. Return the largest landmark gradient.")
      .def("add_to_coupling", &BoundLandmarkSystem::add_to_coupling, nb::arg("frames"), nb::arg("rows"),
           nb::arg("blocks"),
           "Add what other factors couple free landmarks rows (n,) with frames (n,) by: blocks (n, 3, 7) J_l^T J with "
           "pose and log-scale, after linearize and before reduce, only where a factor given to the constructor, be "
           "its weight 0, reads both.")
      .def("reduce", &BoundLandmarkSystem::reduce, nb::arg("damping"), nb::arg("min_diagonal"), nb::arg("max_diagonal"),
           nb::arg("core"), nb::arg("border"), nb::arg("corner"), nb::arg("gradient"),
           "Return the reduced core, border, corner and right-hand side, or None if a landmark is not determined.")
      .def("whitened_coupling", &BoundLandmarkSystem::whitened_coupling, nb::arg("rows"),
           "Return L^-1 E^T and L^-1 g, (n, 3, columns + 5), of free landmarks rows (n,), V + damping D = L L^T: core "
           "columns, four intrinsics (frozen ones included), gradient.")
      .def("inverse_factors", &BoundLandmarkSystem::inverse_factors, nb::arg("rows"),
           "Return L^-1 (n, 3, 3) of free landmarks rows (n,), V + damping D = L L^T.")
      .def("back_substitute", &BoundLandmarkSystem::back_substitute, nb::arg("camera_step"),
           nb::arg("extra") = nb::none(),
           "Return the landmarks' step (N, 3) and its sums slope, damped and squared; extra (N, 3) is added to "
           "E^T camera_step + g, and is not read for frozen landmarks.")
      .def_prop_ro("num_pairs", &BoundLandmarkSystem::num_pairs, "Observations of free landmarks.");
}

}  // namespace uni4d_fg
