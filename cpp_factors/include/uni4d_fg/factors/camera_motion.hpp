// Change of the relative camera motion over three poses, relative to its size; dimensionless.
//
//     r = (a - b) / ((|a|_f + |b|_f) / 2),   |v|_f = sqrt(|v|^2 + floor^2)
//     rotation      a = Log(R_before^T R_now),   b = Log(R_now^T R_after)     rad
//     translation   a = c_now - c_before,        b = c_after - c_now          m, world axes
#pragma once

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg::camera_motion {

/// Rotation vector (rad) of a rotation matrix; singular for a half turn.
UNI4D_FG_INLINE Vec3 rotation_log(const Mat3& r) {
  const Vec3 axis = 0.5 * Vec3{r(2, 1) - r(1, 2), r(0, 2) - r(2, 0), r(1, 0) - r(0, 1)};
  const double squared_sine = dot(axis, axis);
  const double cosine = 0.5 * (r(0, 0) + r(1, 1) + r(2, 2) - 1.0);
  if (squared_sine < 1e-14) return (1.0 + squared_sine / 6.0) * axis;
  const double sine = std::sqrt(squared_sine);
  return (std::atan2(sine, cosine) / sine) * axis;
}

/// Jr^{-1} with Log(Exp(omega) Exp(d)) = omega + Jr^{-1} d; the left Jacobian's inverse is its transpose.
UNI4D_FG_INLINE Mat3 inverse_right_jacobian(const Vec3& omega) {
  const double angle = std::sqrt(dot(omega, omega));
  const double coefficient =
      angle < 1e-4 ? 1.0 / 12.0 + angle * angle / 720.0 : (1.0 - 0.5 * angle / std::tan(0.5 * angle)) / (angle * angle);
  const Mat3 w = skew(omega), squared = w * w;
  Mat3 out;
  for (int i = 0; i < 9; ++i) out.m[i] = (i % 4 == 0 ? 1.0 : 0.0) + 0.5 * w.m[i] + coefficient * squared.m[i];
  return out;
}

/// r (3) of the two motions.
UNI4D_FG_INLINE Vec3 relative_change(const Vec3& a, const Vec3& b, double floor) {
  const double norm_a = std::sqrt(dot(a, a) + floor * floor), norm_b = std::sqrt(dot(b, b) + floor * floor);
  return (1.0 / (0.5 * (norm_a + norm_b))) * (a - b);
}

/// r (3), d r / d a and d r / d b.
UNI4D_FG_INLINE Vec3 relative_change(const Vec3& a, const Vec3& b, double floor, Mat3& by_a, Mat3& by_b) {
  const double norm_a = std::sqrt(dot(a, a) + floor * floor), norm_b = std::sqrt(dot(b, b) + floor * floor);
  const double mean = 0.5 * (norm_a + norm_b);
  const Vec3 r = (1.0 / mean) * (a - b);
  const Vec3 slope_a = (0.5 / (norm_a * mean)) * a, slope_b = (0.5 / (norm_b * mean)) * b;
  const double rs[3] = {r.x, r.y, r.z}, sa[3] = {slope_a.x, slope_a.y, slope_a.z},
               sb[3] = {slope_b.x, slope_b.y, slope_b.z};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const double identity = i == j ? 1.0 / mean : 0.0;
      by_a(i, j) = identity - rs[i] * sa[j];
      by_b(i, j) = -identity - rs[i] * sb[j];
    }
  return r;
}

/// Write a 3x3 block into columns `first`.. of a 3x6 Jacobian and zeros into the others.
UNI4D_FG_INLINE void store_half(const Mat3& block, int first, double* out) {
  for (int i = 0; i < 18; ++i) out[i] = 0.0;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) out[6 * i + first + j] = block(i, j);
}

}  // namespace uni4d_fg::camera_motion

namespace uni4d_fg {

struct CameraRotation {
  static constexpr const char* kName = "camera_rotation";
  static constexpr int kDim = 3;
  static constexpr auto kVariables =
      arguments(argument<Pose>("before"), argument<Pose>("now"), argument<Pose>("after"));
  static constexpr auto kData = arguments(positive_argument<double>("floor"));

  UNI4D_FG_INLINE static void residual(const Pose& before, const Pose& now, const Pose& after, double floor,
                                       double* r) {
    using namespace camera_motion;
    const Vec3 a = rotation_log(transposed_times(before.rotation, now.rotation));
    const Vec3 b = rotation_log(transposed_times(now.rotation, after.rotation));
    store(relative_change(a, b, floor), r);
  }

  UNI4D_FG_INLINE static void linearize(const Pose& before, const Pose& now, const Pose& after, double floor, double* r,
                                        double* by_before, double* by_now, double* by_after) {
    using namespace camera_motion;
    const Vec3 a = rotation_log(transposed_times(before.rotation, now.rotation));
    const Vec3 b = rotation_log(transposed_times(now.rotation, after.rotation));
    Mat3 by_a, by_b;
    store(relative_change(a, b, floor, by_a, by_b), r);
    const Mat3 right_a = inverse_right_jacobian(a), right_b = inverse_right_jacobian(b);
    Mat3 first = by_a * transposed(right_a), middle = by_a * right_a;
    const Mat3 middle_b = by_b * transposed(right_b);
    for (int i = 0; i < 9; ++i) {
      first.m[i] = -first.m[i];
      middle.m[i] -= middle_b.m[i];
    }
    store_half(first, 0, by_before);
    store_half(middle, 0, by_now);
    store_half(by_b * right_b, 0, by_after);
  }
};
UNI4D_FG_FACTOR_TYPE(CameraRotation)

struct CameraTranslation {
  static constexpr const char* kName = "camera_translation";
  static constexpr int kDim = 3;
  static constexpr auto kVariables = CameraRotation::kVariables;
  static constexpr auto kData = CameraRotation::kData;

  UNI4D_FG_INLINE static void residual(const Pose& before, const Pose& now, const Pose& after, double floor,
                                       double* r) {
    store(camera_motion::relative_change(now.center - before.center, after.center - now.center, floor), r);
  }

  UNI4D_FG_INLINE static void linearize(const Pose& before, const Pose& now, const Pose& after, double floor, double* r,
                                        double* by_before, double* by_now, double* by_after) {
    using namespace camera_motion;
    Mat3 by_a, by_b;
    store(relative_change(now.center - before.center, after.center - now.center, floor, by_a, by_b), r);
    Mat3 first = by_a * before.rotation, difference;
    for (int i = 0; i < 9; ++i) {
      first.m[i] = -first.m[i];
      difference.m[i] = by_a.m[i] - by_b.m[i];
    }
    store_half(first, 3, by_before);
    store_half(difference * now.rotation, 3, by_now);
    store_half(by_b * after.rotation, 3, by_after);
  }
};
UNI4D_FG_FACTOR_TYPE(CameraTranslation)

}  // namespace uni4d_fg
