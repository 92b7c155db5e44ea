// Temporal smoothness of a dynamic point: first difference (velocity) or second difference (acceleration); m.
#pragma once

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg {

struct VelocitySmoothness {
  static constexpr const char* kName = "velocity_smoothness";
  static constexpr int kDim = 3;
  static constexpr auto kVariables = arguments(argument<Vec3>("now"), argument<Vec3>("after"));
  static constexpr auto kData = arguments();

  /// Jacobians are these multiples of the identity, in the order of the points.
  static constexpr double kJacobian[2] = {-1.0, 1.0};

  /// r (3) = after - now.
  UNI4D_FG_INLINE static void residual(const Vec3& now, const Vec3& after, double* r) { store(after - now, r); }

  UNI4D_FG_INLINE static void linearize(const Vec3& now, const Vec3& after, double* r, double* by_now,
                                        double* by_after) {
    residual(now, after, r);
    store_identity(kJacobian[0], by_now);
    store_identity(kJacobian[1], by_after);
  }
};
UNI4D_FG_FACTOR_TYPE(VelocitySmoothness)

struct AccelerationSmoothness {
  static constexpr const char* kName = "acceleration_smoothness";
  static constexpr int kDim = 3;
  static constexpr auto kVariables =
      arguments(argument<Vec3>("before"), argument<Vec3>("now"), argument<Vec3>("after"));
  static constexpr auto kData = arguments();

  /// Jacobians are these multiples of the identity, in the order of the points.
  static constexpr double kJacobian[3] = {1.0, -2.0, 1.0};

  /// r (3) = after - 2 now + before.
  UNI4D_FG_INLINE static void residual(const Vec3& before, const Vec3& now, const Vec3& after, double* r) {
    store(after - 2.0 * now + before, r);
  }

  UNI4D_FG_INLINE static void linearize(const Vec3& before, const Vec3& now, const Vec3& after, double* r,
                                        double* by_before, double* by_now, double* by_after) {
    residual(before, now, after, r);
    store_identity(kJacobian[0], by_before);
    store_identity(kJacobian[1], by_now);
    store_identity(kJacobian[2], by_after);
  }
};
UNI4D_FG_FACTOR_TYPE(AccelerationSmoothness)

}  // namespace uni4d_fg
