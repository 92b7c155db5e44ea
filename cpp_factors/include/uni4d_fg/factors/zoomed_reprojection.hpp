// Reprojection of a camera that zooms: r = uv - project((e^l fx, e^l fy, cx, cy), R^T (p - c)), px.
#pragma once

#include <cmath>

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg {

struct ZoomedReprojection {
  static constexpr const char* kName = "zoomed_reprojection";
  static constexpr int kDim = 2;
  static constexpr auto kVariables = arguments(argument<Pose>("world_T_cam"), argument<Vec3>("landmark"),
                                               argument<Intrinsics>("intrinsics"), argument<double>("zoom"));
  static constexpr auto kData = arguments(argument<Vector<2>>("uv"));

  /// r (2) of a landmark (world, m) seen at pixel uv, with the zoom as log focal length over that of the intrinsics.
  UNI4D_FG_INLINE static void residual(const Pose& pose, const Vec3& landmark, const Intrinsics& k, double zoom,
                                       Vector<2> uv, double* r) {
    const Pixel pixel = project(zoomed(k, std::exp(zoom)), world_to_camera(pose, landmark));
    r[0] = uv[0] - pixel.u;
    r[1] = uv[1] - pixel.v;
  }

  /// r (2) and d r / d pose (2x6), landmark (2x3), intrinsics (2x4), zoom (2), row-major.
  UNI4D_FG_INLINE static void linearize(const Pose& pose, const Vec3& landmark, const Intrinsics& k, double zoom,
                                        Vector<2> uv, double* r, double* by_pose, double* by_landmark,
                                        double* by_intrinsics, double* by_zoom) {
    const double scale = std::exp(zoom);
    const Vec3 x = world_to_camera(pose, landmark);
    const Projection p = project_linearized(zoomed(k, scale), x);
    r[0] = uv[0] - p.u;
    r[1] = uv[1] - p.v;
    projection_by_pose(p, x, by_pose);
    projection_by_world_point(p, pose.rotation, by_landmark);
    for (int i = 0; i < 12; ++i) by_pose[i] = -by_pose[i];
    for (int i = 0; i < 6; ++i) by_landmark[i] = -by_landmark[i];
    const double entries[8] = {-scale * p.u_fx, 0.0, -1.0, 0.0, 0.0, -scale * p.v_fy, 0.0, -1.0};
    for (int i = 0; i < 8; ++i) by_intrinsics[i] = entries[i];
    by_zoom[0] = k.cx - p.u;
    by_zoom[1] = k.cy - p.v;
  }

 private:
  UNI4D_FG_INLINE static Intrinsics zoomed(const Intrinsics& k, double scale) {
    return {scale * k.fx, scale * k.fy, k.cx, k.cy};
  }
};
UNI4D_FG_FACTOR_TYPE(ZoomedReprojection)

}  // namespace uni4d_fg
