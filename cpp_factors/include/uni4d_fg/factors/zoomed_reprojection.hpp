// Reprojection of a camera that zooms: r = uv - project((e^l fx, e^l fy, cx, cy), R^T (p - c)), px.
#pragma once

#include <cmath>

#include "uni4d_fg/factor_type.hpp"
#include "uni4d_fg/factors/static_reprojection.hpp"

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
    StaticReprojection::residual(pose, landmark, zoomed(k, std::exp(zoom)), uv, r);
  }

  /// r (2) and d r / d pose (2x6), landmark (2x3), intrinsics (2x4), zoom (2), row-major.
  UNI4D_FG_INLINE static void linearize(const Pose& pose, const Vec3& landmark, const Intrinsics& k, double zoom,
                                        Vector<2> uv, double* r, double* by_pose, double* by_landmark,
                                        double* by_intrinsics, double* by_zoom) {
    const double scale = std::exp(zoom);
    StaticReprojection::linearize(pose, landmark, zoomed(k, scale), uv, r, by_pose, by_landmark, by_intrinsics);
    by_intrinsics[0] *= scale;
    by_intrinsics[5] *= scale;
    by_zoom[0] = k.fx * by_intrinsics[0];
    by_zoom[1] = k.fy * by_intrinsics[5];
  }

 private:
  UNI4D_FG_INLINE static Intrinsics zoomed(const Intrinsics& k, double scale) {
    return {scale * k.fx, scale * k.fy, k.cx, k.cy};
  }
};
UNI4D_FG_FACTOR_TYPE(ZoomedReprojection)

}  // namespace uni4d_fg
