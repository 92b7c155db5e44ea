// Reprojection through a lens: r = uv - (fx a + cx, fy b + cy), (a, b) = lens(R^T (p - c)), px.
//
// A camera has fx, fy, cx, cy and four parameters: k1, k2, p1, p2 of the polynomial family, k1 to k4 of the fisheye.
#pragma once

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg {

/// (a, b) of a point in camera axes; its derivatives with respect to the point (2x3) and to the four parameters (2x4).
struct BentPoint {
  double a, b;
  double by_point[2][3];
  double by_parameters[2][4];
};

/// The polynomial model on x / z and y / z, whose inverse depth is continued below the near plane.
struct OpencvLens {
  UNI4D_FG_INLINE static Pixel apply(const double* k, const Vec3& p) {
    const double g = inverse_depth(p.z), x = p.x * g, y = p.y * g, q = x * x + y * y;
    const double radial = 1.0 + q * (k[0] + q * k[1]);
    return {x * radial + 2.0 * k[2] * x * y + k[3] * (q + 2.0 * x * x),
            y * radial + k[2] * (q + 2.0 * y * y) + 2.0 * k[3] * x * y};
  }

  UNI4D_FG_INLINE static BentPoint linearized(const double* k, const Vec3& p) {
    const double g = inverse_depth(p.z), g_z = inverse_depth_slope(p.z);
    const double x = p.x * g, y = p.y * g, q = x * x + y * y, xy = x * y;
    const double radial = 1.0 + q * (k[0] + q * k[1]), slope = 2.0 * (k[0] + 2.0 * q * k[1]);
    const double x_x = radial + x * x * slope + 2.0 * k[2] * y + 6.0 * k[3] * x;
    const double x_y = xy * slope + 2.0 * k[2] * x + 2.0 * k[3] * y;
    const double y_y = radial + y * y * slope + 6.0 * k[2] * y + 2.0 * k[3] * x;
    const Pixel bent = apply(k, p);
    return {bent.u,
            bent.v,
            {{x_x * g, x_y * g, (x_x * p.x + x_y * p.y) * g_z}, {x_y * g, y_y * g, (x_y * p.x + y_y * p.y) * g_z}},
            {{x * q, x * q * q, 2.0 * xy, q + 2.0 * x * x}, {y * q, y * q * q, q + 2.0 * y * y, 2.0 * xy}}};
  }
};

/// The fisheye model on the angle from the axis; points may be beside the camera and behind it, except on the axis.
struct FisheyeLens {
  /// Square of the radius over that of z below which quotients are replaced by their limits.
  static constexpr double kOnAxis = 1e-8;

  UNI4D_FG_INLINE static double polynomial(const double* k, double t2) {
    return 1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])));
  }

  UNI4D_FG_INLINE static Pixel apply(const double* k, const Vec3& p) {
    const double square = p.x * p.x + p.y * p.y;
    if (square < kOnAxis * p.z * p.z) return {p.x / p.z, p.y / p.z};
    const double radius = std::sqrt(square), theta = std::atan2(radius, p.z);
    const double scale = theta * polynomial(k, theta * theta) / radius;
    return {p.x * scale, p.y * scale};
  }

  UNI4D_FG_INLINE static BentPoint linearized(const double* k, const Vec3& p) {
    const double square = p.x * p.x + p.y * p.y, distance = square + p.z * p.z;
    double scale, bend, slope = 1.0, powers[4] = {};  // d scale / d x = x bend
    if (square < kOnAxis * p.z * p.z) {
      scale = 1.0 / p.z;
      bend = (2.0 * k[0] - 2.0 / 3.0) / (p.z * p.z * p.z);
    } else {
      const double radius = std::sqrt(square), theta = std::atan2(radius, p.z), t2 = theta * theta;
      double power = t2;
      for (int i = 0; i < 4; ++i, power *= t2) {
        slope += (2 * i + 3) * k[i] * power;
        powers[i] = theta * power / radius;
      }
      scale = theta * polynomial(k, t2) / radius;
      bend = (slope * p.z / distance - scale) / square;
    }
    const double xy = p.x * p.y * bend;
    BentPoint out{p.x * scale,
                  p.y * scale,
                  {{scale + p.x * p.x * bend, xy, -p.x * slope / distance},
                   {xy, scale + p.y * p.y * bend, -p.y * slope / distance}},
                  {}};
    for (int i = 0; i < 4; ++i) {
      out.by_parameters[0][i] = p.x * powers[i];
      out.by_parameters[1][i] = p.y * powers[i];
    }
    return out;
  }
};

template <typename Lens>
struct LensReprojection {
  static constexpr int kDim = 2;
  static constexpr auto kVariables =
      arguments(argument<Pose>("world_T_cam"), argument<Vec3>("landmark"), argument<Vector<8>>("camera"));
  static constexpr auto kData = arguments(argument<Vector<2>>("uv"));

  /// r (2) of a landmark (world, m) seen at pixel uv.
  UNI4D_FG_INLINE static void residual(const Pose& pose, const Vec3& landmark, Vector<8> camera, Vector<2> uv,
                                       double* r) {
    const Pixel bent = Lens::apply(camera + 4, world_to_camera(pose, landmark));
    r[0] = uv[0] - (camera[0] * bent.u + camera[2]);
    r[1] = uv[1] - (camera[1] * bent.v + camera[3]);
  }

  /// r (2) and d r / d pose (2x6), landmark (2x3), camera (2x8), row-major.
  UNI4D_FG_INLINE static void linearize(const Pose& pose, const Vec3& landmark, Vector<8> camera, Vector<2> uv,
                                        double* r, double* by_pose, double* by_landmark, double* by_camera) {
    const Vec3 x = world_to_camera(pose, landmark);
    const BentPoint bent = Lens::linearized(camera + 4, x);
    const double plane[2] = {bent.a, bent.b};
    for (int i = 0; i < 2; ++i) {
      const double focal = camera[i];
      r[i] = uv[i] - (focal * plane[i] + camera[2 + i]);
      // x = R^T (p - c): d x / d (omega, v) = [skew(x), -I], and row skew(x) = row cross x.
      const Vec3 row = focal * load_vec3(bent.by_point[i]);
      store(-cross(row, x), by_pose + 6 * i);
      store(row, by_pose + 6 * i + 3);
      store(-(pose.rotation * row), by_landmark + 3 * i);
      double* camera_row = by_camera + 8 * i;
      for (int k = 0; k < 4; ++k) camera_row[k] = 0.0;
      camera_row[i] = -plane[i];
      camera_row[2 + i] = -1.0;
      for (int k = 0; k < 4; ++k) camera_row[4 + k] = -focal * bent.by_parameters[i][k];
    }
  }
};

struct OpencvReprojection : LensReprojection<OpencvLens> {
  static constexpr const char* kName = "opencv_reprojection";
};
UNI4D_FG_FACTOR_TYPE(OpencvReprojection)

struct FisheyeReprojection : LensReprojection<FisheyeLens> {
  static constexpr const char* kName = "fisheye_reprojection";
};
UNI4D_FG_FACTOR_TYPE(FisheyeReprojection)

}  // namespace uni4d_fg
