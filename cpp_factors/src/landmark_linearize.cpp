// Energies and normal equations: one pass over the groups, eight records at a time.
#include <algorithm>
#include <array>

#include "landmark_frame_sums.hpp"
#include "landmark_kernels.hpp"
#include "landmark_passes.hpp"

namespace uni4d_fg::landmark_passes {

namespace {

struct ChunkPoints {
  double xyz[3 * kChunkLandmarks];
  ChunkPoints(const LandmarkChunk& chunk, const double* landmarks) {
    for (std::size_t i = 0; i < chunk.landmarks.size(); ++i)
      for (std::size_t k = 0; k < 3; ++k)
        xyz[3 * i + k] = landmarks[3 * static_cast<std::size_t>(chunk.landmarks[i]) + k];
  }
};

// Members of a vector are compiled for the oldest processor: the loops below see plain pointers.
struct GroupArrays {
  const RecordGroup* groups;
  const double* data;
  const std::uint8_t* lane_landmark;
  const int* lane_pair;
  std::size_t count;
  explicit GroupArrays(const LandmarkChunk& chunk)
      : groups(chunk.groups.data()),
        data(chunk.data.data()),
        lane_landmark(chunk.lane_landmark.data()),
        lane_pair(chunk.lane_pair.data()),
        count(chunk.groups.size()) {}
};

template <int kBytes, bool kDepth>
UNI4D_FG_INLINE void energies(const PassInput& in, const LandmarkChunk& chunk, double* reprojection, double* depth) {
  const ChunkPoints points(chunk, in.state.landmarks);
  const Intrinsics k = load_intrinsics(in.state.intrinsics);
  const GroupArrays groups(chunk);
  for (std::size_t i = 0; i < groups.count; ++i) {
    const RecordGroup& group = groups.groups[i];
    const double* data = groups.data + i * kFields * kSimd8Width;
    const SimdPoint<kBytes> p = gather_points<kBytes>(points.xyz, groups.lane_landmark + i * kSimd8Width);
    const SimdPoint<kBytes> x = to_camera(in.state.world_T_cam + 16 * group.frame, p);
    const SimdDepth<kBytes> z = guarded_depth(x.z);
    const Simd8<kBytes> g = inverse_depth(z);
    const Simd8<kBytes> u = (field<kBytes>(data, kU) - (k.fx * x.x * g + k.cx)) * field<kBytes>(data, kInverseSigmaU);
    const Simd8<kBytes> v = (field<kBytes>(data, kV) - (k.fy * x.y * g + k.cy)) * field<kBytes>(data, kInverseSigmaV);
    const Simd8<kBytes> robust = rho(in.reprojection_kernels[group.reprojection], u * u + v * v);
    Simd8<kBytes> total = load<Simd8<kBytes>>(reprojection + group.reprojection * kSimd8Width);
    total += field<kBytes>(data, kWeight) * robust;
    store(total, reprojection + group.reprojection * kSimd8Width);
    if constexpr (kDepth) {
      const Simd8<kBytes> r = (log_depth(z) - field<kBytes>(data, kLogDepth) - in.state.log_scale[group.frame]) *
                              field<kBytes>(data, kInverseSigmaDepth);
      total = load<Simd8<kBytes>>(depth + group.depth * kSimd8Width);
      total += field<kBytes>(data, kDepthWeight) * rho(in.depth_kernels[group.depth], r * r);
      store(total, depth + group.depth * kSimd8Width);
    }
  }
}

/// base + a * b, or base alone where no batch has a third row.
template <bool kDepth, int kBytes>
UNI4D_FG_INLINE Simd8<kBytes> plus(const Simd8<kBytes>& base, const Simd8<kBytes>& a, const Simd8<kBytes>& b) {
  if constexpr (kDepth) return base + a * b;
  (void)a, (void)b;
  return base;
}

template <int kBytes>
UNI4D_FG_INLINE void add(double* sums, int place, const Simd8<kBytes>& value) {
  double* at = sums + place * kSimd8Width;
  store(load<Simd8<kBytes>>(at) + value, at);
}

constexpr std::size_t kGroupsAhead = 2;

/// Where eight records, one per lane, put what they computed.
struct GroupTargets {
  const RecordGroup& group;
  const std::uint8_t* landmark;
  const int* pair;
};

/// Hand row `row` (8 columns, a lane per record) of the coupling blocks to their pairs.
template <int kBytes>
UNI4D_FG_INLINE void store_coupling(const GroupTargets& targets, const Simd8<kBytes>* columns, int row,
                                    double* coupling) {
  Simd8<kBytes> records[kSimd8Width];
  transpose(columns, records);
  for (int lane = 0; lane < kSimd8Width; ++lane) {
    if (lane >= targets.group.used) break;
    double* at = coupling + static_cast<std::size_t>(targets.pair[lane]) * kWidth + row * kSimd8Width;
    store(targets.group.first ? records[lane] : load<Simd8<kBytes>>(at) + records[lane], at);
  }
}

/// Ask for the coupling blocks of records to come: they lie apart, where the processor does not foresee them.
UNI4D_FG_INLINE void prefetch_coupling(const int* pair, const double* coupling) {
  for (int lane = 0; lane < kSimd8Width; ++lane)
    for (int row = 0; row < 3; ++row)
      prefetch_for_writing(coupling + static_cast<std::size_t>(pair[lane]) * kWidth + row * kSimd8Width);
}

/// Add eight sums at place `row` of the records' landmarks.
template <int kBytes>
UNI4D_FG_INLINE void add_to_landmarks(const GroupTargets& targets, const Simd8<kBytes>* columns, int row,
                                      double* by_landmark) {
  Simd8<kBytes> records[kSimd8Width];
  transpose(columns, records);
  for (int lane = 0; lane < kSimd8Width; ++lane) {
    if (lane >= targets.group.used) break;
    double* at = by_landmark + static_cast<std::size_t>(targets.landmark[lane]) * kWidth + row * kSimd8Width;
    store(load<Simd8<kBytes>>(at) + records[lane], at);
  }
}

template <int kBytes, bool kDepth, bool kIntrinsics>
UNI4D_FG_INLINE void linearize(const PassInput& in, const LandmarkChunk& chunk, double* frame_sums, double* coupling,
                               double* landmarks) {
  using namespace frame_sums;
  const ChunkPoints points(chunk, in.state.landmarks);
  const Intrinsics k = load_intrinsics(in.state.intrinsics);
  alignas(64) double by_landmark[kChunkLandmarks * kWidth] = {};
  const GroupArrays groups(chunk);
  for (std::size_t i = 0; i < groups.count; ++i) {
    const RecordGroup& group = groups.groups[i];
    if (i + kGroupsAhead < groups.count && !chunk.frozen)
      prefetch_coupling(groups.lane_pair + (i + kGroupsAhead) * kSimd8Width, coupling);
    const double* data = groups.data + i * kFields * kSimd8Width;
    const std::uint8_t* lane_landmark = groups.lane_landmark + i * kSimd8Width;
    const double* m = in.state.world_T_cam + 16 * group.frame;
    const SimdPoint<kBytes> x = to_camera(m, gather_points<kBytes>(points.xyz, lane_landmark));
    const SimdDepth<kBytes> z = guarded_depth(x.z);
    const Simd8<kBytes> g = inverse_depth(z);
    const Simd8<kBytes> xg = x.x * g, yg = x.y * g;
    const Simd8<kBytes> isu = field<kBytes>(data, kInverseSigmaU), isv = field<kBytes>(data, kInverseSigmaV);
    Simd8<kBytes> ru = (field<kBytes>(data, kU) - (k.fx * xg + k.cx)) * isu;
    Simd8<kBytes> rv = (field<kBytes>(data, kV) - (k.fy * yg + k.cy)) * isv;
    const Simd8<kBytes> scale = square_root(field<kBytes>(data, kWeight) *
                                            weight(in.reprojection_kernels[group.reprojection], ru * ru + rv * rv));
    ru = ru * scale;
    rv = rv * scale;
    // r = z - pi: the rows of -d pi / d x are (a, 0, b) and (0, c, d).
    const Simd8<kBytes> ku = isu * scale, kv = isv * scale;
    const Simd8<kBytes> slope = z.inverse * z.inverse;
    const Simd8<kBytes> a = -(k.fx * g * ku), b = k.fx * x.x * slope * ku;
    const Simd8<kBytes> c = -(k.fy * g * kv), d = k.fy * x.y * slope * kv;
    const Simd8<kBytes> ju[5] = {-(b * x.y), b * x.x - a * x.z, a * x.y, -a, -b};
    const Simd8<kBytes> jv[5] = {c * x.z - d * x.y, d * x.x, -(c * x.x), -c, -d};
    Simd8<kBytes> rd{}, js{}, e{}, jd[3] = {Simd8<kBytes>{}, Simd8<kBytes>{}, Simd8<kBytes>{}};
    if constexpr (kDepth) {
      const Simd8<kBytes> isd = field<kBytes>(data, kInverseSigmaDepth);
      rd = (log_depth(z) - field<kBytes>(data, kLogDepth) - in.state.log_scale[group.frame]) * isd;
      const Simd8<kBytes> scale_depth =
          square_root(field<kBytes>(data, kDepthWeight) * weight(in.depth_kernels[group.depth], rd * rd));
      rd = rd * scale_depth;
      js = -(isd * scale_depth);
      e = -(z.inverse * js);
      jd[0] = -(e * x.y);
      jd[1] = e * x.x;
      jd[2] = -e;
    }

    double* sums = frame_sums + static_cast<std::size_t>(group.frame) * kSums * kSimd8Width;
    // Pose with pose and gradient: rows u, v, depth have entries where kPoseOfU, kPoseOfV, kPoseOfDepth say.
    add(sums, kPose + 0, plus<kDepth>(ju[0] * ju[0] + jv[0] * jv[0], jd[0], jd[0]));
    add(sums, kPose + 1, plus<kDepth>(ju[1] * ju[0] + jv[1] * jv[0], jd[1], jd[0]));
    add(sums, kPose + 2, plus<kDepth>(ju[1] * ju[1] + jv[1] * jv[1], jd[1], jd[1]));
    add(sums, kPose + 3, ju[2] * ju[0] + jv[2] * jv[0]);
    add(sums, kPose + 4, ju[2] * ju[1] + jv[2] * jv[1]);
    add(sums, kPose + 5, ju[2] * ju[2] + jv[2] * jv[2]);
    add(sums, kPose + 6, ju[3] * ju[0]);
    add(sums, kPose + 7, ju[3] * ju[1]);
    add(sums, kPose + 8, ju[3] * ju[2]);
    add(sums, kPose + 9, ju[3] * ju[3]);
    add(sums, kPose + 10, jv[3] * jv[0]);
    add(sums, kPose + 11, jv[3] * jv[1]);
    add(sums, kPose + 12, jv[3] * jv[2]);
    add(sums, kPose + 14, jv[3] * jv[3]);
    add(sums, kPose + 15, plus<kDepth>(ju[4] * ju[0] + jv[4] * jv[0], jd[2], jd[0]));
    add(sums, kPose + 16, plus<kDepth>(ju[4] * ju[1] + jv[4] * jv[1], jd[2], jd[1]));
    add(sums, kPose + 17, ju[4] * ju[2] + jv[4] * jv[2]);
    add(sums, kPose + 18, ju[4] * ju[3]);
    add(sums, kPose + 19, jv[4] * jv[3]);
    add(sums, kPose + 20, plus<kDepth>(ju[4] * ju[4] + jv[4] * jv[4], jd[2], jd[2]));
    add(sums, kPoseGradient + 0, plus<kDepth>(ju[0] * ru + jv[0] * rv, jd[0], rd));
    add(sums, kPoseGradient + 1, plus<kDepth>(ju[1] * ru + jv[1] * rv, jd[1], rd));
    add(sums, kPoseGradient + 2, ju[2] * ru + jv[2] * rv);
    add(sums, kPoseGradient + 3, ju[3] * ru);
    add(sums, kPoseGradient + 4, jv[3] * rv);
    add(sums, kPoseGradient + 5, plus<kDepth>(ju[4] * ru + jv[4] * rv, jd[2], rd));
    if constexpr (kDepth) {
      for (int j = 0; j < 3; ++j) add(sums, kPoseScale + j, js * jd[j]);
      add(sums, kScale, js * js);
      add(sums, kScale + 1, js * rd);
    }
    const Simd8<kBytes> jfx = -(xg * ku), jcx = -ku, jfy = -(yg * kv), jcy = -kv;
    if constexpr (kIntrinsics) {
      for (int j = 0; j < 5; ++j) {
        add(sums, kPoseU + 2 * j, ju[j] * jfx);
        add(sums, kPoseU + 2 * j + 1, ju[j] * jcx);
        add(sums, kPoseV + 2 * j, jv[j] * jfy);
        add(sums, kPoseV + 2 * j + 1, jv[j] * jcy);
      }
      add(sums, kIntrinsicsU + 0, jfx * jfx);
      add(sums, kIntrinsicsU + 1, jfx * jcx);
      add(sums, kIntrinsicsU + 2, jcx * jcx);
      add(sums, kIntrinsicsV + 0, jfy * jfy);
      add(sums, kIntrinsicsV + 1, jfy * jcy);
      add(sums, kIntrinsicsV + 2, jcy * jcy);
      add(sums, kIntrinsicsGradient + 0, jfx * ru);
      add(sums, kIntrinsicsGradient + 1, jfy * rv);
      add(sums, kIntrinsicsGradient + 2, jcx * ru);
      add(sums, kIntrinsicsGradient + 3, jcy * rv);
    }
    if (chunk.frozen) continue;

    Simd8<kBytes> lu[3], lv[3], ld[3];
    for (int j = 0; j < 3; ++j) {
      lu[j] = a * m[4 * j] + b * m[4 * j + 2];
      lv[j] = c * m[4 * j + 1] + d * m[4 * j + 2];
      ld[j] = e * m[4 * j + 2];
    }
    const GroupTargets targets{group, lane_landmark, groups.lane_pair + i * kSimd8Width};
    for (int j = 0; j < 3; ++j) {
      Simd8<kBytes> columns[kSimd8Width] = {plus<kDepth>(lu[j] * ju[0] + lv[j] * jv[0], ld[j], jd[0]),
                                            plus<kDepth>(lu[j] * ju[1] + lv[j] * jv[1], ld[j], jd[1]),
                                            lu[j] * ju[2] + lv[j] * jv[2],
                                            lu[j] * ju[3],
                                            lv[j] * jv[3],
                                            plus<kDepth>(lu[j] * ju[4] + lv[j] * jv[4], ld[j], jd[2]),
                                            Simd8<kBytes>{},
                                            Simd8<kBytes>{}};
      if constexpr (kDepth) columns[6] = ld[j] * js;
      store_coupling(targets, columns, j, coupling);
    }
    // V, the gradient, and the coupling to the intrinsics: 24 sums in the order of LandmarkSystem::landmarks_.
    Simd8<kBytes> point[kWidth];
    int place = 0;
    for (int j = 0; j < 3; ++j)
      for (int n = j; n < 3; ++n) point[place++] = plus<kDepth>(lu[j] * lu[n] + lv[j] * lv[n], ld[j], ld[n]);
    for (int j = 0; j < 3; ++j) point[6 + j] = plus<kDepth>(lu[j] * ru + lv[j] * rv, ld[j], rd);
    for (int j = 9; j < kWidth; ++j) point[j] = Simd8<kBytes>{};
    if constexpr (kIntrinsics) {
      for (int j = 0; j < 3; ++j) {
        point[9 + 4 * j] = lu[j] * jfx;
        point[10 + 4 * j] = lv[j] * jfy;
        point[11 + 4 * j] = lu[j] * jcx;
        point[12 + 4 * j] = lv[j] * jcy;
      }
    }
    for (int row = 0; row < (kIntrinsics ? 3 : 2); ++row)
      add_to_landmarks(targets, point + row * kSimd8Width, row, by_landmark);
  }
  if (chunk.frozen) return;
  for (std::size_t i = 0; i < chunk.landmarks.size(); ++i)
    std::copy_n(by_landmark + kWidth * i, kWidth, landmarks + kWidth * static_cast<std::size_t>(chunk.landmarks[i]));
}

}  // namespace

UNI4D_FG_DISPATCH(void, energies_plain, (const PassInput& in, const LandmarkChunk& chunk, double* reprojection),
                  (in, chunk, reprojection), energies<kBytes, false>(in, chunk, reprojection, nullptr))

UNI4D_FG_DISPATCH(void, energies_depth,
                  (const PassInput& in, const LandmarkChunk& chunk, double* reprojection, double* depth),
                  (in, chunk, reprojection, depth), energies<kBytes, true>(in, chunk, reprojection, depth))

#define UNI4D_FG_LINEARIZE(name, depth, intrinsics)                                                         \
  UNI4D_FG_DISPATCH(                                                                                        \
      void, name,                                                                                           \
      (const PassInput& in, const LandmarkChunk& chunk, double* sums, double* coupling, double* landmarks), \
      (in, chunk, sums, coupling, landmarks),                                                               \
      linearize<kBytes, depth, intrinsics>(in, chunk, sums, coupling, landmarks))
UNI4D_FG_LINEARIZE(linearize_plain, false, false)
UNI4D_FG_LINEARIZE(linearize_depth, true, false)
UNI4D_FG_LINEARIZE(linearize_intrinsics, false, true)
UNI4D_FG_LINEARIZE(linearize_depth_intrinsics, true, true)
#undef UNI4D_FG_LINEARIZE

}  // namespace uni4d_fg::landmark_passes
