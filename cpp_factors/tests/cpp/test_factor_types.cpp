// Batch kernels of every factor type on buffers of exactly their size: Jacobians of points against central differences,
// empty ranges, splits into ranges.
#include <cstring>
#include <random>
#include <vector>

#include "check.hpp"
#include "factor_types.hpp"

using uni4d_fg::ArgumentInfo;
using uni4d_fg::FactorType;

namespace {

struct Buffers {
  std::vector<std::vector<double>> in, out;
  const double* in_at[uni4d_fg::kMostArguments] = {};
  double* out_at[uni4d_fg::kMostArguments + 1] = {};

  Buffers(const FactorType& type, int rows, std::mt19937& random) {
    std::normal_distribution<double> normal;
    for (std::size_t i = 0; i < type.num_arguments(); ++i) {
      const ArgumentInfo& argument = type.argument(i);
      std::vector<double> values(static_cast<std::size_t>(rows * argument.numbers));
      for (double& value : values) value = argument.positive ? 0.5 + std::abs(normal(random)) : normal(random);
      if (argument.numbers == 16)
        for (int n = 0; n < rows; ++n) set_pose(&values[static_cast<std::size_t>(16 * n)], 0.1 * normal(random));
      if (argument.numbers == 3)
        for (int n = 0; n < rows; ++n) values[static_cast<std::size_t>(3 * n + 2)] += 4.0;
      in.push_back(values);
    }
    out.emplace_back(static_cast<std::size_t>(rows * type.dim));
    for (const ArgumentInfo& variable : type.variables)
      out.emplace_back(static_cast<std::size_t>(rows * type.dim * variable.tangent));
    for (std::size_t i = 0; i < in.size(); ++i) in_at[i] = in[i].data();
    for (std::size_t i = 0; i < out.size(); ++i) out_at[i] = out[i].data();
  }

  static void set_pose(double* pose, double angle) {
    const double c = std::cos(angle), s = std::sin(angle);
    const double values[16] = {c, 0, s, 0.1 * angle, 0, 1, 0, angle, -s, 0, c, 0.3 * angle, 0, 0, 0, 1};
    std::memcpy(pose, values, sizeof(values));
  }
};

void check_type(const FactorType& type, int rows, std::mt19937& random) {
  Buffers buffers(type, rows, random);
  type.linearize(buffers.in_at, buffers.out_at, 0, rows);
  const std::vector<std::vector<double>> whole = buffers.out;
  for (int begin = 0; begin < rows; begin += 3)
    type.linearize(buffers.in_at, buffers.out_at, begin, begin + 3 < rows ? begin + 3 : rows);
  check(buffers.out == whole, type.name);
  type.linearize(buffers.in_at, buffers.out_at, rows, rows);
  type.residual(buffers.in_at, buffers.out_at, 0, rows);
  for (std::size_t i = 0; i < whole[0].size(); ++i) check_close(buffers.out[0][i], whole[0][i], 1e-12, type.name);
  // Variables whose tangent is their own entries; poses are left to the Python tests.
  for (std::size_t v = 0; v < type.variables.size(); ++v) {
    const int columns = type.variables[v].numbers;
    if (columns == 16) continue;
    for (int column = 0; column < columns; ++column) {
      const double step = 1e-6;
      std::vector<double> sides[2];
      for (int side = 0; side < 2; ++side) {
        for (int n = 0; n < rows; ++n)
          buffers.in[v][static_cast<std::size_t>(n * columns + column)] += side == 0 ? step : -2.0 * step;
        type.residual(buffers.in_at, buffers.out_at, 0, rows);
        sides[side] = buffers.out[0];
      }
      for (int n = 0; n < rows; ++n) buffers.in[v][static_cast<std::size_t>(n * columns + column)] += step;
      for (int i = 0; i < rows * type.dim; ++i) {
        const auto at = static_cast<std::size_t>(i);
        const double slope = (sides[0][at] - sides[1][at]) / (2.0 * step);
        const double jacobian = whole[v + 1][static_cast<std::size_t>(i * columns + column)];
        check_close(jacobian, slope, 1e-5, type.name);
      }
    }
  }
}

}  // namespace

int main() {
  std::mt19937 random(0);
  check(uni4d_fg::factor_types().size() >= 12, "factor types are listed");
  for (const FactorType& type : uni4d_fg::factor_types())
    for (const int rows : {0, 1, 7, 64}) check_type(type, rows, random);
  std::puts("factor types: ok");
}
