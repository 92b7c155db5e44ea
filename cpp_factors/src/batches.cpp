#include "batches.hpp"

#include "uni4d_fg/factors/arap.hpp"
#include "uni4d_fg/factors/camera_motion.hpp"
#include "uni4d_fg/factors/depth_prior.hpp"
#include "uni4d_fg/factors/depth_reprojection.hpp"
#include "uni4d_fg/factors/dynamic_reprojection.hpp"
#include "uni4d_fg/factors/static_reprojection.hpp"
#include "uni4d_fg/factors/temporal_smoothness.hpp"

namespace uni4d_fg {

namespace {

UNI4D_FG_INLINE void scaled_identity(double scale, double* out) {
  for (int i = 0; i < 9; ++i) out[i] = i % 4 == 0 ? scale : 0.0;
}

}  // namespace

// Each kernel is one loop over rows; `in` and `out` are in the order of the family's arguments below.
#define UNI4D_FG_KERNEL(name)                                                                       \
  UNI4D_FG_CLONES void name(const double* const* in, double* const* out, int begin, int end) {     \
    for (long n = begin; n < end; ++n)

#define UNI4D_FG_KERNEL_END }

UNI4D_FG_KERNEL(static_reprojection_residual) {
  static_reprojection::residual(load_pose(in[0] + 16 * n), load_vec3(in[1] + 3 * n), load_intrinsics(in[2] + 4 * n),
                                in[3] + 2 * n, out[0] + 2 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(static_reprojection_linearize) {
  static_reprojection::linearize(load_pose(in[0] + 16 * n), load_vec3(in[1] + 3 * n), load_intrinsics(in[2] + 4 * n),
                                 in[3] + 2 * n, out[0] + 2 * n, out[1] + 12 * n, out[2] + 6 * n, out[3] + 8 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(depth_reprojection_residual) {
  const Pose relative = relative_pose(load_pose(in[1] + 16 * n), load_pose(in[0] + 16 * n));
  depth_reprojection::residual(relative, load_intrinsics(in[2] + 4 * n), in[3] + 2 * n, in[4][n], in[5] + 2 * n,
                               out[0] + 2 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(depth_reprojection_linearize) {
  const Pose relative = relative_pose(load_pose(in[1] + 16 * n), load_pose(in[0] + 16 * n));
  depth_reprojection::linearize_target(relative, load_intrinsics(in[2] + 4 * n), in[3] + 2 * n, in[4][n],
                                       in[5] + 2 * n, out[0] + 2 * n, out[2] + 12 * n, out[3] + 8 * n);
  depth_reprojection::source_from_target(relative, out[2] + 12 * n, out[1] + 12 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(dynamic_reprojection_residual) {
  dynamic_reprojection::residual(load_pose(in[2] + 16 * n), load_vec3(in[0] + 3 * n), load_intrinsics(in[3] + 4 * n),
                                 in[1] + 2 * n, out[0] + 2 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(dynamic_reprojection_linearize) {
  dynamic_reprojection::linearize(load_pose(in[2] + 16 * n), load_vec3(in[0] + 3 * n), load_intrinsics(in[3] + 4 * n),
                                  in[1] + 2 * n, out[0] + 2 * n, out[1] + 6 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(camera_rotation_residual) {
  camera_motion::rotation_residual(load_pose(in[0] + 16 * n), load_pose(in[1] + 16 * n), load_pose(in[2] + 16 * n),
                                   in[3][n], out[0] + 3 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(camera_rotation_linearize) {
  camera_motion::rotation_linearize(load_pose(in[0] + 16 * n), load_pose(in[1] + 16 * n), load_pose(in[2] + 16 * n),
                                    in[3][n], out[0] + 3 * n, out[1] + 18 * n, out[2] + 18 * n, out[3] + 18 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(camera_translation_residual) {
  camera_motion::translation_residual(load_pose(in[0] + 16 * n), load_pose(in[1] + 16 * n), load_pose(in[2] + 16 * n),
                                      in[3][n], out[0] + 3 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(camera_translation_linearize) {
  camera_motion::translation_linearize(load_pose(in[0] + 16 * n), load_pose(in[1] + 16 * n), load_pose(in[2] + 16 * n),
                                       in[3][n], out[0] + 3 * n, out[1] + 18 * n, out[2] + 18 * n, out[3] + 18 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(arap_residual) {
  arap::residual(load_vec3(in[0] + 3 * n), load_vec3(in[1] + 3 * n), load_vec3(in[2] + 3 * n), load_vec3(in[3] + 3 * n),
                 out[0] + n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(arap_linearize) {
  Vec3 now, next;
  arap::linearize(load_vec3(in[0] + 3 * n), load_vec3(in[1] + 3 * n), load_vec3(in[2] + 3 * n),
                  load_vec3(in[3] + 3 * n), out[0] + n, now, next);
  store(now, out[1] + 3 * n);
  store(-now, out[2] + 3 * n);
  store(-next, out[3] + 3 * n);
  store(next, out[4] + 3 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(velocity_residual) {
  temporal_smoothness::velocity_residual(load_vec3(in[0] + 3 * n), load_vec3(in[1] + 3 * n), out[0] + 3 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(velocity_linearize) {
  temporal_smoothness::velocity_residual(load_vec3(in[0] + 3 * n), load_vec3(in[1] + 3 * n), out[0] + 3 * n);
  for (int i = 0; i < 2; ++i) scaled_identity(temporal_smoothness::kVelocityJacobian[i], out[1 + i] + 9 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(acceleration_residual) {
  temporal_smoothness::acceleration_residual(load_vec3(in[0] + 3 * n), load_vec3(in[1] + 3 * n),
                                             load_vec3(in[2] + 3 * n), out[0] + 3 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(acceleration_linearize) {
  temporal_smoothness::acceleration_residual(load_vec3(in[0] + 3 * n), load_vec3(in[1] + 3 * n),
                                             load_vec3(in[2] + 3 * n), out[0] + 3 * n);
  for (int i = 0; i < 3; ++i) scaled_identity(temporal_smoothness::kAccelerationJacobian[i], out[1 + i] + 9 * n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(static_depth_prior_residual) {
  depth_prior::residual(load_pose(in[0] + 16 * n), load_vec3(in[1] + 3 * n), in[2][n], std::log(in[3][n]), out[0] + n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(static_depth_prior_linearize) {
  depth_prior::linearize(load_pose(in[0] + 16 * n), load_vec3(in[1] + 3 * n), in[2][n], std::log(in[3][n]), out[0] + n,
                         out[1] + 6 * n, out[2] + 3 * n, out[3] + n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(dynamic_depth_prior_residual) {
  depth_prior::residual(load_pose(in[2] + 16 * n), load_vec3(in[0] + 3 * n), in[3][n], std::log(in[1][n]), out[0] + n);
}
UNI4D_FG_KERNEL_END

UNI4D_FG_KERNEL(dynamic_depth_prior_linearize) {
  depth_prior::linearize_point(load_pose(in[2] + 16 * n), load_vec3(in[0] + 3 * n), in[3][n], std::log(in[1][n]),
                               out[0] + n, out[1] + 3 * n);
}
UNI4D_FG_KERNEL_END

#undef UNI4D_FG_KERNEL
#undef UNI4D_FG_KERNEL_END

namespace {

constexpr Argument pose(const char* name) { return {name, 16, false, 6, false}; }
constexpr Argument point(const char* name) { return {name, 3, false, 3, false}; }
constexpr Argument frozen_pose(const char* name) { return {name, 16, false, 0, false}; }
constexpr Argument pixel(const char* name) { return {name, 2, false, 0, false}; }
constexpr Argument positive(const char* name) { return {name, 1, true, 0, true}; }
constexpr Argument kIntrinsics{"intrinsics", 4, false, 4, false};

}  // namespace

const BatchFamily kFamilies[] = {
    {"depth_reprojection",
     2,
     3,
     6,
     {pose("source_pose"), pose("target_pose"), kIntrinsics, pixel("uv_source"), positive("depth"), pixel("uv_target")},
     depth_reprojection_residual,
     depth_reprojection_linearize},
    {"static_reprojection",
     2,
     3,
     4,
     {pose("world_T_cam"), point("landmark"), kIntrinsics, pixel("uv")},
     static_reprojection_residual,
     static_reprojection_linearize},
    {"dynamic_reprojection",
     2,
     1,
     4,
     {point("dynamic_point"), pixel("uv"), frozen_pose("world_T_cam"), {"intrinsics", 4, false, 0, false}},
     dynamic_reprojection_residual,
     dynamic_reprojection_linearize},
    {"camera_rotation",
     3,
     3,
     4,
     {pose("before"), pose("now"), pose("after"), positive("floor")},
     camera_rotation_residual,
     camera_rotation_linearize},
    {"camera_translation",
     3,
     3,
     4,
     {pose("before"), pose("now"), pose("after"), positive("floor")},
     camera_translation_residual,
     camera_translation_linearize},
    {"arap",
     1,
     4,
     4,
     {point("first"), point("second"), point("first_next"), point("second_next")},
     arap_residual,
     arap_linearize},
    {"velocity_smoothness", 3, 2, 2, {point("now"), point("after")}, velocity_residual, velocity_linearize},
    {"acceleration_smoothness",
     3,
     3,
     3,
     {point("before"), point("now"), point("after")},
     acceleration_residual,
     acceleration_linearize},
    {"static_depth_prior",
     1,
     3,
     4,
     {pose("world_T_cam"), point("landmark"), {"log_scale", 1, false, 1, false}, positive("depth")},
     static_depth_prior_residual,
     static_depth_prior_linearize},
    {"dynamic_depth_prior",
     1,
     1,
     4,
     {point("dynamic_point"), positive("depth"), frozen_pose("world_T_cam"), {"log_scale", 1, true, 0, false}},
     dynamic_depth_prior_residual,
     dynamic_depth_prior_linearize},
};

const int kNumFamilies = static_cast<int>(sizeof(kFamilies) / sizeof(kFamilies[0]));

}  // namespace uni4d_fg
