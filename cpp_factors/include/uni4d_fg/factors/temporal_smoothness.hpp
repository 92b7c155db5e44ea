// Temporal smoothness of a dynamic point: first difference (velocity) or second difference (acceleration); m.
#pragma once

#include "uni4d_fg/math.hpp"

namespace uni4d_fg::temporal_smoothness {

constexpr int kDim = 3;

/// Jacobians are these multiples of the identity, in the order of the points.
constexpr double kVelocityJacobian[2] = {-1.0, 1.0};
constexpr double kAccelerationJacobian[3] = {1.0, -2.0, 1.0};

/// r (3) = after - now.
UNI4D_FG_INLINE void velocity_residual(const Vec3& now, const Vec3& after, double* r) { store(after - now, r); }

/// r (3) = after - 2 now + before.
UNI4D_FG_INLINE void acceleration_residual(const Vec3& before, const Vec3& now, const Vec3& after, double* r) {
  store(after - 2.0 * now + before, r);
}

}  // namespace uni4d_fg::temporal_smoothness
