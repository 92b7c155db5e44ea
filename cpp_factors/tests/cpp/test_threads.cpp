// Systems that several threads use: one PairSystem for all, and a TrajectorySystem for each. Meant for ThreadSanitizer.
#include <cstdio>
#include <random>
#include <thread>
#include <vector>

#include "check.hpp"
#include "pair_system.hpp"
#include "uni4d_fg/trajectory_system.hpp"

using uni4d_fg::Kernel;
using uni4d_fg::KernelKind;
using uni4d_fg::PairRows;
using uni4d_fg::PairSystem;
using uni4d_fg::TrajectorySystem;

namespace {

constexpr int kThreads = 4, kCalls = 20;

template <typename F>
void in_threads(F f) {
  std::vector<std::thread> threads;
  for (int i = 0; i < kThreads; ++i) threads.emplace_back(f);
  for (std::thread& thread : threads) thread.join();
}

void test_shared_pair_system() {
  constexpr int poses = 4;
  constexpr std::size_t count = 6000;
  std::mt19937 random(5);
  std::uniform_real_distribution<double> pixel(0.0, 400.0), meters(1.0, 4.0);
  std::vector<std::int64_t> source, target, pose_columns, intrinsics_columns;
  std::vector<double> from, to, depth, sigma(count, 1.5), weight(count, 1.0), world_T_cam;
  for (std::size_t i = 0; i < count; ++i) {
    source.push_back(static_cast<std::int64_t>(i % poses));
    target.push_back(static_cast<std::int64_t>((i + 1 + i / poses % (poses - 1)) % poses));
    depth.push_back(meters(random));
    for (int k = 0; k < 2; ++k) from.push_back(pixel(random)), to.push_back(pixel(random));
  }
  for (int i = 0; i < poses; ++i)
    world_T_cam.insert(world_T_cam.end(), {1, 0, 0, 0.1 * i, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1});
  for (std::int64_t i = 0; i < 6 * poses; ++i) pose_columns.push_back(i);
  for (std::int64_t i = 6 * poses; i < 6 * poses + 4; ++i) intrinsics_columns.push_back(i);
  const double intrinsics[4] = {300.0, 300.0, 200.0, 150.0};
  const int size = 6 * poses + 4;
  const PairRows rows{static_cast<std::int64_t>(count),
                      source.data(),
                      target.data(),
                      from.data(),
                      depth.data(),
                      to.data(),
                      sigma.data(),
                      1,
                      weight.data()};
  const PairSystem system(poses, rows, {KernelKind::huber, 1.0}, pose_columns, intrinsics_columns, size, 3);
  const auto cells = static_cast<std::size_t>(size);
  std::vector<double> hessian(cells * cells), gradient(cells);
  system.linearize(world_T_cam.data(), intrinsics, hessian.data(), gradient.data());
  const double energy = system.energy(world_T_cam.data(), intrinsics);
  in_threads([&] {
    std::vector<double> found(cells * cells), slope(cells);
    for (int call = 0; call < kCalls; ++call) {
      system.linearize(world_T_cam.data(), intrinsics, found.data(), slope.data());
      check(found == hessian && slope == gradient, "threads share a PairSystem");
      check(system.energy(world_T_cam.data(), intrinsics) == energy, "the energy is the same in every thread");
    }
  });
}

void test_own_trajectory_systems() {
  constexpr int tracks = 40, frames = 30;
  std::vector<std::int64_t> track, rows;
  std::vector<double> points;
  for (int k = 0; k < tracks; ++k)
    for (int t = 0; t < frames; ++t) {
      track.push_back(k);
      points.insert(points.end(), {0.1 * k + 0.01 * t * t, 0.2 * t, 2.0});
      if (t + 2 < frames)
        for (int i = 0; i < 3; ++i) rows.push_back(static_cast<std::int64_t>(k) * frames + t + i);
    }
  const std::size_t count = rows.size() / 3;
  const std::vector<double> sigma(count, 0.5), weight(count, 1.0);
  const auto solve = [&] {
    TrajectorySystem system(track.data(), static_cast<std::int64_t>(track.size()), 3);
    system.add_smoothness({rows.data(), static_cast<std::int64_t>(count), sigma.data(), false, weight.data(),
                           Kernel{KernelKind::huber, 1.0}},
                          3);
    system.plan();
    check(!system.linearize(points.data()).any(), "every factor is finite");
    const auto step = system.solve(1e-2, 1e-6, 1e32, 1e-8, 100);
    check(step.has_value(), "there is a step");
    return step->delta;
  };
  const std::vector<double> alone = solve();
  in_threads([&] { check(solve() == alone, "systems of their own do not meet"); });
}

}  // namespace

int main() {
  test_shared_pair_system();
  test_own_trajectory_systems();
  std::puts("threads: passed");
  return 0;
}
