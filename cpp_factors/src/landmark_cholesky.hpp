// Cholesky factors of the landmarks' damped 3x3 blocks, L L^T = V + damping D.
//
// A factor is stored as six numbers: 1/l00, l10, 1/l11, l20, l21, 1/l22.
#pragma once

#include <algorithm>
#include <cmath>

#include "uni4d_fg/landmark_system.hpp"

namespace uni4d_fg::landmark_cholesky {

/// Entry of the damping diagonal D for an entry of the Hessian's diagonal.
inline double clamp(double diagonal, const DampingBounds& bounds) {
  return std::min(std::max(diagonal, bounds.min_diagonal), bounds.max_diagonal);
}

/// Cholesky factor of V + damping, V as xx xy xz yy yz zz; false unless positive definite.
inline bool factorize(const double* v, const DampingBounds& bounds, double* out) {
  const double d = bounds.damping;
  const double xx = v[0] + d * clamp(v[0], bounds), yy = v[3] + d * clamp(v[3], bounds),
               zz = v[5] + d * clamp(v[5], bounds);
  if (!(xx > 0.0)) return false;
  const double l00 = std::sqrt(xx), l10 = v[1] / l00, l20 = v[2] / l00;
  const double second = yy - l10 * l10;
  if (!(second > 0.0)) return false;
  const double l11 = std::sqrt(second), l21 = (v[4] - l20 * l10) / l11;
  const double third = zz - l20 * l20 - l21 * l21;
  if (!(third > 0.0)) return false;
  out[0] = 1.0 / l00;
  out[1] = l10;
  out[2] = 1.0 / l11;
  out[3] = l20;
  out[4] = l21;
  out[5] = 1.0 / std::sqrt(third);
  return true;
}

/// x <- L^{-1} x.
inline void solve_lower(const double* f, double* x) {
  x[0] *= f[0];
  x[1] = (x[1] - f[1] * x[0]) * f[2];
  x[2] = (x[2] - f[3] * x[0] - f[4] * x[1]) * f[5];
}

/// x <- L^{-T} x.
inline void solve_upper(const double* f, double* x) {
  x[2] *= f[5];
  x[1] = (x[1] - f[4] * x[2]) * f[2];
  x[0] = (x[0] - f[1] * x[1] - f[3] * x[2]) * f[0];
}

}  // namespace uni4d_fg::landmark_cholesky
