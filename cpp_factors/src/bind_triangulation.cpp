// Python entry points of triangulation.hpp.
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <tuple>

#include "arrays.hpp"
#include "triangulation.hpp"

namespace uni4d_fg {

namespace {

using FloatArray = nb::ndarray<nb::numpy, double>;

/// Rays whose arrays passed, and the cameras that they come from.
struct Seen {
  TrackRays rays;
  PosedCameras cameras;
  std::int64_t frames = 0;
};

Seen expect_rays(const AnyArray& row, const AnyArray& frame, const AnyArray& uv, const AnyArray& world_T_cam,
                 const AnyArray& intrinsics, std::int64_t tracks) {
  const View<double> poses = expect_floats(world_T_cam, "world_T_cam", {kAnyLength, 4, 4});
  const View<double> pixels = expect_floats(uv, "uv", {kAnyLength, 2});
  const View<std::int64_t> rows = expect_rows(row, "row", pixels.rows(), tracks);
  const View<std::int64_t> frames = expect_rows(frame, "frame", pixels.rows(), poses.rows());
  const View<double> focal = expect_floats(intrinsics, "intrinsics", {4});
  return {{rows.data, frames.data, pixels.data, expect_count(pixels.rows(), "uv")},
          {poses.data, nullptr, focal.data},
          poses.rows()};
}

std::size_t sized(std::int64_t count) { return static_cast<std::size_t>(count); }

std::pair<FloatArray, FloatArray> equations(const AnyArray& row, const AnyArray& frame, const AnyArray& uv,
                                            const AnyArray& world_T_cam, const AnyArray& intrinsics, int tracks) {
  if (tracks < 0) refuse("tracks: expected 0 or more");
  const Seen seen = expect_rays(row, frame, uv, world_T_cam, intrinsics, tracks);
  NewArray matrix({sized(tracks), 3, 3}), right({sized(tracks), 3});
  {
    nb::gil_scoped_release release;
    ray_equations(seen.rays, seen.cameras, tracks, matrix.data(), right.data());
  }
  return {matrix.release(), right.release()};
}

std::tuple<FloatArray, FloatArray, FloatArray, FloatArray> refined(const AnyArray& row, const AnyArray& frame,
                                                                   const AnyArray& uv, const AnyArray& world_T_cam,
                                                                   const AnyArray& intrinsics, const AnyArray& origin,
                                                                   const AnyArray& position, double huber_px, int steps,
                                                                   double converged, double ridge, int threads) {
  const View<double> start = expect_floats(position, "position", {kAnyLength, 3}, false);
  const int tracks = expect_count(start.rows(), "position");
  Seen seen = expect_rays(row, frame, uv, world_T_cam, intrinsics, tracks);
  seen.cameras.origin = expect_floats(origin, "origin", {seen.frames, 3}).data;
  if (!(huber_px > 0.0)) refuse("huber_px: expected a positive number");
  if (steps < 0 || !(converged >= 0.0) || !(ridge >= 0.0)) refuse("steps, converged, ridge: expected 0 or more");
  const int workers = expect_threads(threads);
  NewArray point({sized(tracks), 3}), information({sized(tracks), 3, 3}), angle({sized(tracks)}),
      error({sized(tracks)});
  std::copy(start.data, start.data + start.size(), point.data());
  {
    nb::gil_scoped_release release;
    refine_points(seen.rays, seen.cameras, tracks, {steps, huber_px, converged, ridge}, workers,
                  {point.data(), information.data(), angle.data(), error.data()});
  }
  return {point.release(), information.release(), angle.release(), error.release()};
}

FloatArray angles(const AnyArray& row, const AnyArray& frame, const AnyArray& uv, const AnyArray& world_T_cam,
                  const AnyArray& intrinsics, const AnyArray& position) {
  const View<double> points = expect_floats(position, "position", {kAnyLength, 3}, false);
  const int tracks = expect_count(points.rows(), "position");
  const Seen seen = expect_rays(row, frame, uv, world_T_cam, intrinsics, tracks);
  NewArray out({sized(tracks)});
  {
    nb::gil_scoped_release release;
    ray_angles(seen.rays, seen.cameras, points.data, tracks, out.data());
  }
  return out.release();
}

FloatArray errors(const AnyArray& row, const AnyArray& frame, const AnyArray& uv, const AnyArray& world_T_cam,
                  const AnyArray& intrinsics, const AnyArray& position) {
  const View<double> points = expect_floats(position, "position", {kAnyLength, 3}, false);
  const Seen seen = expect_rays(row, frame, uv, world_T_cam, intrinsics, points.rows());
  NewArray out({sized(seen.rays.size)});
  {
    nb::gil_scoped_release release;
    reprojection_errors(seen.rays, seen.cameras, points.data, out.data());
  }
  return out.release();
}

}  // namespace

void bind_triangulation(nb::module_& module) {
  module.def(
      "ray_equations", &equations, nb::arg("row"), nb::arg("frame"), nb::arg("uv"), nb::arg("world_T_cam"),
      nb::arg("intrinsics"), nb::kw_only(), nb::arg("tracks"),
      "Normal equations (M, 3, 3) and (M, 3) of the points nearest to all rays of their tracks: ray n is of track "
      "row (N,) and goes through the pixel uv (N, 2) of camera frame (N,) of world_T_cam (T, 4, 4).");
  module.def(
      "refine_points", &refined, nb::arg("row"), nb::arg("frame"), nb::arg("uv"), nb::arg("world_T_cam"),
      nb::arg("intrinsics"), nb::arg("origin"), nb::arg("position"), nb::kw_only(), nb::arg("huber_px"),
      nb::arg("steps"), nb::arg("converged"), nb::arg("ridge"), nb::arg("threads") = 0,
      "Refine points (M, 3), NaN where there is none, on the reprojection errors of their rays; origin (T, 3) is "
      "the world's in the cameras. Returns the points, NaN behind a camera, J'WJ (M, 3, 3), "
      "the angles (M,) under which they see their cameras, and their lower median errors (M,) px.");
  module.def("ray_angles", &angles, nb::arg("row"), nb::arg("frame"), nb::arg("uv"), nb::arg("world_T_cam"),
             nb::arg("intrinsics"), nb::arg("position"),
             "Angles (M,) under which points (M, 3) see the cameras of their rays, rad; NaN without either.");
  module.def("reprojection_errors", &errors, nb::arg("row"), nb::arg("frame"), nb::arg("uv"), nb::arg("world_T_cam"),
             nb::arg("intrinsics"), nb::arg("position"),
             "Reprojection errors (N,) px of points (M, 3) along their rays, infinite without a point or from behind.");
}

}  // namespace uni4d_fg
