// Camera position: r = c - measured, c the camera's center in the world; m.
#pragma once

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg {

struct CameraPosition {
  static constexpr const char* kName = "camera_position";
  static constexpr int kDim = 3;
  static constexpr auto kVariables = arguments(argument<Pose>("world_T_cam"));
  static constexpr auto kData = arguments(argument<Vec3>("measured"));

  UNI4D_FG_INLINE static void residual(const Pose& pose, const Vec3& measured, double* r) {
    store(pose.center - measured, r);
  }

  /// r (3) and d r / d pose (3x6): the twist (omega, v) of the body moves the center by R v.
  UNI4D_FG_INLINE static void linearize(const Pose& pose, const Vec3& measured, double* r, double* by_pose) {
    residual(pose, measured, r);
    for (int row = 0; row < 3; ++row)
      for (int column = 0; column < 3; ++column) {
        by_pose[6 * row + column] = 0.0;
        by_pose[6 * row + 3 + column] = pose.rotation(row, column);
      }
  }
};
UNI4D_FG_FACTOR_TYPE(CameraPosition)

}  // namespace uni4d_fg
