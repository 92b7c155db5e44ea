// Fixed-size vectors, matrices and rigid transforms, all row-major.
#pragma once

#include <cmath>

#if defined(__GNUC__) || defined(__clang__)
#define UNI4D_FG_INLINE inline __attribute__((always_inline))
#else
#define UNI4D_FG_INLINE inline
#endif

// A hot function marked so is compiled twice, and the processor decides at load time which one runs. Everything it
// calls in its loop must be UNI4D_FG_INLINE, or it is compiled for the oldest processor only.
#if defined(__GNUC__) && __GNUC__ >= 12 && !defined(__clang__) && defined(__x86_64__) && defined(__linux__) && \
    !defined(UNI4D_FG_NO_CLONES)
#define UNI4D_FG_CLONES __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define UNI4D_FG_CLONES
#endif

namespace uni4d_fg {

// Numbers and SIMD values (simd.hpp) share the names of these operations, so that formulas are written once for both.

/// Larger of a value and a bound; the bound where the value is NaN.
UNI4D_FG_INLINE double larger(double value, double bound) { return value > bound ? value : bound; }
/// Smaller of a value and a bound; the value where it is NaN.
UNI4D_FG_INLINE double at_most(double value, double bound) { return bound < value ? bound : value; }
/// 1 where a value lies above a bound, else 0.
UNI4D_FG_INLINE double is_above(double value, double bound) { return value > bound ? 1.0 : 0.0; }
UNI4D_FG_INLINE double square_root(double a) { return std::sqrt(a); }
/// log(1 + a).
UNI4D_FG_INLINE double log_one_plus(double a) { return std::log1p(a); }

struct Vec3 {
  double x, y, z;
};

UNI4D_FG_INLINE Vec3 load_vec3(const double* p) { return {p[0], p[1], p[2]}; }
UNI4D_FG_INLINE Vec3 operator+(const Vec3& a, const Vec3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
UNI4D_FG_INLINE Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
UNI4D_FG_INLINE Vec3 operator-(const Vec3& a) { return {-a.x, -a.y, -a.z}; }
UNI4D_FG_INLINE Vec3 operator*(double s, const Vec3& a) { return {s * a.x, s * a.y, s * a.z}; }
UNI4D_FG_INLINE double dot(const Vec3& a, const Vec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
UNI4D_FG_INLINE Vec3 cross(const Vec3& a, const Vec3& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
UNI4D_FG_INLINE void store(const Vec3& a, double* out) {
  out[0] = a.x;
  out[1] = a.y;
  out[2] = a.z;
}

/// 3x3 matrix, row-major.
struct Mat3 {
  double m[9];
  UNI4D_FG_INLINE double operator()(int row, int column) const { return m[3 * row + column]; }
  UNI4D_FG_INLINE double& operator()(int row, int column) { return m[3 * row + column]; }
  UNI4D_FG_INLINE Vec3 row(int i) const { return {m[3 * i], m[3 * i + 1], m[3 * i + 2]}; }
  UNI4D_FG_INLINE Vec3 column(int j) const { return {m[j], m[3 + j], m[6 + j]}; }
};

/// A v.
UNI4D_FG_INLINE Vec3 operator*(const Mat3& a, const Vec3& v) {
  return {dot(a.row(0), v), dot(a.row(1), v), dot(a.row(2), v)};
}

/// A^T v, which is also (v^T A)^T.
UNI4D_FG_INLINE Vec3 transposed_times(const Mat3& a, const Vec3& v) {
  return {dot(a.column(0), v), dot(a.column(1), v), dot(a.column(2), v)};
}

UNI4D_FG_INLINE Mat3 operator*(const Mat3& a, const Mat3& b) {
  Mat3 out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) out(i, j) = a(i, 0) * b(0, j) + a(i, 1) * b(1, j) + a(i, 2) * b(2, j);
  return out;
}

/// A^T B.
UNI4D_FG_INLINE Mat3 transposed_times(const Mat3& a, const Mat3& b) {
  Mat3 out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) out(i, j) = a(0, i) * b(0, j) + a(1, i) * b(1, j) + a(2, i) * b(2, j);
  return out;
}

UNI4D_FG_INLINE Mat3 transposed(const Mat3& a) {
  return {{a(0, 0), a(1, 0), a(2, 0), a(0, 1), a(1, 1), a(2, 1), a(0, 2), a(1, 2), a(2, 2)}};
}

/// out = scale * identity (3x3).
UNI4D_FG_INLINE void store_identity(double scale, double* out) {
  for (int i = 0; i < 9; ++i) out[i] = i % 4 == 0 ? scale : 0.0;
}

/// Places of the diagonal in the six values of a symmetric 3x3 matrix: xx, xy, xz, yy, yz, zz.
constexpr int kDiagonal[3] = {0, 3, 5};

/// out += S v for a symmetric 3x3 matrix of six values: xx, xy, xz, yy, yz, zz.
UNI4D_FG_INLINE void add_symmetric_product(const double* s, const double* v, double* out) {
  out[0] += s[0] * v[0] + s[1] * v[1] + s[2] * v[2];
  out[1] += s[1] * v[0] + s[3] * v[1] + s[4] * v[2];
  out[2] += s[2] * v[0] + s[4] * v[1] + s[5] * v[2];
}

/// Matrix of the cross product, skew(v) w = v x w.
UNI4D_FG_INLINE Mat3 skew(const Vec3& v) { return {{0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0}}; }

/// world_T_cam: rotation and camera center (meters). Tangent: body-frame twist (omega, v), T <- T Exp(omega, v).
struct Pose {
  Mat3 rotation;
  Vec3 center;
};

/// Read a row-major 4x4 matrix.
UNI4D_FG_INLINE Pose load_pose(const double* p) {
  return {{{p[0], p[1], p[2], p[4], p[5], p[6], p[8], p[9], p[10]}}, {p[3], p[7], p[11]}};
}

/// R x + c.
UNI4D_FG_INLINE Vec3 camera_to_world(const Pose& pose, const Vec3& x) { return pose.rotation * x + pose.center; }

/// R^T (p - c).
UNI4D_FG_INLINE Vec3 world_to_camera(const Pose& pose, const Vec3& p) {
  return transposed_times(pose.rotation, p - pose.center);
}

/// target^{-1} source: moves a point from the source camera to the target camera.
UNI4D_FG_INLINE Pose relative_pose(const Pose& target, const Pose& source) {
  return {transposed_times(target.rotation, source.rotation), world_to_camera(target, source.center)};
}

}  // namespace uni4d_fg
