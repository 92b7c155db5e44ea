// Residuals of eight records at once.
#pragma once

#include "uni4d_fg/camera.hpp"
#include "uni4d_fg/landmark_plan.hpp"

namespace uni4d_fg {

template <int bytes>
struct SimdPoint {
  Simd8<bytes> x, y, z;
};

/// Landmarks of a group's lanes, from (64, 3) coordinates of the chunk.
template <int bytes>
UNI4D_FG_INLINE SimdPoint<bytes> gather_points(const double* points, const std::uint8_t* lane_landmark) {
  SimdPoint<bytes> out;
  for (int lane = 0; lane < kSimd8Width; ++lane) {
    const double* point = points + 3 * lane_landmark[lane];
    out.x.set(lane, point[0]);
    out.y.set(lane, point[1]);
    out.z.set(lane, point[2]);
  }
  return out;
}

/// x = R^T (p - c).
template <int bytes>
UNI4D_FG_INLINE SimdPoint<bytes> to_camera(const double* world_T_cam, const SimdPoint<bytes>& p) {
  const double* m = world_T_cam;
  const Simd8<bytes> dx = p.x - m[3], dy = p.y - m[7], dz = p.z - m[11];
  return {m[0] * dx + m[4] * dy + m[8] * dz, m[1] * dx + m[5] * dy + m[9] * dz, m[2] * dx + m[6] * dy + m[10] * dz};
}

/// Inverse depth continued by its tangent below the near plane, written without a selection.
template <int bytes>
struct SimdDepth {
  Simd8<bytes> safe;     ///< max(z, near)
  Simd8<bytes> inverse;  ///< 1 / safe: slope of log depth
  Simd8<bytes> below;    ///< min(z - near, 0)
};

template <int bytes>
UNI4D_FG_INLINE SimdDepth<bytes> guarded_depth(const Simd8<bytes>& z) {
  const Simd8<bytes> safe = larger(z, kNearPlane);
  return {safe, 1.0 / safe, z - safe};
}

/// g(z) of the camera model.
template <int bytes>
UNI4D_FG_INLINE Simd8<bytes> inverse_depth(const SimdDepth<bytes>& depth) {
  return depth.inverse - depth.below * (1.0 / (kNearPlane * kNearPlane));
}

template <int bytes>
UNI4D_FG_INLINE Simd8<bytes> log_depth(const SimdDepth<bytes>& depth) {
  return natural_log(depth.safe) + depth.below * (1.0 / kNearPlane);
}

template <int bytes>
UNI4D_FG_INLINE Simd8<bytes> field(const double* data, Field which) {
  return load<Simd8<bytes>>(data + which * kSimd8Width);
}

}  // namespace uni4d_fg
