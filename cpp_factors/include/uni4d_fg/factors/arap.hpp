// As rigid as possible: r = d(p_t, q_t) - d(p_{t+1}, q_{t+1}), d(p, q) = sqrt(|p - q|^2 + epsilon^2); m.
#pragma once

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg::arap {

/// Smoothing of the distance, m.
constexpr double kDistanceEpsilon = 1e-4;

UNI4D_FG_INLINE double smooth_distance(const Vec3& d) {
  return std::sqrt(dot(d, d) + kDistanceEpsilon * kDistanceEpsilon);
}

/// r (1) of two points at one frame and at the next (world, m).
UNI4D_FG_INLINE void residual(const Vec3& first, const Vec3& second, const Vec3& first_next, const Vec3& second_next,
                              double* r) {
  r[0] = smooth_distance(first - second) - smooth_distance(first_next - second_next);
}

/// r (1) and the directions u, v of both distances: the Jacobians of the four points are u, -u, -v, v (1x3 each).
UNI4D_FG_INLINE void linearize(const Vec3& first, const Vec3& second, const Vec3& first_next, const Vec3& second_next,
                               double* r, Vec3& now, Vec3& next) {
  const Vec3 d_now = first - second, d_next = first_next - second_next;
  const double distance_now = smooth_distance(d_now), distance_next = smooth_distance(d_next);
  r[0] = distance_now - distance_next;
  now = (1.0 / distance_now) * d_now;
  next = (1.0 / distance_next) * d_next;
}

}  // namespace uni4d_fg::arap

namespace uni4d_fg {

struct Arap {
  static constexpr const char* kName = "arap";
  static constexpr int kDim = 1;
  static constexpr auto kVariables = arguments(argument<Vec3>("first"), argument<Vec3>("second"),
                                               argument<Vec3>("first_next"), argument<Vec3>("second_next"));
  static constexpr auto kData = arguments();

  UNI4D_FG_INLINE static void residual(const Vec3& first, const Vec3& second, const Vec3& first_next,
                                       const Vec3& second_next, double* r) {
    arap::residual(first, second, first_next, second_next, r);
  }

  UNI4D_FG_INLINE static void linearize(const Vec3& first, const Vec3& second, const Vec3& first_next,
                                        const Vec3& second_next, double* r, double* by_first, double* by_second,
                                        double* by_first_next, double* by_second_next) {
    Vec3 now, next;
    arap::linearize(first, second, first_next, second_next, r, now, next);
    store(now, by_first);
    store(-now, by_second);
    store(-next, by_first_next);
    store(next, by_second_next);
  }
};
UNI4D_FG_FACTOR_TYPE(Arap)

}  // namespace uni4d_fg
