// Depth prior: r = log z - log depth - log_scale, log continued by its tangent below the near plane; dimensionless.
#pragma once

#include "uni4d_fg/camera.hpp"

namespace uni4d_fg::depth_prior {

constexpr int kDim = 1;

/// r (1) of a point (world, m), the logarithm of the depth cue and the frame's log-scale.
UNI4D_FG_INLINE void residual(const Pose& pose, const Vec3& point, double log_scale, double log_cue, double* r) {
  r[0] = log_depth(dot(pose.rotation.column(2), point - pose.center)) - log_cue - log_scale;
}

/// r (1) and d r / d pose (1x6), point (1x3), log-scale (1).
UNI4D_FG_INLINE void linearize(const Pose& pose, const Vec3& point, double log_scale, double log_cue, double* r,
                               double* by_pose, double* by_point, double* by_log_scale) {
  const Vec3 x = world_to_camera(pose, point);
  const double slope = log_depth_slope(x.z);
  r[0] = log_depth(x.z) - log_cue - log_scale;
  by_pose[0] = -x.y * slope;
  by_pose[1] = x.x * slope;
  by_pose[2] = by_pose[3] = by_pose[4] = 0.0;
  by_pose[5] = -slope;
  store(slope * pose.rotation.column(2), by_point);
  by_log_scale[0] = -1.0;
}

/// r (1) and d r / d point (1x3), camera and log-scale frozen.
UNI4D_FG_INLINE void linearize_point(const Pose& pose, const Vec3& point, double log_scale, double log_cue, double* r,
                                     double* by_point) {
  const Vec3 axis = pose.rotation.column(2);
  const double z = dot(axis, point - pose.center);
  r[0] = log_depth(z) - log_cue - log_scale;
  store(log_depth_slope(z) * axis, by_point);
}

}  // namespace uni4d_fg::depth_prior
