// Embedded point iterations: every landmark of a chunk goes to its own minimum while the cameras rest.
//
// Landmarks have nothing to do with each other then. Each has its own damping and its own decision on every step, and
// the model of a step knows the curvature of the robust kernels.
// Source: Jeong et al. 2012, "Pushing the envelope of modern methods for bundle adjustment".
#include <algorithm>
#include <cmath>

#include "landmark_cholesky.hpp"
#include "landmark_kernels.hpp"
#include "landmark_passes.hpp"

namespace uni4d_fg::landmark_passes {

namespace {

/// Part of the kernels' falloff that the model of a step accounts for.
constexpr double kKernelCurvature = 0.9;
constexpr double kFirstDamping = 1e-4, kLeastDamping = 1e-9, kMostDamping = 1e6;
constexpr double kDampingFactor = 8.0;
/// A landmark rests once a step lowers its energy by less than this part.
constexpr double kLeastDecrease = 1e-8;

/// Sums of a landmark: V as xx xy xz yy yz zz, gradient 3, energy, 6 unused.
constexpr int kPointSums = 16;
constexpr int kEnergy = 9;

UNI4D_FG_INLINE bool any_of(std::uint64_t landmarks, const std::uint8_t* lane_landmark, int used) {
  std::uint64_t lanes = 0;
  for (int lane = 0; lane < used; ++lane) lanes |= std::uint64_t{1} << lane_landmark[lane];
  return (lanes & landmarks) != 0;
}

/// Sum up the landmarks `wanted`, a bit each, at `points` (64, 3), into `sums` (64, kPointSums). Others are spoiled.
template <int kBytes, bool kDepth>
UNI4D_FG_INLINE void sum_points(const PassInput& in, const LandmarkChunk& chunk, const double* points,
                                std::uint64_t wanted, double* sums) {
  std::fill_n(sums, kChunkLandmarks * kPointSums, 0.0);
  const Intrinsics k = load_intrinsics(in.state.intrinsics);
  const RecordGroup* groups = chunk.groups.data();
  const std::uint8_t* lane_landmarks = chunk.lane_landmark.data();
  const double* all_data = chunk.data.data();
  const std::size_t count = chunk.groups.size();
  for (std::size_t i = 0; i < count; ++i) {
    const RecordGroup& group = groups[i];
    const std::uint8_t* lane_landmark = lane_landmarks + i * kSimd8Width;
    if (!any_of(wanted, lane_landmark, group.used)) continue;
    const double* data = all_data + i * kFields * kSimd8Width;
    const double* m = in.state.world_T_cam + 16 * group.frame;
    const SimdPoint<kBytes> x = to_camera(m, gather_points<kBytes>(points, lane_landmark));
    const SimdDepth<kBytes> z = guarded_depth(x.z);
    const Simd8<kBytes> g = inverse_depth(z);
    const Simd8<kBytes> isu = field<kBytes>(data, kInverseSigmaU), isv = field<kBytes>(data, kInverseSigmaV);
    const Simd8<kBytes> ru = (field<kBytes>(data, kU) - (k.fx * x.x * g + k.cx)) * isu;
    const Simd8<kBytes> rv = (field<kBytes>(data, kV) - (k.fy * x.y * g + k.cy)) * isv;
    const Kernel& kernel = in.reprojection_kernels[group.reprojection];
    const Simd8<kBytes> squared = ru * ru + rv * rv;
    const Simd8<kBytes> w = field<kBytes>(data, kWeight) * weight(kernel, squared);
    Simd8<kBytes> energy = field<kBytes>(data, kWeight) * rho(kernel, squared);
    const Simd8<kBytes> along = kKernelCurvature * w * falloff(kernel, squared) / larger(squared, 1e-300);
    // Rows of d r / d x are (a, 0, b) and (0, c, d), as in linearize.
    const Simd8<kBytes> slope = z.inverse * z.inverse;
    const Simd8<kBytes> a = -(k.fx * g * isu), b = k.fx * x.x * slope * isu;
    const Simd8<kBytes> c = -(k.fy * g * isv), d = k.fy * x.y * slope * isv;
    Simd8<kBytes> rd{}, wd{}, wd_curved{}, e{};
    if constexpr (kDepth) {
      const Simd8<kBytes> isd = field<kBytes>(data, kInverseSigmaDepth);
      rd = (log_depth(z) - field<kBytes>(data, kLogDepth) - in.state.log_scale[group.frame]) * isd;
      const Kernel& depth_kernel = in.depth_kernels[group.depth];
      const Simd8<kBytes> squared_depth = rd * rd;
      wd = field<kBytes>(data, kDepthWeight) * weight(depth_kernel, squared_depth);
      wd_curved = wd * (1.0 - kKernelCurvature * falloff(depth_kernel, squared_depth));
      energy = energy + field<kBytes>(data, kDepthWeight) * rho(depth_kernel, squared_depth);
      e = z.inverse * isd;
    }
    Simd8<kBytes> lu[3], lv[3], ld[3], pull[3];
    for (int j = 0; j < 3; ++j) {
      lu[j] = a * m[4 * j] + b * m[4 * j + 2];
      lv[j] = c * m[4 * j + 1] + d * m[4 * j + 2];
      ld[j] = e * m[4 * j + 2];
      pull[j] = lu[j] * ru + lv[j] * rv;
    }
    Simd8<kBytes> columns[2 * kSimd8Width];
    int place = 0;
    for (int j = 0; j < 3; ++j)
      for (int n = j; n < 3; ++n) {
        columns[place] = w * (lu[j] * lu[n] + lv[j] * lv[n]) - along * pull[j] * pull[n];
        if constexpr (kDepth) columns[place] += wd_curved * ld[j] * ld[n];
        ++place;
      }
    for (int j = 0; j < 3; ++j) {
      columns[6 + j] = w * pull[j];
      if constexpr (kDepth) columns[6 + j] += wd * rd * ld[j];
    }
    columns[kEnergy] = energy;
    for (int j = kEnergy + 1; j < kPointSums; ++j) columns[j] = Simd8<kBytes>{};
    Simd8<kBytes> first[kSimd8Width], second[kSimd8Width];
    transpose(columns, first);
    transpose(columns + kSimd8Width, second);
    for (int lane = 0; lane < kSimd8Width; ++lane) {
      if (lane >= group.used) break;
      double* at = sums + static_cast<std::size_t>(lane_landmark[lane]) * kPointSums;
      store(load<Simd8<kBytes>>(at) + first[lane], at);
      store(load<Simd8<kBytes>>(at + kSimd8Width) + second[lane], at + kSimd8Width);
    }
  }
}

template <int kBytes, bool kDepth>
UNI4D_FG_INLINE void settle(const PassInput& in, const LandmarkChunk& chunk, DampingBounds bounds, int iterations,
                            double* landmarks) {
  using namespace landmark_cholesky;
  const int* rows = chunk.landmarks.data();
  const std::size_t count = chunk.landmarks.size();
  double best[3 * kChunkLandmarks] = {}, tried[3 * kChunkLandmarks], damping[kChunkLandmarks];
  alignas(64) double at_best[kChunkLandmarks * kPointSums], at_tried[kChunkLandmarks * kPointSums];
  for (std::size_t i = 0; i < count; ++i)
    std::copy_n(landmarks + 3 * static_cast<std::size_t>(rows[i]), 3, best + 3 * i);
  std::copy_n(best, 3 * kChunkLandmarks, tried);
  std::fill_n(damping, kChunkLandmarks, kFirstDamping);
  std::uint64_t moving = count == 64 ? ~std::uint64_t{0} : (std::uint64_t{1} << count) - 1;
  sum_points<kBytes, kDepth>(in, chunk, best, moving, at_best);
  for (int iteration = 0; iteration < iterations && moving != 0; ++iteration) {
    for (std::size_t i = 0; i < count; ++i) {
      if ((moving >> i & 1) == 0) continue;
      double* at = at_best + i * kPointSums;
      double factor[6], step[3] = {-at[6], -at[7], -at[8]};
      bounds.damping = damping[i];
      if (!factorize(at, bounds, factor)) {
        moving &= ~(std::uint64_t{1} << i);
        continue;
      }
      solve_lower(factor, step);
      solve_upper(factor, step);
      for (std::size_t k = 0; k < 3; ++k) tried[3 * i + k] = best[3 * i + k] + step[k];
    }
    sum_points<kBytes, kDepth>(in, chunk, tried, moving, at_tried);
    for (std::size_t i = 0; i < count; ++i) {
      if ((moving >> i & 1) == 0) continue;
      const double *now = at_tried + i * kPointSums, before = at_best[i * kPointSums + kEnergy];
      bool rests;
      if (now[kEnergy] < before) {
        rests = before - now[kEnergy] < kLeastDecrease * before;
        std::copy_n(now, kPointSums, at_best + i * kPointSums);
        std::copy_n(tried + 3 * i, 3, best + 3 * i);
        damping[i] = std::max(damping[i] / kDampingFactor, kLeastDamping);
      } else {
        damping[i] *= kDampingFactor;
        rests = damping[i] > kMostDamping;
      }
      if (rests) moving &= ~(std::uint64_t{1} << i);
    }
  }
  for (std::size_t i = 0; i < count; ++i)
    std::copy_n(best + 3 * i, 3, landmarks + 3 * static_cast<std::size_t>(rows[i]));
}

}  // namespace

UNI4D_FG_DISPATCH(void, settle_points,
                  (const PassInput& in, const LandmarkChunk& chunk, const DampingBounds& bounds, int iterations,
                   double* landmarks),
                  (in, chunk, bounds, iterations, landmarks),
                  settle<kBytes, false>(in, chunk, bounds, iterations, landmarks))

UNI4D_FG_DISPATCH(void, settle_points_with_depth,
                  (const PassInput& in, const LandmarkChunk& chunk, const DampingBounds& bounds, int iterations,
                   double* landmarks),
                  (in, chunk, bounds, iterations, landmarks),
                  settle<kBytes, true>(in, chunk, bounds, iterations, landmarks))

}  // namespace uni4d_fg::landmark_passes
