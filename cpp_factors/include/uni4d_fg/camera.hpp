// The pinhole camera with an inverse depth that is continued by its tangent below the near plane.
#pragma once

#include "uni4d_fg/math.hpp"

namespace uni4d_fg {

/// Depth in meters below which inverse depth and log depth are continued linearly.
constexpr double kNearPlane = 0.02;

/// fx, fy, cx, cy in px.
struct Intrinsics {
  double fx, fy, cx, cy;
};

UNI4D_FG_INLINE Intrinsics load_intrinsics(const double* p) { return {p[0], p[1], p[2], p[3]}; }

/// 1/z, or (2 near - z) / near^2 below the near plane; 1/m.
UNI4D_FG_INLINE double inverse_depth(double z) {
  const double safe = z >= kNearPlane ? z : kNearPlane;
  const double inverse = 1.0 / safe;
  return z >= kNearPlane ? inverse : (2.0 * kNearPlane - z) * (1.0 / (kNearPlane * kNearPlane));
}

/// Derivative of inverse_depth; 1/m^2.
UNI4D_FG_INLINE double inverse_depth_slope(double z) {
  const double safe = z >= kNearPlane ? z : kNearPlane;
  return -1.0 / (safe * safe);
}

/// log(z), continued below the near plane by its tangent.
UNI4D_FG_INLINE double log_depth(double z) {
  return z >= kNearPlane ? std::log(z) : std::log(kNearPlane) + (z / kNearPlane - 1.0);
}

/// Derivative of log_depth; 1/m.
UNI4D_FG_INLINE double log_depth_slope(double z) { return 1.0 / (z >= kNearPlane ? z : kNearPlane); }

struct Pixel {
  double u, v;
};

UNI4D_FG_INLINE Pixel project(const Intrinsics& k, const Vec3& x) {
  const double g = inverse_depth(x.z);
  return {k.fx * x.x * g + k.cx, k.fy * x.y * g + k.cy};
}

/// Lift a pixel with its z-depth (meters) to the camera frame.
UNI4D_FG_INLINE Vec3 unproject(const Intrinsics& k, double u, double v, double depth) {
  return {(u - k.cx) / k.fx * depth, (v - k.cy) / k.fy * depth, depth};
}

/// A projected point and the non-zero entries of its derivatives.
///
///     d u / d x = (u_x, 0, u_z),  d v / d x = (0, v_y, v_z)         px/m
///     d u / d (fx, cx) = (u_fx, 1),  d v / d (fy, cy) = (v_fy, 1)
struct Projection {
  double u, v, u_x, u_z, v_y, v_z, u_fx, v_fy;
};

UNI4D_FG_INLINE Projection project_linearized(const Intrinsics& k, const Vec3& x) {
  const bool in_front = x.z >= kNearPlane;
  const double inverse = 1.0 / (in_front ? x.z : kNearPlane);
  const double g = in_front ? inverse : (2.0 * kNearPlane - x.z) * (1.0 / (kNearPlane * kNearPlane));
  const double slope = -inverse * inverse;
  const double xg = x.x * g, yg = x.y * g;
  return {k.fx * xg + k.cx, k.fy * yg + k.cy, k.fx * g, k.fx * x.x * slope, k.fy * g, k.fy * x.y * slope, xg, yg};
}

/// Derivative of the pixel (u, v) with respect to the observing camera's twist (omega, v), 2x6 row-major.
UNI4D_FG_INLINE void projection_by_pose(const Projection& p, const Vec3& x, double* out) {
  out[0] = -p.u_z * x.y;
  out[1] = p.u_z * x.x - p.u_x * x.z;
  out[2] = p.u_x * x.y;
  out[3] = -p.u_x;
  out[4] = 0.0;
  out[5] = -p.u_z;
  out[6] = p.v_y * x.z - p.v_z * x.y;
  out[7] = p.v_z * x.x;
  out[8] = -p.v_y * x.x;
  out[9] = 0.0;
  out[10] = -p.v_y;
  out[11] = -p.v_z;
}

/// Derivative of the pixel with respect to a world point, 2x3 row-major, for x = R^T (p - c).
UNI4D_FG_INLINE void projection_by_world_point(const Projection& p, const Mat3& rotation, double* out) {
  const Vec3 axis = rotation.column(2);
  store(p.u_x * rotation.column(0) + p.u_z * axis, out);
  store(p.v_y * rotation.column(1) + p.v_z * axis, out + 3);
}

}  // namespace uni4d_fg
