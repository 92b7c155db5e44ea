// Depth prior: r = log z - log depth - log_scale, log continued by its tangent below the near plane; dimensionless.
#pragma once

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg::depth_prior {

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

namespace uni4d_fg {

struct StaticDepthPrior {
  static constexpr const char* kName = "static_depth_prior";
  static constexpr int kDim = 1;
  static constexpr auto kVariables =
      arguments(argument<Pose>("world_T_cam"), argument<Vec3>("landmark"), argument<double>("log_scale"));
  static constexpr auto kData = arguments(positive_argument<double>("depth"));

  UNI4D_FG_INLINE static void residual(const Pose& pose, const Vec3& landmark, double log_scale, double depth,
                                       double* r) {
    depth_prior::residual(pose, landmark, log_scale, std::log(depth), r);
  }

  UNI4D_FG_INLINE static void linearize(const Pose& pose, const Vec3& landmark, double log_scale, double depth,
                                        double* r, double* by_pose, double* by_landmark, double* by_log_scale) {
    depth_prior::linearize(pose, landmark, log_scale, std::log(depth), r, by_pose, by_landmark, by_log_scale);
  }
};
UNI4D_FG_FACTOR_TYPE(StaticDepthPrior)

/// The same on a point of one frame, with its camera and log-scale frozen.
struct DynamicDepthPrior {
  static constexpr const char* kName = "dynamic_depth_prior";
  static constexpr int kDim = 1;
  static constexpr auto kVariables = arguments(argument<Vec3>("dynamic_point"));
  static constexpr auto kData =
      arguments(positive_argument<double>("depth"), argument<Pose>("world_T_cam"), argument<double>("log_scale"));

  UNI4D_FG_INLINE static void residual(const Vec3& point, double depth, const Pose& pose, double log_scale, double* r) {
    depth_prior::residual(pose, point, log_scale, std::log(depth), r);
  }

  UNI4D_FG_INLINE static void linearize(const Vec3& point, double depth, const Pose& pose, double log_scale, double* r,
                                        double* by_point) {
    depth_prior::linearize_point(pose, point, log_scale, std::log(depth), r, by_point);
  }
};
UNI4D_FG_FACTOR_TYPE(DynamicDepthPrior)

}  // namespace uni4d_fg
