// Robust kernels and residuals of eight records at once.
#pragma once

#include "uni4d_fg/camera.hpp"
#include "uni4d_fg/landmark_plan.hpp"

namespace uni4d_fg {

UNI4D_FG_INLINE Pack pack_weight(const Kernel& kernel, const Pack& squared) {
  const double c = kernel.threshold;
  switch (kernel.kind) {
    case KernelKind::huber: return c / square_root(larger(squared, broadcast(c * c)));
    case KernelKind::pseudo_huber: return 1.0 / square_root(1.0 + squared / (c * c));
    case KernelKind::cauchy: return 1.0 / (1.0 + squared / (c * c));
    case KernelKind::norm: return 1.0 / square_root(squared + c * c);
    default: return broadcast(1.0);
  }
}

UNI4D_FG_INLINE Pack pack_rho(const Kernel& kernel, const Pack& squared) {
  const double c = kernel.threshold;
  switch (kernel.kind) {
    case KernelKind::huber: {
      const Pack bound = broadcast(c * c);
      return 0.5 * at_most(squared, bound) + c * (square_root(larger(squared, bound)) - c);
    }
    case KernelKind::pseudo_huber: {
      const Pack x = squared / (c * c);
      return c * c * (x / (square_root(1.0 + x) + 1.0));
    }
    case KernelKind::cauchy: {
      Pack out;
      for (int i = 0; i < kPackLanes; ++i) out[i] = 0.5 * c * c * std::log1p(squared[i] / (c * c));
      return out;
    }
    case KernelKind::norm: {
      const Pack x = squared / (c * c);
      return c * (x / (square_root(1.0 + x) + 1.0));
    }
    default: return 0.5 * squared;
  }
}

struct PackPoint {
  Pack x, y, z;
};

/// Landmarks of a group's lanes, from (64, 3) coordinates of the chunk.
UNI4D_FG_INLINE PackPoint gather_points(const double* points, const std::uint8_t* lane_landmark) {
  PackPoint out;
  for (int lane = 0; lane < kPackLanes; ++lane) {
    const double* point = points + 3 * lane_landmark[lane];
    out.x[lane] = point[0];
    out.y[lane] = point[1];
    out.z[lane] = point[2];
  }
  return out;
}

/// x = R^T (p - c).
UNI4D_FG_INLINE PackPoint pack_to_camera(const double* world_T_cam, const PackPoint& p) {
  const double* m = world_T_cam;
  const Pack dx = p.x - m[3], dy = p.y - m[7], dz = p.z - m[11];
  return {m[0] * dx + m[4] * dy + m[8] * dz, m[1] * dx + m[5] * dy + m[9] * dz, m[2] * dx + m[6] * dy + m[10] * dz};
}

/// Inverse depth continued by its tangent below the near plane, written without a selection.
struct PackDepth {
  Pack safe;        ///< max(z, near)
  Pack inverse;     ///< 1 / safe: slope of log depth
  Pack below;       ///< min(z - near, 0)
};

UNI4D_FG_INLINE PackDepth pack_depth(const Pack& z) {
  const Pack safe = larger(z, broadcast(kNearPlane));
  return {safe, 1.0 / safe, z - safe};
}

/// g(z) of the camera model.
UNI4D_FG_INLINE Pack pack_inverse_depth(const PackDepth& depth) {
  return depth.inverse - depth.below * (1.0 / (kNearPlane * kNearPlane));
}

UNI4D_FG_INLINE Pack pack_log_depth(const PackDepth& depth) {
  Pack out;
  for (int lane = 0; lane < kPackLanes; ++lane) out[lane] = std::log(depth.safe[lane]);
  return out + depth.below * (1.0 / kNearPlane);
}

UNI4D_FG_INLINE Pack field(const double* data, Field which) { return load_pack(data + which * kPackLanes); }

}  // namespace uni4d_fg
