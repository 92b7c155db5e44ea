#include "triangulation.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "uni4d_fg/camera.hpp"
#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

namespace {

constexpr int kGrain = 256;
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kShortest = 1e-12;

// Where an argument is NaN, so is the result, as with NumPy.
double lesser(double a, double b) { return std::isnan(a) || a < b ? a : b; }
double larger(double a, double b) { return std::isnan(a) || a > b ? a : b; }

const double* pose_of(const PosedCameras& cameras, std::int64_t frame) { return cameras.world_T_cam + 16 * frame; }

double inverse_of(double z) { return z >= kNearPlane ? 1.0 / z : (2.0 * kNearPlane - z) / (kNearPlane * kNearPlane); }

/// Point in the axes of its camera, from the camera's center.
void seen_from(const double* pose, const double* point, double* out) {
  const double d[3] = {point[0] - pose[3], point[1] - pose[7], point[2] - pose[11]};
  for (int i = 0; i < 3; ++i) out[i] = pose[i] * d[0] + pose[4 + i] * d[1] + pose[8 + i] * d[2];
}

double error_of(const double* k, const double* x, const double* uv) {
  const double g = inverse_of(x[2]);
  return std::hypot(uv[0] - (k[0] * x[0] * g + k[2]), uv[1] - (k[1] * x[1] * g + k[3]));
}

struct Equations {
  double hessian[6], gradient[3];  // the lower triangle, row by row
  double nearest;                  // distance of the nearest camera
};

/// J'WJ, J'Wr and the distance of a point from its nearest camera.
Equations equations_of(const TrackRays& rays, const RaysByTrack& by_track, const PosedCameras& cameras, int track,
                       const double* point, double huber_px) {
  Equations out{{}, {}, std::numeric_limits<double>::infinity()};
  const double fx = cameras.intrinsics[0], fy = cameras.intrinsics[1];
  const double cx = cameras.intrinsics[2], cy = cameras.intrinsics[3];
  for (int at = by_track.begin(track); at < by_track.end(track); ++at) {
    const int n = by_track.ray(at);
    const double* r = pose_of(cameras, rays.frame[n]);
    const double* origin = cameras.origin + 3 * rays.frame[n];
    double x[3];
    for (int i = 0; i < 3; ++i) x[i] = r[i] * point[0] + r[4 + i] * point[1] + r[8 + i] * point[2] + origin[i];
    out.nearest = lesser(x[0] * x[0] + x[1] * x[1] + x[2] * x[2], out.nearest);
    const double g = inverse_of(x[2]), safe = x[2] >= kNearPlane ? x[2] : kNearPlane, slope = -1.0 / (safe * safe);
    const double off_u = rays.uv[2 * n] - (fx * x[0] * g + cx), off_v = rays.uv[2 * n + 1] - (fy * x[1] * g + cy);
    const double weight = 1.0 / larger(std::hypot(off_u, off_v) / huber_px, 1.0);
    const double along_u = fx * x[0] * slope, along_v = fy * x[1] * slope;
    double by_u[3], by_v[3];
    for (int a = 0; a < 3; ++a) {
      by_u[a] = fx * g * r[4 * a] + along_u * r[4 * a + 2];
      by_v[a] = fy * g * r[4 * a + 1] + along_v * r[4 * a + 2];
    }
    for (int a = 0, k = 0; a < 3; ++a) {
      const double u = weight * by_u[a], v = weight * by_v[a];
      out.gradient[a] += u * off_u + v * off_v;
      for (int b = 0; b <= a; ++b, ++k) out.hessian[k] += u * by_u[b] + v * by_v[b];
    }
  }
  out.nearest = std::sqrt(out.nearest);
  return out;
}

/// Solve a system by the factors L D L', with a ridge on its diagonal.
void solve(const Equations& e, double ridge, double* out) {
  const double pad = ridge * (e.hessian[0] + e.hessian[2] + e.hessian[5]) + 1e-12;
  const double d0 = e.hessian[0] + pad, m10 = e.hessian[1], m20 = e.hessian[3];
  const double l10 = m10 / d0, l20 = m20 / d0;
  const double d1 = e.hessian[2] + pad - l10 * m10;
  const double l21 = (e.hessian[4] - l20 * m10) / d1;
  const double d2 = e.hessian[5] + pad - l20 * m20 - l21 * l21 * d1;
  const double y1 = e.gradient[1] - l10 * e.gradient[0];
  const double y2 = e.gradient[2] - l20 * e.gradient[0] - l21 * y1;
  out[2] = y2 / d2;
  out[1] = y1 / d1 - l21 * out[2];
  out[0] = e.gradient[0] / d0 - l10 * out[1] - l20 * out[2];
}

void refine(const TrackRays& rays, const RaysByTrack& by_track, const PosedCameras& cameras, int track,
            const RefinementSettings& settings, double* point, double* information) {
  for (int step = 0; step < settings.steps; ++step) {
    const Equations e = equations_of(rays, by_track, cameras, track, point, settings.huber_px);
    double by[3];
    solve(e, settings.ridge, by);
    // A step longer than the distance to the cameras leads nowhere.
    const double length = std::sqrt(by[0] * by[0] + by[1] * by[1] + by[2] * by[2]);
    const double share = lesser(0.5 * e.nearest / larger(length, kShortest), 1.0);
    for (int a = 0; a < 3; ++a) point[a] += by[a] * share;
    for (int a = 0, k = 0; a < 3; ++a)
      for (int b = 0; b <= a; ++b, ++k) information[3 * a + b] = information[3 * b + a] = e.hessian[k];
    if (length < settings.converged * e.nearest) return;
  }
}

/// The largest angle between a track's first ray and another one of it.
double angle_of(const TrackRays& rays, const RaysByTrack& by_track, const PosedCameras& cameras, int track,
                const double* point) {
  double first[3] = {}, largest = kNan;
  for (int at = by_track.begin(track); at < by_track.end(track); ++at) {
    const double* pose = pose_of(cameras, rays.frame[by_track.ray(at)]);
    const double d[3] = {pose[3] - point[0], pose[7] - point[1], pose[11] - point[2]};
    if (at == by_track.begin(track)) std::copy(d, d + 3, first);
    const double c0 = first[1] * d[2] - first[2] * d[1], c1 = first[2] * d[0] - first[0] * d[2];
    const double c2 = first[0] * d[1] - first[1] * d[0];
    const double along = first[0] * d[0] + first[1] * d[1] + first[2] * d[2];
    const double angle = std::atan2(std::sqrt(c0 * c0 + c1 * c1 + c2 * c2), along);
    if (!(angle <= largest)) largest = std::isnan(angle) ? largest : angle;
  }
  return largest;
}

/// The (lower) median reprojection error; NaN without rays or with one from behind, which also forgets the point.
double judged(const TrackRays& rays, const RaysByTrack& by_track, const PosedCameras& cameras, int track, double* point,
              std::vector<double>& errors) {
  errors.clear();
  for (int at = by_track.begin(track); at < by_track.end(track); ++at) {
    const int n = by_track.ray(at);
    double x[3];
    seen_from(pose_of(cameras, rays.frame[n]), point, x);
    if (!(x[2] > kNearPlane)) {
      std::fill(point, point + 3, kNan);
      return kNan;
    }
    errors.push_back(error_of(cameras.intrinsics, x, rays.uv + 2 * n));
  }
  if (errors.empty()) return kNan;
  const auto middle = errors.begin() + static_cast<std::ptrdiff_t>((errors.size() - 1) / 2);
  std::nth_element(errors.begin(), middle, errors.end());
  return *middle;
}

}  // namespace

RaysByTrack::RaysByTrack(const std::int64_t* row, int size, int tracks)
    : start_(static_cast<std::size_t>(tracks) + 1, 0) {
  for (int n = 0; n < size; ++n) ++start_[static_cast<std::size_t>(row[n]) + 1];
  for (std::size_t m = 0; m < static_cast<std::size_t>(tracks); ++m) start_[m + 1] += start_[m];
  if (std::is_sorted(row, row + size)) return;
  std::vector<int> next(start_.begin(), start_.end() - 1);
  order_.resize(static_cast<std::size_t>(size));
  for (int n = 0; n < size; ++n) {
    int& place = next[static_cast<std::size_t>(row[n])];
    order_[static_cast<std::size_t>(place++)] = n;
  }
}

void ray_equations(const TrackRays& rays, const PosedCameras& cameras, int tracks, double* matrix, double* right) {
  std::fill(matrix, matrix + 9 * static_cast<std::size_t>(tracks), 0.0);
  std::fill(right, right + 3 * static_cast<std::size_t>(tracks), 0.0);
  const double* k = cameras.intrinsics;
  for (int n = 0; n < rays.size; ++n) {
    const double x = (rays.uv[2 * n] - k[2]) / k[0], y = (rays.uv[2 * n + 1] - k[3]) / k[1];
    const double* pose = pose_of(cameras, rays.frame[n]);
    double d[3];
    for (int a = 0; a < 3; ++a) d[a] = pose[4 * a] * x + pose[4 * a + 1] * y + pose[4 * a + 2];
    const double length = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    for (double& part : d) part /= length;
    const double along = d[0] * pose[3] + d[1] * pose[7] + d[2] * pose[11];
    double *m = matrix + 9 * rays.row[n], *b = right + 3 * rays.row[n];
    for (int i = 0; i < 3; ++i) {
      b[i] += pose[4 * i + 3] - d[i] * along;
      for (int j = 0; j <= i; ++j) m[3 * i + j] += (i == j ? 1.0 : 0.0) - d[i] * d[j];
    }
  }
  for (double* m = matrix; m < matrix + 9 * static_cast<std::size_t>(tracks); m += 9) {
    m[1] = m[3];
    m[2] = m[6];
    m[5] = m[7];
  }
}

void refine_points(const TrackRays& rays, const PosedCameras& cameras, int tracks, const RefinementSettings& settings,
                   int threads, const RefinedPoints& out) {
  const RaysByTrack by_track(rays.row, rays.size, tracks);
  std::fill(out.information, out.information + 9 * static_cast<std::size_t>(tracks), 0.0);
  parallel_for(tracks, useful_threads(threads, tracks, kGrain), [&](int begin, int end, int) {
    std::vector<double> errors;
    for (int m = begin; m < end; ++m) {
      double* point = out.position + 3 * static_cast<std::size_t>(m);
      if (std::isfinite(point[0]) && std::isfinite(point[1]) && std::isfinite(point[2]))
        refine(rays, by_track, cameras, m, settings, point, out.information + 9 * static_cast<std::size_t>(m));
      out.error[m] = judged(rays, by_track, cameras, m, point, errors);
      out.angle[m] = angle_of(rays, by_track, cameras, m, point);
    }
  });
}

void ray_angles(const TrackRays& rays, const PosedCameras& cameras, const double* position, int tracks, double* angle) {
  const RaysByTrack by_track(rays.row, rays.size, tracks);
  for (int m = 0; m < tracks; ++m)
    angle[m] = angle_of(rays, by_track, cameras, m, position + 3 * static_cast<std::size_t>(m));
}

void reprojection_errors(const TrackRays& rays, const PosedCameras& cameras, const double* position, double* error) {
  for (int n = 0; n < rays.size; ++n) {
    double x[3];
    seen_from(pose_of(cameras, rays.frame[n]), position + 3 * rays.row[n], x);
    const double off = error_of(cameras.intrinsics, x, rays.uv + 2 * n);
    error[n] = std::isfinite(off) && x[2] > kNearPlane ? off : std::numeric_limits<double>::infinity();
  }
}

}  // namespace uni4d_fg
