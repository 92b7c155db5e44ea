// Robust kernels rho(s) on the whitened residual norm, and the square-root (IRLS) scaling of a linearized factor.
#pragma once

#include <type_traits>

#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

/// The codes are part of the Python interface.
enum class KernelKind : int { quadratic = 0, huber = 1, pseudo_huber = 2, cauchy = 3, norm = 4 };
constexpr int kKernelKinds = 5;

/// A robust kernel with threshold c in whitened units.
///
///     quadratic     s^2/2                           w = 1
///     huber         s^2/2 | c s - c^2/2             w = min(1, c/s)
///     pseudo_huber  c^2 (sqrt(1 + (s/c)^2) - 1)     w = 1/sqrt(1 + (s/c)^2)
///     cauchy        c^2/2 log(1 + (s/c)^2)          w = 1/(1 + (s/c)^2)
///     norm          sqrt(s^2 + c^2) - c             w = 1/sqrt(s^2 + c^2)
struct Kernel {
  KernelKind kind = KernelKind::quadratic;
  double threshold = 1.0;
};

// Each formula is written once, for Real = double and Real = Simd8, without a branch.

/// sqrt(1 + x) - 1 without cancellation.
template <typename Real>
UNI4D_FG_INLINE Real sqrt1p_minus1(const Real& x) {
  return x / (square_root(1.0 + x) + 1.0);
}

/// rho at the squared norm s^2, for a kind known at compile time: use in loops that should become vector code.
template <KernelKind kind, typename Real>
UNI4D_FG_INLINE Real kernel_rho(double c, const Real& squared) {
  if constexpr (kind == KernelKind::huber)
    return 0.5 * at_most(squared, c * c) + c * (square_root(larger(squared, c * c)) - c);
  else if constexpr (kind == KernelKind::pseudo_huber)
    return c * c * sqrt1p_minus1<Real>(squared / (c * c));
  else if constexpr (kind == KernelKind::cauchy)
    return 0.5 * c * c * log_one_plus(squared / (c * c));
  else if constexpr (kind == KernelKind::norm)
    return c * sqrt1p_minus1<Real>(squared / (c * c));
  else
    return 0.5 * squared;
}

/// w = rho'(s)/s at s^2, for a kind known at compile time.
template <KernelKind kind, typename Real>
UNI4D_FG_INLINE Real kernel_weight(double c, const Real& squared) {
  if constexpr (kind == KernelKind::huber)
    return c / square_root(larger(squared, c * c));
  else if constexpr (kind == KernelKind::pseudo_huber)
    return 1.0 / square_root(1.0 + squared / (c * c));
  else if constexpr (kind == KernelKind::cauchy)
    return 1.0 / (1.0 + squared / (c * c));
  else if constexpr (kind == KernelKind::norm)
    return 1.0 / square_root(squared + c * c);
  else
    return Real{} + 1.0;
}

template <typename Real>
UNI4D_FG_INLINE Real rho(const Kernel& kernel, const Real& squared) {
  const double c = kernel.threshold;
  switch (kernel.kind) {
    case KernelKind::huber:
      if constexpr (std::is_same_v<Real, double>) {
        if (!(squared > c * c)) return 0.5 * squared;  // most residuals, which need no root
      }
      return kernel_rho<KernelKind::huber>(c, squared);
    case KernelKind::pseudo_huber:
      return kernel_rho<KernelKind::pseudo_huber>(c, squared);
    case KernelKind::cauchy:
      return kernel_rho<KernelKind::cauchy>(c, squared);
    case KernelKind::norm:
      return kernel_rho<KernelKind::norm>(c, squared);
    default:
      return kernel_rho<KernelKind::quadratic>(c, squared);
  }
}

template <typename Real>
UNI4D_FG_INLINE Real weight(const Kernel& kernel, const Real& squared) {
  const double c = kernel.threshold;
  switch (kernel.kind) {
    case KernelKind::huber:
      return kernel_weight<KernelKind::huber>(c, squared);
    case KernelKind::pseudo_huber:
      return kernel_weight<KernelKind::pseudo_huber>(c, squared);
    case KernelKind::cauchy:
      return kernel_weight<KernelKind::cauchy>(c, squared);
    case KernelKind::norm:
      return kernel_weight<KernelKind::norm>(c, squared);
    default:
      return kernel_weight<KernelKind::quadratic>(c, squared);
  }
}

/// How fast the weight falls along the residual, -s w'(s) / w(s), at most 1: a kernel's curvature is w there without it
/// and w (1 - falloff) with it, where that is not negative.
template <typename Real>
UNI4D_FG_INLINE Real falloff(const Kernel& kernel, const Real& squared) {
  const Real ratio = squared / (kernel.threshold * kernel.threshold);
  switch (kernel.kind) {
    case KernelKind::huber:
      return is_above(ratio, 1.0);
    case KernelKind::cauchy:
      return at_most(2.0 * ratio / (1.0 + ratio), 1.0);
    case KernelKind::pseudo_huber:
    case KernelKind::norm:
      return 1.0 - 1.0 / (1.0 + ratio);
    default:
      return Real{};
  }
}

/// Whiten a residual in place and return its squared norm. `inverse_sigma` has `dim` entries.
template <int dim>
UNI4D_FG_INLINE double whiten(double* r, const double* inverse_sigma) {
  double squared = 0.0;
  for (int i = 0; i < dim; ++i) {
    r[i] *= inverse_sigma[i];
    squared += r[i] * r[i];
  }
  return squared;
}

/// Factor sqrt(factor_weight * w(s)) that scales the whitened residual and its Jacobian rows (IRLS).
UNI4D_FG_INLINE double irls_scale(const Kernel& kernel, double factor_weight, double squared) {
  return std::sqrt(factor_weight * weight(kernel, squared));
}

}  // namespace uni4d_fg
