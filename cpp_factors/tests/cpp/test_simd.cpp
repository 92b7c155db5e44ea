// SIMD values: the same results in registers of every width, on any processor.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>

#include "check.hpp"
#include "uni4d_fg/simd.hpp"

namespace {

using namespace uni4d_fg;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
const double kValues[8] = {1.0, -2.5, 3e-3, 4e7, 0.25, -6.0, 7.125, kNan};
const double kOthers[8] = {0.5, 2.0, -3.0, 1e-3, 8.0, -0.125, 9.0, 1.0};

bool same(double a, double b) { return a == b || (std::isnan(a) && std::isnan(b)); }

template <int bytes>
void lanes_are_numbers() {
  const auto a = load<Simd8<bytes>>(kValues), b = load<Simd8<bytes>>(kOthers);
  const Simd8<bytes> computed = -(2.0 * a + b * a - a / b) - 1.0;
  const auto high = larger(a, 0.5), low = at_most(a, 0.5), above = is_above(a, 0.5), sizes = magnitude(a);
  Simd8<bytes> moved = b;
  moved += a;
  double stored[8];
  store(moved, stored);
  for (int i = 0; i < 8; ++i) {
    const double x = kValues[i], y = kOthers[i];
    check(same(computed[i], -(2.0 * x + y * x - x / y) - 1.0), "arithmetic");
    check(same(high[i], larger(x, 0.5)), "larger");
    check(same(low[i], at_most(x, 0.5)), "at_most");
    check(same(sizes[i], std::abs(x)), "magnitude");
    check(same(above[i], is_above(x, 0.5)), "is_above");
    check(same(stored[i], y + x), "+=");
  }
  check(sum(b) == ((0.5 + 2.0) + (-3.0 + 1e-3)) + ((8.0 - 0.125) + (9.0 + 1.0)), "sum of doubles");
}

template <int bytes>
void roots_and_logarithms_are_exact() {
  double values[8];
  for (int k = -40; k < 40; ++k) {
    for (int i = 0; i < 8; ++i) values[i] = std::exp2(k + 0.13 * i);
    const auto a = load<Simd8<bytes>>(values);
    const auto root = square_root(a), log = natural_log(a), log1p = log_one_plus(a);
    for (int i = 0; i < 8; ++i) {
      check(root[i] == std::sqrt(values[i]), "square_root");
      check(std::abs(log[i] - std::log(values[i])) <= 4e-16 * std::abs(std::log(values[i])) + 1e-17, "logarithm");
      check(std::abs(log1p[i] - std::log1p(values[i])) <= 1e-15 * std::log1p(values[i]), "logarithm");
    }
  }
}

template <int bytes>
void a_matrix_is_transposed() {
  Simd8<bytes> in[8], out[8];
  for (int i = 0; i < 8; ++i)
    for (int j = 0; j < 8; ++j) in[i].set(j, 10.0 * i + j);
  transpose(in, out);
  for (int i = 0; i < 8; ++i)
    for (int j = 0; j < 8; ++j) check(out[j][i] == 10.0 * i + j, "transpose");
}

template <int bytes>
void floats_are_summed() {
  float values[16];
  for (int i = 0; i < 16; ++i) values[i] = static_cast<float>(i * i) - 7.0F;
  const auto a = load<SimdFloat<bytes>>(values);
  check(sum(2.0F * a + a) == 3.0 * (1240.0 - 112.0), "sum of floats");
  const auto bounded = at_most(magnitude(a), 5.0F);
  for (int i = 0; i < 16; ++i) check(bounded[i] == std::min(std::abs(values[i]), 5.0F), "floats at most");
}

template <int bytes>
void all() {
  lanes_are_numbers<bytes>();
  roots_and_logarithms_are_exact<bytes>();
  a_matrix_is_transposed<bytes>();
  floats_are_summed<bytes>();
}

}  // namespace

int main() {
#if defined(__GNUC__) || defined(__clang__)
  all<16>();
  all<32>();
  all<64>();
#else
  all<8>();
#endif
  std::puts("ok");
}
