// The one assertion of the C++ tests.
#pragma once

#include <cmath>
#include <cstdio>
#include <cstdlib>

inline void check(bool condition, const char* what) {
  if (condition) return;
  std::fprintf(stderr, "FAILED: %s\n", what);
  std::exit(1);
}

inline void check_close(double actual, double expected, double tolerance, const char* what) {
  if (std::abs(actual - expected) <= tolerance * (1.0 + std::abs(expected))) return;
  std::fprintf(stderr, "FAILED: %s: %.17g, expected %.17g\n", what, actual, expected);
  std::exit(1);
}
