// Static reprojection: r = uv - project(K, R^T (p - c)), px.
#pragma once

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg {

struct StaticReprojection {
  static constexpr const char* kName = "static_reprojection";
  static constexpr int kDim = 2;
  static constexpr auto kVariables =
      arguments(argument<Pose>("world_T_cam"), argument<Vec3>("landmark"), argument<Intrinsics>("intrinsics"));
  static constexpr auto kData = arguments(argument<Vector<2>>("uv"));

  /// r (2) of a landmark (world, m) seen at pixel uv.
  UNI4D_FG_INLINE static void residual(const Pose& pose, const Vec3& landmark, const Intrinsics& k, Vector<2> uv,
                                       double* r) {
    const Pixel pixel = project(k, world_to_camera(pose, landmark));
    r[0] = uv[0] - pixel.u;
    r[1] = uv[1] - pixel.v;
  }

  /// r (2) and d r / d pose (2x6), landmark (2x3), intrinsics (2x4), row-major.
  UNI4D_FG_INLINE static void linearize(const Pose& pose, const Vec3& landmark, const Intrinsics& k, Vector<2> uv,
                                        double* r, double* by_pose, double* by_landmark, double* by_intrinsics) {
    const Vec3 x = world_to_camera(pose, landmark);
    const Projection p = project_linearized(k, x);
    r[0] = uv[0] - p.u;
    r[1] = uv[1] - p.v;
    projection_by_pose(p, x, by_pose);
    projection_by_world_point(p, pose.rotation, by_landmark);
    for (int i = 0; i < 12; ++i) by_pose[i] = -by_pose[i];
    for (int i = 0; i < 6; ++i) by_landmark[i] = -by_landmark[i];
    const double entries[8] = {-p.u_fx, 0.0, -1.0, 0.0, 0.0, -p.v_fy, 0.0, -1.0};
    for (int i = 0; i < 8; ++i) by_intrinsics[i] = entries[i];
  }
};
UNI4D_FG_FACTOR_TYPE(StaticReprojection)

}  // namespace uni4d_fg
