// Dynamic reprojection: static reprojection of a point of one frame, its camera frozen; px.
#pragma once

#include "uni4d_fg/camera.hpp"

namespace uni4d_fg::dynamic_reprojection {

constexpr int kDim = 2;

/// r (2) of a point (world, m) seen at pixel uv.
UNI4D_FG_INLINE void residual(const Pose& pose, const Vec3& point, const Intrinsics& k, const double* uv, double* r) {
  const Pixel pixel = project(k, world_to_camera(pose, point));
  r[0] = uv[0] - pixel.u;
  r[1] = uv[1] - pixel.v;
}

/// r (2) and d r / d point (2x3), row-major.
UNI4D_FG_INLINE void linearize(const Pose& pose, const Vec3& point, const Intrinsics& k, const double* uv, double* r,
                               double* by_point) {
  const Projection p = project_linearized(k, world_to_camera(pose, point));
  r[0] = uv[0] - p.u;
  r[1] = uv[1] - p.v;
  projection_by_world_point(p, pose.rotation, by_point);
  for (int i = 0; i < 6; ++i) by_point[i] = -by_point[i];
}

}  // namespace uni4d_fg::dynamic_reprojection
