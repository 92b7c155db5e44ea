// Point position: r = x - measured; m.
#pragma once

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg {

struct PointPosition {
  static constexpr const char* kName = "point_position";
  static constexpr int kDim = 3;
  static constexpr auto kVariables = arguments(argument<Vec3>("point"));
  static constexpr auto kData = arguments(argument<Vec3>("measured"));

  UNI4D_FG_INLINE static void residual(const Vec3& point, const Vec3& measured, double* r) {
    store(point - measured, r);
  }

  UNI4D_FG_INLINE static void linearize(const Vec3& point, const Vec3& measured, double* r, double* by_point) {
    residual(point, measured, r);
    store_identity(1.0, by_point);
  }
};
UNI4D_FG_FACTOR_TYPE(PointPosition)

}  // namespace uni4d_fg
