// PairSystem: gradient against central differences of the energy, partly frozen entries, tiles of every length,
// threads.
#include <random>

#include "check.hpp"
#include "pair_system.hpp"
#include "uni4d_fg/parallel.hpp"

using namespace uni4d_fg;

namespace {

constexpr int kPoses = 4;

struct Scene {
  std::vector<std::int64_t> source, target;
  std::vector<double> uv_source, depth, uv_target, sigma, weight;
  std::vector<double> poses = std::vector<double>(16 * kPoses, 0.0);
  double intrinsics[4] = {500.0, 480.0, 320.0, 240.0};

  Scene(int count, bool sorted, std::mt19937& random) {
    std::uniform_real_distribution<double> unit(0.0, 1.0);
    for (int i = 0; i < count; ++i) {
      const int pair = sorted ? i * 12 / count : static_cast<int>(unit(random) * 12.0) % 12;
      source.push_back(pair / 3);
      target.push_back(pair % 3 + (pair % 3 >= pair / 3));
      const double u = 600.0 * unit(random), v = 400.0 * unit(random);
      uv_source.insert(uv_source.end(), {u, v});
      uv_target.insert(uv_target.end(), {u + 20.0 * unit(random), v + 20.0 * unit(random)});
      depth.push_back(1.0 + 4.0 * unit(random));
      sigma.insert(sigma.end(), {5.0 + unit(random), 7.0 + unit(random)});
      weight.push_back(unit(random));
    }
    for (int i = 0; i < kPoses; ++i) {
      for (int d = 0; d < 4; ++d) poses[static_cast<std::size_t>(16 * i + 5 * d)] = 1.0;
      for (int d = 0; d < 3; ++d) poses[static_cast<std::size_t>(16 * i + 4 * d + 3)] = 0.05 * unit(random) * i;
    }
  }

  PairRows rows() const {
    return {static_cast<std::int64_t>(source.size()),
            source.data(),
            target.data(),
            uv_source.data(),
            depth.data(),
            uv_target.data(),
            sigma.data(),
            2,
            weight.data()};
  }
};

/// Columns of the translations of every pose but the first, and of the focal lengths.
void check_gradient(int count, bool sorted, KernelKind kind, int threads, std::mt19937& random) {
  Scene scene(count, sorted, random);
  std::vector<std::int64_t> pose_columns(6 * kPoses, -1), intrinsics_columns{0, 1, -1, -1};
  int size = 2;
  for (int i = 1; i < kPoses; ++i)
    for (int d = 3; d < 6; ++d) pose_columns[static_cast<std::size_t>(6 * i + d)] = size++;
  const PairSystem system(kPoses, scene.rows(), {kind, 1.3}, pose_columns, intrinsics_columns, size, threads);
  std::vector<double> hessian(static_cast<std::size_t>(size * size)), gradient(static_cast<std::size_t>(size));
  system.linearize(scene.poses.data(), scene.intrinsics, hessian.data(), gradient.data());
  const auto slope = [&](double& entry, double step) {
    const double before = entry;
    entry = before + step;
    const double up = system.energy(scene.poses.data(), scene.intrinsics);
    entry = before - step;
    const double down = system.energy(scene.poses.data(), scene.intrinsics);
    entry = before;
    return (up - down) / (2.0 * step);
  };
  // All rotations are the identity, so that a body-frame translation is one of the center.
  for (int i = 1; i < kPoses; ++i)
    for (int d = 0; d < 3; ++d) {
      const auto column = static_cast<std::size_t>(pose_columns[static_cast<std::size_t>(6 * i + 3 + d)]);
      check_close(gradient[column], slope(scene.poses[static_cast<std::size_t>(16 * i + 4 * d + 3)], 1e-6), 1e-4,
                  "gradient of a center");
    }
  for (std::size_t i = 0; i < 2; ++i)
    check_close(gradient[i], slope(scene.intrinsics[i], 1e-4), 1e-4, "gradient of a focal length");
  for (int i = 0; i < size; ++i)
    for (int j = 0; j < size; ++j)
      check_close(hessian[static_cast<std::size_t>(i * size + j)], hessian[static_cast<std::size_t>(j * size + i)],
                  1e-12, "symmetry");
}

void check_parallel_for() {
  for (const int count : {0, 1, 5, 100})
    for (const int threads : {1, 2, 7}) {
      std::vector<int> seen(static_cast<std::size_t>(count), 0);
      parallel_for(count, threads, [&](int begin, int end, int) {
        for (int i = begin; i < end; ++i) ++seen[static_cast<std::size_t>(i)];
      });
      for (const int times : seen) check(times == 1, "every index once");
    }
  bool caught = false;
  try {
    parallel_for(10, 3, [](int begin, int, int) {
      if (begin > 0) throw 7;
    });
  } catch (int value) {
    caught = value == 7;
  }
  check(caught, "an exception reaches the caller");
}

}  // namespace

int main() {
  std::mt19937 random(0);
  check_parallel_for();
  for (int kind = 0; kind < kKernelKinds; ++kind)
    for (const int count : {1, 63, 64, 65, 900})
      check_gradient(count, count != 65, static_cast<KernelKind>(kind), 1 + count % 3, random);
  check_gradient(50000, true, KernelKind::huber, 3, random);
  check_gradient(0, true, KernelKind::huber, 2, random);
  std::puts("pair system: ok");
}
