// TrajectorySystem without Python: consistency of energy, gradient, product and step; degenerate shapes; threads.
// Meant to run under AddressSanitizer and UndefinedBehaviorSanitizer.
#include <cmath>
#include <cstdio>
#include <limits>
#include <random>
#include <vector>

#include "check.hpp"
#include "uni4d_fg/trajectory_system.hpp"

using uni4d_fg::Kernel;
using uni4d_fg::KernelKind;
using uni4d_fg::TrajectorySystem;

namespace {

struct Scene {
  int tracks, frames;
  std::vector<std::int64_t> track;
  std::vector<double> points;
};

Scene make_scene(int tracks, int frames, std::mt19937& random) {
  std::normal_distribution<double> normal;
  Scene scene{tracks, frames, {}, {}};
  for (int k = 0; k < tracks; ++k) {
    for (int t = 0; t < frames; ++t) {
      scene.track.push_back(7 * k);
      for (int a = 0; a < 3; ++a) scene.points.push_back(0.5 * normal(random) + (a == 2 ? 3.0 : 0.0));
    }
  }
  return scene;
}

/// All families on a scene; `scrambled` draws rows at random, which couples anything with anything.
TrajectorySystem make_system(const Scene& scene, Kernel kernel, bool scrambled, int threads, std::mt19937& random) {
  TrajectorySystem system(scene.track.data(), static_cast<std::int64_t>(scene.track.size()), threads);
  const int count = scene.tracks * scene.frames;
  const auto add = [&](int slots, int dim, std::vector<std::int64_t> rows, const auto& call) {
    const std::size_t n = rows.size() / static_cast<std::size_t>(slots);
    if (scrambled && count > 0) {
      std::uniform_int_distribution<std::int64_t> any(0, count - 1);
      for (auto& row : rows) row = any(random);
    }
    const std::vector<double> sigma(n * static_cast<std::size_t>(dim), 0.7), weight(n, 1.3);
    call(
        uni4d_fg::TrajectoryRows{rows.data(), static_cast<std::int64_t>(n), sigma.data(), true, weight.data(), kernel});
  };
  std::vector<std::int64_t> own, velocity, acceleration, arap;
  for (int k = 0; k < scene.tracks; ++k) {
    for (int t = 0; t < scene.frames; ++t) {
      const std::int64_t row = static_cast<std::int64_t>(k) * scene.frames + t;
      own.push_back(row);
      if (t + 1 < scene.frames) velocity.insert(velocity.end(), {row, row + 1});
      if (t + 2 < scene.frames) acceleration.insert(acceleration.end(), {row, row + 1, row + 2});
      if (t + 1 < scene.frames && k + 1 < scene.tracks) {
        arap.insert(arap.end(), {row, row + scene.frames, row + 1, row + scene.frames + 1});
      }
    }
  }
  std::vector<double> poses, intrinsics, uv, depth, log_scale;
  for (int i = 0; i < count; ++i) {
    const double x = 0.1 * (i % scene.frames);
    poses.insert(poses.end(), {1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1});
    intrinsics.insert(intrinsics.end(), {300.0, 300.0, 160.0, 120.0});
    uv.insert(uv.end(), {150.0 + i % 7, 110.0 + i % 5});
    depth.push_back(2.0 + 0.1 * (i % 3));
    log_scale.push_back(0.01);
  }
  add(1, 2, own,
      [&](const auto& rows) { system.add_dynamic_reprojection(rows, uv.data(), poses.data(), intrinsics.data()); });
  add(1, 1, own,
      [&](const auto& rows) { system.add_dynamic_depth_prior(rows, depth.data(), poses.data(), log_scale.data()); });
  add(2, 3, velocity, [&](const auto& rows) { system.add_smoothness(rows, 2); });
  add(3, 3, acceleration, [&](const auto& rows) { system.add_smoothness(rows, 3); });
  add(4, 1, arap, [&](const auto& rows) { system.add_arap(rows); });
  system.plan();
  return system;
}

double total(const TrajectorySystem& system, const std::vector<double>& points) {
  double sum = 0.0;
  for (const double energy : system.energies(points.data())) sum += energy;
  return sum;
}

void test_consistency(int tracks, int frames, KernelKind kind, bool scrambled) {
  std::mt19937 random(11);
  const Scene scene = make_scene(tracks, frames, random);
  std::mt19937 same = random;
  TrajectorySystem system = make_system(scene, {kind, 0.8}, scrambled, 2, random);
  check(!system.linearize(scene.points.data()).any(), "every factor is finite");
  const std::vector<double> gradient = system.gradient();
  std::normal_distribution<double> normal;
  std::vector<double> direction(gradient.size()), ahead = scene.points, back = scene.points;
  for (auto& value : direction) value = normal(random);
  const double step = 1e-6;
  double slope = 0.0;
  for (std::size_t i = 0; i < direction.size(); ++i) {
    ahead[i] += step * direction[i];
    back[i] -= step * direction[i];
    slope += gradient[i] * direction[i];
  }
  const double measured = (total(system, ahead) - total(system, back)) / (2.0 * step);
  check(std::abs(measured - slope) <= 1e-5 * (1.0 + std::abs(slope)), "the gradient is the slope of the energy");
  std::vector<double> product(gradient.size());
  system.multiply(direction.data(), product.data());
  double curvature = 0.0;
  for (std::size_t i = 0; i < direction.size(); ++i) curvature += direction[i] * product[i];
  check(curvature >= 0.0, "J^T J is not negative");
  check(!system.linearize(scene.points.data(), 0.9).any(), "every factor is finite with its kernel's curvature");
  std::vector<double> curved(gradient.size());
  system.multiply(direction.data(), curved.data());
  double lower = 0.0;
  for (std::size_t i = 0; i < direction.size(); ++i) lower += direction[i] * curved[i];
  check(lower >= 0.0 && lower <= curvature * (1.0 + 1e-12), "the curvature of kernels only lowers J^T J");
  system.linearize(scene.points.data());
  const auto result = system.solve(1e-2, 1e-6, 1e32, 1e-10, 2000);
  check(result.has_value() && std::isfinite(result->norm) && result->predicted_decrease >= 0.0, "there is a step");
  TrajectorySystem other = make_system(scene, {kind, 0.8}, scrambled, 3, same);
  other.linearize(scene.points.data());
  const auto repeated = other.solve(1e-2, 1e-6, 1e32, 1e-10, 2000);
  check(repeated.has_value() && repeated->delta == result->delta, "threads change no bit");
}

/// Factors of 1 to 8 slots on any points, some twice in a factor, against J v and J^T w computed one by one.
void test_linearized(int tracks, int frames) {
  std::mt19937 random(5);
  const Scene scene = make_scene(tracks, frames, random);
  const auto points = static_cast<std::int64_t>(scene.track.size());
  std::normal_distribution<double> normal;
  std::uniform_int_distribution<std::int64_t> any(0, points - 1);
  struct Factors {
    std::size_t count, slots, dim;
    std::vector<std::int64_t> rows;
    std::vector<double> residual, jacobians;
  };
  std::vector<Factors> batches;
  for (const std::size_t slots : {std::size_t{1}, std::size_t{3}, std::size_t{8}}) {
    Factors batch{slots == 3 ? std::size_t{200} : std::size_t{5}, slots, 2 * slots, {}, {}, {}};
    for (std::size_t i = 0; i < batch.count * slots; ++i) batch.rows.push_back(any(random));
    for (std::size_t i = 0; i < batch.count * batch.dim; ++i) batch.residual.push_back(normal(random));
    for (std::size_t i = 0; i < batch.count * batch.dim * slots * 3; ++i) batch.jacobians.push_back(normal(random));
    batches.push_back(batch);
  }
  batches.push_back({0, 2, 1, {}, {}, {}});
  std::vector<double> direction(3 * static_cast<std::size_t>(points)), first_step;
  for (double& value : direction) value = normal(random);
  for (const int threads : {1, 3}) {
    TrajectorySystem system(scene.track.data(), points, threads);
    for (const Factors& batch : batches)
      system.add_linearized(batch.rows.data(), static_cast<std::int64_t>(batch.count), static_cast<int>(batch.slots),
                            static_cast<int>(batch.dim));
    system.plan();
    check(system.missing_linearization() == 0, "values are missing");
    for (std::size_t b = 0; b < batches.size(); ++b)
      system.set_linearized(static_cast<int>(b), batches[b].residual.data(), batches[b].jacobians.data());
    check(!system.linearize(scene.points.data()).any(), "every factor is finite");
    check(total(system, scene.points) == 0.0, "energies are the caller's");
    std::vector<double> gradient(direction.size()), product(direction.size()), actual(direction.size());
    for (const Factors& batch : batches)
      for (std::size_t n = 0; n < batch.count; ++n)
        for (std::size_t i = 0; i < batch.dim; ++i) {
          const double* jacobian = &batch.jacobians[3 * batch.slots * (n * batch.dim + i)];
          double change = 0.0;
          for (std::size_t k = 0; k < 3 * batch.slots; ++k)
            change +=
                jacobian[k] * direction[3 * static_cast<std::size_t>(batch.rows[n * batch.slots + k / 3]) + k % 3];
          for (std::size_t k = 0; k < 3 * batch.slots; ++k) {
            const std::size_t at = 3 * static_cast<std::size_t>(batch.rows[n * batch.slots + k / 3]) + k % 3;
            gradient[at] += jacobian[k] * batch.residual[n * batch.dim + i];
            product[at] += jacobian[k] * change;
          }
        }
    system.multiply(direction.data(), actual.data());
    for (std::size_t i = 0; i < direction.size(); ++i) {
      check_close(system.gradient()[i], gradient[i], 1e-11, "gradient of linearized factors");
      check_close(actual[i], product[i], 1e-11, "product of linearized factors");
    }
    const auto step = system.solve(1e-2, 1e-6, 1e32, 1e-8, 3000);
    check(step.has_value(), "the preconditioner is positive definite");
    if (first_step.empty()) first_step = step->delta;
    check(step->delta == first_step, "threads change no bit");
  }
}

void test_not_finite() {
  std::mt19937 random(3);
  Scene scene = make_scene(3, 4, random);
  TrajectorySystem system = make_system(scene, {KernelKind::huber, 1.0}, false, 2, random);
  scene.points[3 * 5 + 1] = std::numeric_limits<double>::quiet_NaN();
  const auto bad = system.linearize(scene.points.data());
  check(bad.any() && bad.batch == 0 && bad.row == 5, "the first factor that is not finite is reported");
  check(!system.linearized(), "such a model cannot be solved");
}

}  // namespace

int main() {
  for (const KernelKind kind :
       {KernelKind::quadratic, KernelKind::huber, KernelKind::pseudo_huber, KernelKind::cauchy, KernelKind::norm}) {
    for (const bool scrambled : {false, true}) {
      test_consistency(1, 1, kind, scrambled);
      test_consistency(1, 9, kind, scrambled);
      test_consistency(6, 1, kind, scrambled);
      test_consistency(7, 8, kind, scrambled);
    }
  }
  test_consistency(80, 30, KernelKind::huber, false);
  test_linearized(1, 1);
  test_linearized(4, 3);
  test_linearized(60, 30);
  test_not_finite();
  std::puts("trajectory system: passed");
  return 0;
}
