// Depth reprojection of a frame pair: r = uv_target - project(K, T_target^{-1} T_source unproject(K, uv_source, d)).
#pragma once

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg::depth_reprojection {

/// r (2) px; `target_T_source` is relative_pose(target, source).
UNI4D_FG_INLINE void residual(const Pose& target_T_source, const Intrinsics& k, const double* uv_source, double depth,
                              const double* uv_target, double* r) {
  const Vec3 x_source = unproject(k, uv_source[0], uv_source[1], depth);
  const Pixel pixel = project(k, camera_to_world(target_T_source, x_source));
  r[0] = uv_target[0] - pixel.u;
  r[1] = uv_target[1] - pixel.v;
}

/// r (2) and d r / d target pose (2x6) and intrinsics (2x4), row-major. The Jacobian of the source pose is
/// -J_target Ad(target_T_source).
UNI4D_FG_INLINE void linearize_target(const Pose& target_T_source, const Intrinsics& k, const double* uv_source,
                                      double depth, const double* uv_target, double* r, double* by_target,
                                      double* by_intrinsics) {
  const Vec3 x_source = unproject(k, uv_source[0], uv_source[1], depth);
  const Vec3 x = camera_to_world(target_T_source, x_source);
  const Projection p = project_linearized(k, x);
  r[0] = uv_target[0] - p.u;
  r[1] = uv_target[1] - p.v;
  projection_by_pose(p, x, by_target);
  for (int i = 0; i < 12; ++i) by_target[i] = -by_target[i];
  // Derivative by x_source, columns 0 and 1: the lifted ray moves with the intrinsics.
  const Mat3& rotation = target_T_source.rotation;
  const double u_0 = p.u_x * rotation(0, 0) + p.u_z * rotation(2, 0),
               u_1 = p.u_x * rotation(0, 1) + p.u_z * rotation(2, 1);
  const double v_0 = p.v_y * rotation(1, 0) + p.v_z * rotation(2, 0),
               v_1 = p.v_y * rotation(1, 1) + p.v_z * rotation(2, 1);
  const double x_fx = x_source.x / k.fx, y_fy = x_source.y / k.fy, d_fx = depth / k.fx, d_fy = depth / k.fy;
  by_intrinsics[0] = u_0 * x_fx - p.u_fx;
  by_intrinsics[1] = u_1 * y_fy;
  by_intrinsics[2] = u_0 * d_fx - 1.0;
  by_intrinsics[3] = u_1 * d_fy;
  by_intrinsics[4] = v_0 * x_fx;
  by_intrinsics[5] = v_1 * y_fy - p.v_fy;
  by_intrinsics[6] = v_0 * d_fx;
  by_intrinsics[7] = v_1 * d_fy - 1.0;
}

/// Jacobian of the source pose (2x6) from that of the target pose: -J_target Ad(target_T_source).
UNI4D_FG_INLINE void source_from_target(const Pose& target_T_source, const double* by_target, double* by_source) {
  for (int row = 0; row < 2; ++row) {
    const Vec3 by_omega = load_vec3(by_target + 6 * row), by_v = load_vec3(by_target + 6 * row + 3);
    // Ad = [R 0; skew(c) R  R] in the order (omega, v), so (a, b) Ad = ((a + b x c) R, b R).
    store(-transposed_times(target_T_source.rotation, by_omega + cross(by_v, target_T_source.center)),
          by_source + 6 * row);
    store(-transposed_times(target_T_source.rotation, by_v), by_source + 6 * row + 3);
  }
}

}  // namespace uni4d_fg::depth_reprojection

namespace uni4d_fg {

struct DepthReprojection {
  static constexpr const char* kName = "depth_reprojection";
  static constexpr int kDim = 2;
  static constexpr auto kVariables =
      arguments(argument<Pose>("source_pose"), argument<Pose>("target_pose"), argument<Intrinsics>("intrinsics"));
  static constexpr auto kData =
      arguments(argument<Vector<2>>("uv_source"), positive_argument<double>("depth"), argument<Vector<2>>("uv_target"));

  UNI4D_FG_INLINE static void residual(const Pose& source, const Pose& target, const Intrinsics& k, Vector<2> uv_source,
                                       double depth, Vector<2> uv_target, double* r) {
    depth_reprojection::residual(relative_pose(target, source), k, uv_source, depth, uv_target, r);
  }

  UNI4D_FG_INLINE static void linearize(const Pose& source, const Pose& target, const Intrinsics& k,
                                        Vector<2> uv_source, double depth, Vector<2> uv_target, double* r,
                                        double* by_source, double* by_target, double* by_intrinsics) {
    const Pose relative = relative_pose(target, source);
    depth_reprojection::linearize_target(relative, k, uv_source, depth, uv_target, r, by_target, by_intrinsics);
    depth_reprojection::source_from_target(relative, by_target, by_source);
  }
};
UNI4D_FG_FACTOR_TYPE(DepthReprojection)

}  // namespace uni4d_fg
