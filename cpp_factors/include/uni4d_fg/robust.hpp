// Robust kernels rho(s) on the whitened residual norm, and the square-root (IRLS) scaling of a linearised factor.
#pragma once

#include "uni4d_fg/math.hpp"

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

/// sqrt(1 + x) - 1 without cancellation.
UNI4D_FG_INLINE double sqrt1p_minus1(double x) { return x / (std::sqrt(1.0 + x) + 1.0); }

/// rho at the squared norm s^2, for a kind known at compile time: use in loops that should become vector code.
template <KernelKind kind>
UNI4D_FG_INLINE double kernel_rho(double c, double squared) {
  if constexpr (kind == KernelKind::quadratic) return 0.5 * squared;
  if constexpr (kind == KernelKind::huber)
    return squared <= c * c ? 0.5 * squared : c * std::sqrt(squared) - 0.5 * c * c;
  if constexpr (kind == KernelKind::pseudo_huber) return c * c * sqrt1p_minus1(squared / (c * c));
  if constexpr (kind == KernelKind::cauchy) return 0.5 * c * c * std::log1p(squared / (c * c));
  return c * sqrt1p_minus1(squared / (c * c));
}

/// w = rho'(s)/s at s^2, for a kind known at compile time.
template <KernelKind kind>
UNI4D_FG_INLINE double kernel_weight(double c, double squared) {
  if constexpr (kind == KernelKind::quadratic) return 1.0;
  if constexpr (kind == KernelKind::huber) return c / std::sqrt(squared > c * c ? squared : c * c);
  if constexpr (kind == KernelKind::pseudo_huber) return 1.0 / std::sqrt(1.0 + squared / (c * c));
  if constexpr (kind == KernelKind::cauchy) return 1.0 / (1.0 + squared / (c * c));
  return 1.0 / std::sqrt(squared + c * c);
}

UNI4D_FG_INLINE double rho(const Kernel& kernel, double squared) {
  switch (kernel.kind) {
    case KernelKind::huber: return kernel_rho<KernelKind::huber>(kernel.threshold, squared);
    case KernelKind::pseudo_huber: return kernel_rho<KernelKind::pseudo_huber>(kernel.threshold, squared);
    case KernelKind::cauchy: return kernel_rho<KernelKind::cauchy>(kernel.threshold, squared);
    case KernelKind::norm: return kernel_rho<KernelKind::norm>(kernel.threshold, squared);
    default: return 0.5 * squared;
  }
}

UNI4D_FG_INLINE double weight(const Kernel& kernel, double squared) {
  switch (kernel.kind) {
    case KernelKind::huber: return kernel_weight<KernelKind::huber>(kernel.threshold, squared);
    case KernelKind::pseudo_huber: return kernel_weight<KernelKind::pseudo_huber>(kernel.threshold, squared);
    case KernelKind::cauchy: return kernel_weight<KernelKind::cauchy>(kernel.threshold, squared);
    case KernelKind::norm: return kernel_weight<KernelKind::norm>(kernel.threshold, squared);
    default: return 1.0;
  }
}

/// How fast the weight falls along the residual, -s w'(s) / w(s), at most 1: a kernel's curvature is w there without it
/// and w (1 - falloff) with it, where that is not negative.
UNI4D_FG_INLINE double falloff(const Kernel& kernel, double squared) {
  const double ratio = squared / (kernel.threshold * kernel.threshold);
  switch (kernel.kind) {
    case KernelKind::huber: return ratio > 1.0 ? 1.0 : 0.0;
    case KernelKind::cauchy: return ratio < 1.0 ? 2.0 * ratio / (1.0 + ratio) : 1.0;
    case KernelKind::pseudo_huber:
    case KernelKind::norm: return 1.0 - 1.0 / (1.0 + ratio);
    default: return 0.0;
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
