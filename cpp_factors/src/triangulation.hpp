// Points from rays: each track is one point, refined by a few Gauss-Newton steps, tracks apart from each other.
//
// `cues/structure/triangulation.py` is the same in NumPy, and says what it is for. Sums are taken in the order of the
// rays and operations in that of the formulas there: results are the same, and do not depend on the number of threads.
#pragma once

#include <cstdint>
#include <vector>

namespace uni4d_fg {

/// Poses (T, 4, 4), camera to world, and one camera's fx, fy, cx, cy.
struct PosedCameras {
  const double* world_T_cam = nullptr;
  const double* origin = nullptr;  ///< (T, 3) the world's origin in each camera
  const double* intrinsics = nullptr;
};

/// N rays of M tracks: the track, the camera and the pixel of each.
struct TrackRays {
  const std::int64_t* row = nullptr;
  const std::int64_t* frame = nullptr;
  const double* uv = nullptr;
  int size = 0;
};

/// The rays of each track, in their order: those of track m are ray(i) for start[m] <= i < start[m + 1].
class RaysByTrack {
 public:
  RaysByTrack(const std::int64_t* row, int size, int tracks);
  int begin(int track) const { return start_[static_cast<std::size_t>(track)]; }
  int end(int track) const { return start_[static_cast<std::size_t>(track) + 1]; }
  int ray(int i) const { return order_.empty() ? i : order_[static_cast<std::size_t>(i)]; }

 private:
  std::vector<int> start_, order_;  // no order where the rays come track by track
};

/// When the refinement of a point ends, and from which reprojection error on (px) an observation counts less.
struct RefinementSettings {
  int steps = 0;
  double huber_px = 1.0;
  double converged = 0.0;  ///< step, as a part of the distance from the nearest camera
  double ridge = 0.0;      ///< part of the trace that makes a matrix safe to invert
};

/// What is known of M points; `position` (M, 3) is where they start, NaN where nowhere, and where they end.
struct RefinedPoints {
  double *position, *information, *angle, *error;  ///< (M, 3), (M, 3, 3), (M,), (M,)
};

/// Normal equations (M, 3, 3), (M, 3) of the points nearest to all rays of their tracks.
void ray_equations(const TrackRays& rays, const PosedCameras& cameras, int tracks, double* matrix, double* right);

/// Refine points, forget those behind a camera, and tell their angles and (lower) median errors.
void refine_points(const TrackRays& rays, const PosedCameras& cameras, int tracks, const RefinementSettings& settings,
                   int threads, const RefinedPoints& out);

/// Angles (M,) under which points see their cameras, NaN where there is no point or ray.
void ray_angles(const TrackRays& rays, const PosedCameras& cameras, const double* position, int tracks, double* angle);

/// Reprojection error of every ray of points (M, 3), infinite without a point or behind the camera.
void reprojection_errors(const TrackRays& rays, const PosedCameras& cameras, const double* position, double* error);

}  // namespace uni4d_fg
