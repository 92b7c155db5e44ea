// Declaring a factor type. One header in factors/ is all that it takes: the build lists it, Python finds it by name.
//
//     // Point position: r = x - measured; m.
//     #pragma once
//     #include "uni4d_fg/factor_type.hpp"
//
//     namespace uni4d_fg {
//
//     struct PointPosition {
//       static constexpr const char* kName = "point_position";
//       static constexpr int kDim = 3;  // of the residual
//       static constexpr auto kVariables = arguments(argument<Vec3>("point"));
//       static constexpr auto kData = arguments(argument<Vec3>("measured"));
//       static void residual(const Vec3& point, const Vec3& measured, double* r);
//       static void linearize(const Vec3& point, const Vec3& measured, double* r, double* by_point);
//     };
//     UNI4D_FG_FACTOR_TYPE(PointPosition)
//
//     }  // namespace uni4d_fg
//
// Both functions take the variables and then the data of one row. `linearize` writes one Jacobian per variable,
// row-major (kDim, tangent), with respect to the variable's tangent. Both must be UNI4D_FG_INLINE: they are the body of
// a loop that is compiled for several processors.
#pragma once

#include <array>
#include <cstddef>
#include <tuple>

#include "uni4d_fg/camera.hpp"
#include "uni4d_fg/math.hpp"

// Nothing, except in the one source that lists the types.
#ifndef UNI4D_FG_FACTOR_TYPE
#define UNI4D_FG_FACTOR_TYPE(Type)
#endif

namespace uni4d_fg {

/// `size` numbers of a row; the tangent of a variable of this type is their change.
template <int size>
struct Vector {
  const double* numbers;
  UNI4D_FG_INLINE double operator[](int i) const { return numbers[i]; }
  UNI4D_FG_INLINE operator const double*() const { return numbers; }
};

/// How an array holds one value of a type: its numbers, the shape of a row (without the axes of length 0 at the end),
/// the dimension of its tangent, and how to read it. Specialize it for a type of your own.
template <typename T>
struct Stored;

template <>
struct Stored<Pose> {
  static constexpr int kNumbers = 16, kTangent = 6;
  static constexpr std::array<int, 2> kShape{4, 4};
  UNI4D_FG_INLINE static Pose load(const double* row) { return load_pose(row); }
};

template <>
struct Stored<Vec3> {
  static constexpr int kNumbers = 3, kTangent = 3;
  static constexpr std::array<int, 2> kShape{3, 0};
  UNI4D_FG_INLINE static Vec3 load(const double* row) { return load_vec3(row); }
};

template <>
struct Stored<Intrinsics> {
  static constexpr int kNumbers = 4, kTangent = 4;
  static constexpr std::array<int, 2> kShape{4, 0};
  UNI4D_FG_INLINE static Intrinsics load(const double* row) { return load_intrinsics(row); }
};

/// A number: (N, 1) where it is a variable, (N,) where it is a datum.
template <>
struct Stored<double> {
  static constexpr int kNumbers = 1, kTangent = 1;
  static constexpr std::array<int, 2> kShape{1, 0};
  UNI4D_FG_INLINE static double load(const double* row) { return *row; }
};

template <int size>
struct Stored<Vector<size>> {
  static constexpr int kNumbers = size, kTangent = size;
  static constexpr std::array<int, 2> kShape{size, 0};
  UNI4D_FG_INLINE static Vector<size> load(const double* row) { return {row}; }
};

/// One variable or datum: the type as which a row is read, and its name in Python.
template <typename T>
struct Argument {
  using Type = T;
  const char* name;
  bool positive;  ///< Python refuses values that are not above 0.
};

template <typename T>
constexpr Argument<T> argument(const char* name) {
  return {name, false};
}

template <typename T>
constexpr Argument<T> positive_argument(const char* name) {
  return {name, true};
}

template <typename... T>
constexpr std::tuple<Argument<T>...> arguments(Argument<T>... each) {
  return {each...};
}

}  // namespace uni4d_fg
