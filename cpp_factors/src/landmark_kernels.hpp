// Residuals of eight records at once.
#pragma once

#include "uni4d_fg/camera.hpp"
#include "uni4d_fg/landmark_plan.hpp"

namespace uni4d_fg {

struct SimdPoint {
  Simd8 x, y, z;
};

/// Landmarks of a group's lanes, from (64, 3) coordinates of the chunk.
UNI4D_FG_INLINE SimdPoint gather_points(const double* points, const std::uint8_t* lane_landmark) {
  SimdPoint out;
  for (int lane = 0; lane < kSimd8Width; ++lane) {
    const double* point = points + 3 * lane_landmark[lane];
    out.x[lane] = point[0];
    out.y[lane] = point[1];
    out.z[lane] = point[2];
  }
  return out;
}

/// x = R^T (p - c).
UNI4D_FG_INLINE SimdPoint to_camera(const double* world_T_cam, const SimdPoint& p) {
  const double* m = world_T_cam;
  const Simd8 dx = p.x - m[3], dy = p.y - m[7], dz = p.z - m[11];
  return {m[0] * dx + m[4] * dy + m[8] * dz, m[1] * dx + m[5] * dy + m[9] * dz, m[2] * dx + m[6] * dy + m[10] * dz};
}

/// Inverse depth continued by its tangent below the near plane, written without a selection.
struct SimdDepth {
  Simd8 safe;     ///< max(z, near)
  Simd8 inverse;  ///< 1 / safe: slope of log depth
  Simd8 below;    ///< min(z - near, 0)
};

UNI4D_FG_INLINE SimdDepth guarded_depth(const Simd8& z) {
  const Simd8 safe = larger(z, kNearPlane);
  return {safe, 1.0 / safe, z - safe};
}

/// g(z) of the camera model.
UNI4D_FG_INLINE Simd8 inverse_depth(const SimdDepth& depth) {
  return depth.inverse - depth.below * (1.0 / (kNearPlane * kNearPlane));
}

UNI4D_FG_INLINE Simd8 log_depth(const SimdDepth& depth) {
  return natural_log(depth.safe) + depth.below * (1.0 / kNearPlane);
}

UNI4D_FG_INLINE Simd8 field(const double* data, Field which) { return load_simd8(data + which * kSimd8Width); }

}  // namespace uni4d_fg
