// Dynamic reprojection: static reprojection of a point of one frame, its camera frozen; px.
#pragma once

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg {

struct DynamicReprojection {
  static constexpr const char* kName = "dynamic_reprojection";
  static constexpr int kDim = 2;
  static constexpr auto kVariables = arguments(argument<Vec3>("dynamic_point"));
  static constexpr auto kData =
      arguments(argument<Vector<2>>("uv"), argument<Pose>("world_T_cam"), argument<Intrinsics>("intrinsics"));

  /// r (2) of a point (world, m) seen at pixel uv.
  UNI4D_FG_INLINE static void residual(const Vec3& point, Vector<2> uv, const Pose& pose, const Intrinsics& k,
                                       double* r) {
    const Pixel pixel = project(k, world_to_camera(pose, point));
    r[0] = uv[0] - pixel.u;
    r[1] = uv[1] - pixel.v;
  }

  /// r (2) and d r / d point (2x3), row-major.
  UNI4D_FG_INLINE static void linearize(const Vec3& point, Vector<2> uv, const Pose& pose, const Intrinsics& k,
                                        double* r, double* by_point) {
    const Projection p = project_linearized(k, world_to_camera(pose, point));
    r[0] = uv[0] - p.u;
    r[1] = uv[1] - p.v;
    projection_by_world_point(p, pose.rotation, by_point);
    for (int i = 0; i < 6; ++i) by_point[i] = -by_point[i];
  }
};
UNI4D_FG_FACTOR_TYPE(DynamicReprojection)

}  // namespace uni4d_fg
