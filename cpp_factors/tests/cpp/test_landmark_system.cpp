// The landmark system on exact observations: Gauss-Newton steps must reach the truth, in every storage and for every
// number of threads, without touching memory that is not theirs.
#include <algorithm>
#include <cstdio>
#include <random>
#include <stdexcept>
#include <vector>

#include "check.hpp"
#include "uni4d_fg/camera.hpp"
#include "uni4d_fg/landmark_system.hpp"

namespace {

using namespace uni4d_fg;

struct Scene {
  int num_frames, num_landmarks;
  std::vector<std::int64_t> pose, landmark;
  std::vector<double> uv, depth, sigma, pair_sigma, weight;
  std::vector<double> poses, intrinsics, log_scale, landmarks;
};

/// Cameras along x that look ahead; landmark i is seen from frame first(i) for `length` frames, some of them twice.
Scene make_scene(int frames, int landmarks, int length, std::mt19937& random) {
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  Scene scene{frames, landmarks, {}, {}, {}, {}, {}, {}, {}, {}, {500.0, 510.0, 320.0, 240.0}, {}, {}};
  for (int t = 0; t < frames; ++t) {
    const double pose[16] = {1, 0, 0, 0.1 * t, 0, 1, 0, 0.02 * t, 0, 0, 1, 0.05 * (t % 3), 0, 0, 0, 1};
    scene.poses.insert(scene.poses.end(), pose, pose + 16);
    scene.log_scale.push_back(0.05 * uniform(random));
  }
  for (int i = 0; i < landmarks; ++i) {
    const int first = frames > length ? i % (frames - length + 1) : 0;
    const Vec3 p{0.1 * first + uniform(random), uniform(random), 4.0 + uniform(random)};
    scene.landmarks.insert(scene.landmarks.end(), {p.x, p.y, p.z});
    for (int t = first; t < std::min(first + length, frames); ++t)
      for (int repeat = 0; repeat < ((i + t) % 5 == 0 ? 2 : 1); ++repeat) {
        const double* m = scene.poses.data() + 16 * t;
        const Vec3 x{p.x - m[3], p.y - m[7], p.z - m[11]};
        const Pixel pixel = project(load_intrinsics(scene.intrinsics.data()), x);
        scene.pose.push_back(t);
        scene.landmark.push_back(i);
        scene.uv.insert(scene.uv.end(), {pixel.u, pixel.v});
        scene.depth.push_back(x.z * std::exp(-scene.log_scale[static_cast<std::size_t>(t)]));
        scene.sigma.push_back(0.1 + 0.05 * uniform(random));
        scene.pair_sigma.insert(scene.pair_sigma.end(), {1.0 + 0.5 * uniform(random), 1.0});
        scene.weight.push_back(1.0 + 0.5 * uniform(random));
      }
  }
  return scene;
}

LandmarkProblem make_problem(const Scene& scene, bool depth, bool banded, int length, Kernel kernel) {
  LandmarkProblem problem;
  const auto count = static_cast<std::int64_t>(scene.pose.size());
  problem.num_frames = scene.num_frames;
  problem.num_landmarks = scene.num_landmarks;
  problem.reprojection.push_back({count, scene.pose.data(), scene.landmark.data(), scene.uv.data(),
                                  scene.pair_sigma.data(), 2, scene.weight.data(), kernel});
  if (depth)
    problem.depth.push_back({count, scene.pose.data(), scene.landmark.data(), scene.depth.data(), scene.sigma.data(), 1,
                             scene.weight.data(), kernel});
  problem.landmark_free.assign(static_cast<std::size_t>(scene.num_landmarks), 1);
  // The truth is frozen here: every fifth landmark, and frames 0 and 1.
  for (std::size_t i = 0; i < problem.landmark_free.size(); i += 5) problem.landmark_free[i] = 0;
  for (int t = 0; t < scene.num_frames; ++t)
    for (int k = 0; k < kFrameColumns; ++k)
      problem.columns.push_back(t < 2 || (k == 6 && !depth) ? -1 : problem.num_columns++);
  problem.intrinsics_free = true;
  problem.banded = banded;
  problem.stored_rows = banded ? std::min(problem.num_columns, kFrameColumns * (length + 1)) : problem.num_columns;
  return problem;
}

/// Solve a dense symmetric positive definite system in place.
std::vector<double> solve(std::vector<double> a, std::vector<double> b) {
  const std::size_t n = b.size();
  for (std::size_t j = 0; j < n; ++j) {
    for (std::size_t k = 0; k < j; ++k) a[j * n + j] -= a[j * n + k] * a[j * n + k];
    check(a[j * n + j] > 0.0, "the reduced system is positive definite");
    a[j * n + j] = std::sqrt(a[j * n + j]);
    for (std::size_t i = j + 1; i < n; ++i) {
      for (std::size_t k = 0; k < j; ++k) a[i * n + j] -= a[i * n + k] * a[j * n + k];
      a[i * n + j] /= a[j * n + j];
    }
  }
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t k = 0; k < i; ++k) b[i] -= a[i * n + k] * b[k];
    b[i] /= a[i * n + i];
  }
  for (std::size_t i = n; i-- > 0;) {
    for (std::size_t k = i + 1; k < n; ++k) b[i] -= a[k * n + i] * b[k];
    b[i] /= a[i * n + i];
  }
  return b;
}

struct System {
  std::vector<double> core, border, corner, gradient;
  explicit System(const LandmarkProblem& problem)
      : core(static_cast<std::size_t>(problem.num_columns) * static_cast<std::size_t>(problem.stored_rows)),
        border(static_cast<std::size_t>(problem.num_columns) * kBorder),
        corner(kBorder * kBorder),
        gradient(static_cast<std::size_t>(problem.num_columns) + kBorder) {}
  CameraSystem view() { return {core.data(), border.data(), corner.data(), gradient.data()}; }
};

std::vector<double> camera_step(const LandmarkProblem& problem, const System& reduced) {
  const auto n = static_cast<std::size_t>(problem.num_columns), size = n + kBorder;
  const auto stored = static_cast<std::size_t>(problem.stored_rows);
  std::vector<double> matrix(size * size);
  for (std::size_t j = 0; j < n; ++j) {
    for (std::size_t i = j; i < n; ++i)
      if (!problem.banded || i - j < stored)
        matrix[i * size + j] = reduced.core[j * stored + (problem.banded ? i - j : i)];
    for (std::size_t k = 0; k < kBorder; ++k) matrix[(n + k) * size + j] = reduced.border[j * kBorder + k];
  }
  for (std::size_t i = 0; i < kBorder; ++i)
    for (std::size_t k = 0; k < kBorder; ++k) matrix[(n + i) * size + n + k] = reduced.corner[i * kBorder + k];
  return solve(std::move(matrix), reduced.gradient);
}

/// T Exp(xi) to first order in the rotation, then orthonormal again.
void retract(double* m, const double* xi) {
  Vec3 column[3];
  for (int k = 0; k < 3; ++k) column[k] = {m[k], m[4 + k], m[8 + k]};
  const Vec3 shift = xi[3] * column[0] + xi[4] * column[1] + xi[5] * column[2];
  Vec3 first = column[0] + xi[2] * column[1] - xi[1] * column[2];
  Vec3 second = column[1] - xi[2] * column[0] + xi[0] * column[2];
  first = (1.0 / std::sqrt(dot(first, first))) * first;
  second = second - dot(first, second) * first;
  second = (1.0 / std::sqrt(dot(second, second))) * second;
  const Vec3 columns[3] = {first, second, cross(first, second)};
  for (int k = 0; k < 3; ++k) {
    m[k] = columns[k].x;
    m[4 + k] = columns[k].y;
    m[8 + k] = columns[k].z;
  }
  m[3] += shift.x;
  m[7] += shift.y;
  m[11] += shift.z;
}

double solve_from_disturbed(Scene scene, bool depth, bool banded, int length, int threads, Kernel kernel) {
  const LandmarkProblem problem = make_problem(scene, depth, banded, length, kernel);
  LandmarkSystem system(problem, threads);
  std::mt19937 random(7);
  std::normal_distribution<double> normal;
  for (std::size_t t = 2; t < static_cast<std::size_t>(scene.num_frames); ++t) {
    double xi[6];
    for (double& x : xi) x = 0.002 * normal(random);
    retract(scene.poses.data() + 16 * t, xi);
    if (depth) scene.log_scale[t] += 0.01 * normal(random);
  }
  for (std::size_t i = 0; i < scene.landmarks.size(); ++i)
    if (problem.landmark_free[i / 3] != 0) scene.landmarks[i] += 0.02 * normal(random);
  scene.intrinsics[0] += 4.0;

  System hessian(problem), reduced(problem);
  std::vector<double> step(scene.landmarks.size());
  std::vector<double> energies(static_cast<std::size_t>(system.num_batches()));
  double energy = 0.0;
  for (int iteration = 0; iteration < 25; ++iteration) {
    const LandmarkState state{scene.poses.data(), scene.intrinsics.data(), scene.log_scale.data(),
                              scene.landmarks.data()};
    system.energies(state, energies.data());
    energy = 0.0;
    for (const double part : energies) energy += part;
    check(system.linearize(state, hessian.view()).finite, "the linearization is finite");
    check(system.reduce({1e-9, 1e-9, 1e32}, hessian.view(), reduced.view()), "landmarks are determined");
    const std::vector<double> camera = camera_step(problem, reduced);
    const StepSums sums = system.back_substitute(camera.data(), nullptr, step.data());
    check(sums.squared >= 0.0, "the sums are finite");
    for (std::size_t t = 0; t < static_cast<std::size_t>(scene.num_frames); ++t) {
      double xi[kFrameColumns] = {};
      for (std::size_t k = 0; k < kFrameColumns; ++k) {
        const int column = problem.columns[t * kFrameColumns + k];
        if (column >= 0) xi[k] = camera[static_cast<std::size_t>(column)];
      }
      retract(scene.poses.data() + 16 * t, xi);
      scene.log_scale[t] += xi[6];
    }
    for (std::size_t k = 0; k < kBorder; ++k)
      scene.intrinsics[k] += camera[static_cast<std::size_t>(problem.num_columns) + k];
    for (std::size_t i = 0; i < scene.landmarks.size(); ++i) scene.landmarks[i] += step[i];
  }
  std::printf("depth %d banded %d threads %d kernel %d: %zu observations, energy %.3g\n", depth, banded, threads,
              static_cast<int>(kernel.kind), scene.pose.size(), energy);
  return energy;
}

/// What other factors are told of the elimination must be what it did: S = H + damping - W^T W over all landmarks.
void test_foreign_factors(const Scene& scene, bool banded, int length, int threads) {
  const LandmarkProblem problem = make_problem(scene, true, banded, length, {KernelKind::huber, 1.0});
  LandmarkSystem system(problem, threads);
  System normal(problem), reduced(problem);
  system.linearize({scene.poses.data(), scene.intrinsics.data(), scene.log_scale.data(), scene.landmarks.data()},
                   normal.view());
  std::vector<std::int64_t> rows;
  for (std::int64_t i = 0; i < scene.num_landmarks; ++i)
    if (problem.landmark_free[static_cast<std::size_t>(i)] != 0) rows.push_back(i);
  // Each twice, so that blocks add up.
  std::vector<std::int64_t> twice = rows;
  twice.insert(twice.end(), rows.begin(), rows.end());
  const auto all = static_cast<std::size_t>(scene.num_landmarks), count = rows.size();
  const auto landmarks = static_cast<std::int64_t>(count);
  std::vector<double> blocks, gradients, before(9 * all), before_gradient(3 * all), after(9 * all), gradient(3 * all);
  for (std::size_t i = 0; i < twice.size(); ++i) {
    for (std::size_t k = 0; k < 9; ++k) blocks.push_back(k % 4 == 0 ? 3.0 : 0.5);
    for (std::size_t k = 0; k < 3; ++k) gradients.push_back(static_cast<double>(i % 5) - 1.0);
  }
  system.landmark_blocks(before.data(), before_gradient.data());
  const double largest = system.add_to_landmarks(2 * landmarks, twice.data(), blocks.data(), gradients.data());
  system.landmark_blocks(after.data(), gradient.data());
  double expected_largest = 0.0;
  for (const std::int64_t row : rows)
    for (std::size_t k = 0; k < 9; ++k) {
      const std::size_t at = 9 * static_cast<std::size_t>(row) + k;
      check_close(after[at] - before[at], k % 4 == 0 ? 6.0 : 1.0, 1e-8, "blocks add up");
      if (k < 3)
        expected_largest = std::max(expected_largest, std::abs(gradient[3 * static_cast<std::size_t>(row) + k]));
    }
  check_close(largest, expected_largest, 1e-12, "largest gradient");
  const DampingBounds bounds{0.3, 1e-6, 1e32};
  check(system.reduce(bounds, normal.view(), reduced.view()), "the landmarks are determined");

  const auto n = static_cast<std::size_t>(problem.num_columns), width = n + kBorder + 1;
  const auto stored = static_cast<std::size_t>(problem.stored_rows);
  std::vector<double> whitened(count * 3 * width), inverse(9 * count);
  system.whitened_coupling(landmarks, rows.data(), whitened.data());
  system.inverse_factors(landmarks, rows.data(), inverse.data());
  const auto product = [&](std::size_t i, std::size_t j) {
    double sum = 0.0;
    for (std::size_t k = 0; k < 3 * count; ++k) sum += whitened[k * width + i] * whitened[k * width + j];
    return sum;
  };
  for (std::size_t j = 0; j < n; ++j) {
    for (std::size_t i = j; i < std::min(n, banded ? j + stored : n); ++i) {
      const std::size_t at = j * stored + (banded ? i - j : i);
      const double damping = i == j ? bounds.damping * normal.core[at] : 0.0;
      check_close(reduced.core[at], normal.core[at] + damping - product(i, j), 1e-8, "reduced core");
    }
    for (std::size_t k = 0; k < kBorder; ++k)
      check_close(reduced.border[j * kBorder + k], normal.border[j * kBorder + k] - product(j, n + k), 1e-8, "border");
    check_close(reduced.gradient[j], product(j, n + kBorder) - normal.gradient[j], 1e-8, "right-hand side");
  }

  std::vector<double> step(3 * all), extra(3 * all, 0.7);
  const std::vector<double> nothing(n + kBorder, 0.0);
  const StepSums sums = system.back_substitute(nothing.data(), extra.data(), step.data());
  double squared = 0.0, slope = 0.0;
  for (std::size_t i = 0; i < count; ++i) {
    const double* l = inverse.data() + 9 * i;  // L^{-1}, row-major
    const auto row = static_cast<std::size_t>(rows[i]);
    double x[3] = {};
    for (std::size_t k = 0; k < 3; ++k)
      for (std::size_t m = 0; m < 3; ++m) x[k] += l[3 * k + m] * (gradient[3 * row + m] + extra[3 * row + m]);
    for (std::size_t k = 0; k < 3; ++k) {
      const double expected = -(l[k] * x[0] + l[3 + k] * x[1] + l[6 + k] * x[2]);
      check_close(step[3 * row + k], expected, 1e-10, "step of a landmark");
      squared += expected * expected;
      slope += gradient[3 * row + k] * expected;
    }
  }
  check_close(sums.squared, squared, 1e-9, "squared step");
  check_close(sums.slope, slope, 1e-9, "slope");
  check(step[0] == 0.0, "a frozen landmark stays");
}

void test_degenerate_problems() {
  LandmarkProblem nothing;
  LandmarkSystem empty(nothing, 2);
  System system(nothing);
  const double one[4] = {1.0, 1.0, 0.0, 0.0};
  check(empty.linearize({nullptr, one, nullptr, nullptr}, system.view()).finite, "nothing is finite");

  std::mt19937 random(1);
  const Scene scene = make_scene(5, 1, 5, random);
  LandmarkProblem unseen = make_problem(scene, false, false, 5, {});
  unseen.reprojection[0].count = 0;
  unseen.landmark_free[0] = 1;
  LandmarkSystem alone(unseen, 1);
  System normal(unseen), reduced(unseen);
  alone.linearize({scene.poses.data(), scene.intrinsics.data(), scene.log_scale.data(), scene.landmarks.data()},
                  normal.view());
  check(!alone.reduce({0.0, 1e-6, 1e32}, normal.view(), reduced.view()), "an unseen landmark is not determined");
  check(alone.reduce({1.0, 1e-6, 1e32}, normal.view(), reduced.view()), "damping determines it");

  LandmarkProblem narrow = make_problem(scene, false, true, 5, {});
  narrow.landmark_free[0] = 1;
  narrow.stored_rows = 7;
  bool refused = false;
  try {
    LandmarkSystem too_narrow(narrow, 1);
  } catch (const std::invalid_argument&) {
    refused = true;
  }
  check(refused, "a band that is too narrow is refused");
}

}  // namespace

int main() {
  test_degenerate_problems();
  std::mt19937 random(5);
  const Scene few = make_scene(6, 40, 6, random), many = make_scene(25, 700, 8, random);
  const std::vector<Kernel> kernels = {{KernelKind::quadratic, 1.0},
                                       {KernelKind::huber, 1.0},
                                       {KernelKind::pseudo_huber, 3.0},
                                       {KernelKind::cauchy, 20.0},
                                       {KernelKind::norm, 10.0}};
  for (const Kernel& kernel : kernels)
    check(solve_from_disturbed(few, true, false, 6, 1, kernel) < 1e-10, "every kernel reaches the truth");
  for (const bool depth : {false, true})
    for (const bool banded : {false, true})
      for (const int threads : {1, 3})
        check(solve_from_disturbed(many, depth, banded, 8, threads, kernels[1]) < 1e-10, "steps reach the truth");
  for (const bool banded : {false, true}) test_foreign_factors(few, banded, 6, 1);
  test_foreign_factors(make_scene(12, 400, 5, random), true, 5, 3);
  return 0;
}
