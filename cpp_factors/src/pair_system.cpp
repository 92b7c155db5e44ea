#include "pair_system.hpp"

#include <algorithm>
#include <numeric>
#include <utility>

#include "uni4d_fg/camera.hpp"
#include "uni4d_fg/parallel.hpp"
#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

namespace {

constexpr int kTileRows = 64;
constexpr int kRowsPerThread = 16000;
constexpr int kColumns = PairSystem::kColumns;
constexpr int kSums = PairSystem::kSums;

/// What a tile reads.
struct TileInput {
  const double *u_source, *v_source, *depth, *u_target, *v_target, *inverse_sigma_u, *inverse_sigma_v, *weight;
  int rows;
};

struct Residual {
  double u, v;
};

UNI4D_FG_INLINE Residual whitened_residual(const Pose& relative, const Intrinsics& k, double inverse_fx,
                                           double inverse_fy, const TileInput& in, int n) {
  const double depth = in.depth[n];
  const Vec3 lifted{(in.u_source[n] - k.cx) * inverse_fx * depth, (in.v_source[n] - k.cy) * inverse_fy * depth, depth};
  const Pixel pixel = project(k, camera_to_world(relative, lifted));
  return {(in.u_target[n] - pixel.u) * in.inverse_sigma_u[n], (in.v_target[n] - pixel.v) * in.inverse_sigma_v[n]};
}

template <KernelKind kind>
UNI4D_FG_INLINE double tile_energy(const Pose& relative, const Intrinsics& k, double threshold, const TileInput& in) {
  const double inverse_fx = 1.0 / k.fx, inverse_fy = 1.0 / k.fy;
  double squared[kTileRows];
  for (int n = 0; n < in.rows; ++n) {
    const Residual r = whitened_residual(relative, k, inverse_fx, inverse_fy, in, n);
    squared[n] = r.u * r.u + r.v * r.v;
  }
  double terms[kTileRows];
  for (int n = 0; n < in.rows; ++n) terms[n] = in.weight[n] * kernel_rho<kind>(threshold, squared[n]);
  double sum = 0.0;
  for (int n = 0; n < in.rows; ++n) sum += terms[n];
  return sum;
}

/// Columns of both residual rows of every factor, scaled: column j of factor n's u row is [j][n], of its v row
/// [j][kTileRows + n].
using Scratch = double[kColumns][2 * kTileRows];

template <KernelKind kind>
UNI4D_FG_INLINE void tile_columns(const Pose& relative, const Intrinsics& k, double threshold, const TileInput& in,
                                  Scratch& a) {
  const Mat3& rotation = relative.rotation;
  const double inverse_fx = 1.0 / k.fx, inverse_fy = 1.0 / k.fy;
  for (int n = 0; n < in.rows; ++n) {
    const double depth = in.depth[n];
    const Vec3 lifted{(in.u_source[n] - k.cx) * inverse_fx * depth, (in.v_source[n] - k.cy) * inverse_fy * depth,
                      depth};
    const Vec3 x = camera_to_world(relative, lifted);
    const Projection p = project_linearized(k, x);
    double r_u = (in.u_target[n] - p.u) * in.inverse_sigma_u[n], r_v = (in.v_target[n] - p.v) * in.inverse_sigma_v[n];
    const double scale = std::sqrt(in.weight[n] * kernel_weight<kind>(threshold, r_u * r_u + r_v * r_v));
    const double s_u = in.inverse_sigma_u[n] * scale, s_v = in.inverse_sigma_v[n] * scale;
    const double u_x = p.u_x * s_u, u_z = p.u_z * s_u, v_y = p.v_y * s_v, v_z = p.v_z * s_v;
    const double u_0 = u_x * rotation(0, 0) + u_z * rotation(2, 0), u_1 = u_x * rotation(0, 1) + u_z * rotation(2, 1);
    const double v_0 = v_y * rotation(1, 0) + v_z * rotation(2, 0), v_1 = v_y * rotation(1, 1) + v_z * rotation(2, 1);
    const double x_fx = lifted.x * inverse_fx, y_fy = lifted.y * inverse_fy;
    const double d_fx = depth * inverse_fx, d_fy = depth * inverse_fy;
    const int m = kTileRows + n;
    a[0][n] = u_z * x.y;
    a[1][n] = u_x * x.z - u_z * x.x;
    a[2][n] = -u_x * x.y;
    a[3][n] = u_x;
    a[4][n] = 0.0;
    a[5][n] = u_z;
    a[6][n] = u_0 * x_fx - p.u_fx * s_u;
    a[7][n] = u_1 * y_fy;
    a[8][n] = u_0 * d_fx - s_u;
    a[9][n] = u_1 * d_fy;
    a[10][n] = r_u * scale;
    a[0][m] = v_z * x.y - v_y * x.z;
    a[1][m] = -v_z * x.x;
    a[2][m] = v_y * x.x;
    a[3][m] = 0.0;
    a[4][m] = v_y;
    a[5][m] = v_z;
    a[6][m] = v_0 * x_fx;
    a[7][m] = v_1 * y_fy - p.v_fy * s_v;
    a[8][m] = v_0 * d_fx;
    a[9][m] = v_1 * d_fy - s_v;
    a[10][m] = r_v * scale;
  }
}

/// Add the products of one column with itself and the columns after it, summed over the rows of a tile. The sums stay
/// in registers: hence the parameter pack instead of a loop.
template <int kBytes, int column, int... after>
UNI4D_FG_INLINE void add_products(const Scratch& a, int rows, double* sums, std::integer_sequence<int, after...>) {
  using Value = Simd4<kBytes>;
  Value total[sizeof...(after)] = {};
  for (int half = 0; half < 2; ++half)
    for (int n = half * kTileRows; n < half * kTileRows + rows; n += kSimd4Width) {
      const auto left = load<Value>(&a[column][n]);
      ((total[after] += left * load<Value>(&a[column + after][n])), ...);
    }
  ((sums[after] += sum(total[after])), ...);
}

/// Add the Gram matrix of the columns, upper triangle by rows: row `column` has kColumns - column entries.
template <int kBytes, int column>
UNI4D_FG_INLINE void add_gram(const Scratch& a, int rows, double* sums) {
  add_products<kBytes, column>(a, rows, sums, std::make_integer_sequence<int, kColumns - column>());
  if constexpr (column + 1 < kColumns) add_gram<kBytes, column + 1>(a, rows, sums + kColumns - column);
}

template <int kBytes, KernelKind kind>
UNI4D_FG_INLINE void tile_sums(const Pose& relative, const Intrinsics& k, double threshold, const TileInput& in,
                               double* sums) {
  alignas(64) Scratch a;
  tile_columns<kind>(relative, k, threshold, in, a);
  const int padded = (in.rows + kSimd4Width - 1) / kSimd4Width * kSimd4Width;
  for (int n = in.rows; n < padded; ++n)
    for (int j = 0; j < kColumns; ++j) a[j][n] = a[j][kTileRows + n] = 0.0;
  add_gram<kBytes, 0>(a, padded, sums);
}

UNI4D_FG_CLONES double energy_of_tile(const Pose& relative, const Intrinsics& k, const Kernel& kernel,
                                      const TileInput& in) {
  const double c = kernel.threshold;
  switch (kernel.kind) {
    case KernelKind::huber:
      return tile_energy<KernelKind::huber>(relative, k, c, in);
    case KernelKind::pseudo_huber:
      return tile_energy<KernelKind::pseudo_huber>(relative, k, c, in);
    case KernelKind::cauchy:
      return tile_energy<KernelKind::cauchy>(relative, k, c, in);
    case KernelKind::norm:
      return tile_energy<KernelKind::norm>(relative, k, c, in);
    default:
      return tile_energy<KernelKind::quadratic>(relative, k, c, in);
  }
}

template <int kBytes>
UNI4D_FG_INLINE void sum_tile(const Pose& relative, const Intrinsics& k, const Kernel& kernel, const TileInput& in,
                              double* sums) {
  const double c = kernel.threshold;
  switch (kernel.kind) {
    case KernelKind::huber:
      return tile_sums<kBytes, KernelKind::huber>(relative, k, c, in, sums);
    case KernelKind::pseudo_huber:
      return tile_sums<kBytes, KernelKind::pseudo_huber>(relative, k, c, in, sums);
    case KernelKind::cauchy:
      return tile_sums<kBytes, KernelKind::cauchy>(relative, k, c, in, sums);
    case KernelKind::norm:
      return tile_sums<kBytes, KernelKind::norm>(relative, k, c, in, sums);
    default:
      return tile_sums<kBytes, KernelKind::quadratic>(relative, k, c, in, sums);
  }
}

UNI4D_FG_DISPATCH(void, sums_of_tile,
                  (const Pose& relative, const Intrinsics& k, const Kernel& kernel, const TileInput& in, double* sums),
                  (relative, k, kernel, in, sums), sum_tile<kBytes>(relative, k, kernel, in, sums))

}  // namespace

PairSystem::PairSystem(int num_poses, const PairRows& rows, const Kernel& kernel,
                       std::vector<std::int64_t> pose_columns, std::vector<std::int64_t> intrinsics_columns, int size,
                       int threads)
    : num_poses_(num_poses),
      size_(size),
      threads_(threads),
      kernel_(kernel),
      pose_columns_(std::move(pose_columns)),
      intrinsics_columns_(std::move(intrinsics_columns)) {
  const auto count = static_cast<std::size_t>(rows.count);
  std::vector<std::size_t> order(count);
  std::iota(order.begin(), order.end(), std::size_t{0});
  const auto before = [&](std::size_t a, std::size_t b) {
    return std::pair(rows.source[a], rows.target[a]) < std::pair(rows.source[b], rows.target[b]);
  };
  if (!std::is_sorted(order.begin(), order.end(), before)) std::stable_sort(order.begin(), order.end(), before);
  for (std::vector<double>* array :
       {&u_source_, &v_source_, &depth_, &u_target_, &v_target_, &inverse_sigma_u_, &inverse_sigma_v_, &weight_})
    array->resize(count);
  for (std::size_t i = 0; i < count; ++i) {
    const std::size_t n = order[i];
    u_source_[i] = rows.uv_source[2 * n];
    v_source_[i] = rows.uv_source[2 * n + 1];
    depth_[i] = rows.depth[n];
    u_target_[i] = rows.uv_target[2 * n];
    v_target_[i] = rows.uv_target[2 * n + 1];
    const std::size_t columns = static_cast<std::size_t>(rows.sigma_columns);
    inverse_sigma_u_[i] = 1.0 / rows.sigma[columns * n];
    inverse_sigma_v_[i] = 1.0 / rows.sigma[columns * n + columns - 1];
    weight_[i] = rows.weight[n];
    const int row = static_cast<int>(i);
    const Pair pair{static_cast<int>(rows.source[n]), static_cast<int>(rows.target[n]), row, row};
    if (pairs_.empty() || pairs_.back().source != pair.source || pairs_.back().target != pair.target)
      pairs_.push_back(pair);
    pairs_.back().end = row + 1;
  }
}

std::vector<Pose> PairSystem::relative_poses(const double* poses) const {
  std::vector<Pose> relative;
  relative.reserve(pairs_.size());
  for (const Pair& pair : pairs_)
    relative.push_back(relative_pose(load_pose(poses + 16 * pair.target), load_pose(poses + 16 * pair.source)));
  return relative;
}

template <typename F>
void PairSystem::for_pairs(F f) const {
  const int threads = useful_threads(threads_, static_cast<int>(weight_.size()), kRowsPerThread);
  parallel_for(static_cast<int>(pairs_.size()), threads, [&](int begin, int end, int) {
    for (int i = begin; i < end; ++i) f(static_cast<std::size_t>(i));
  });
}

template <typename F>
void PairSystem::for_tiles(const Pair& pair, F f) const {
  for (int begin = pair.begin; begin < pair.end; begin += kTileRows) {
    const auto at = static_cast<std::size_t>(begin);
    f(TileInput{&u_source_[at],        &v_source_[at], &depth_[at],
                &u_target_[at],        &v_target_[at], &inverse_sigma_u_[at],
                &inverse_sigma_v_[at], &weight_[at],   std::min(pair.end - begin, kTileRows)});
  }
}

double PairSystem::energy(const double* poses, const double* intrinsics) const {
  const Intrinsics k = load_intrinsics(intrinsics);
  const std::vector<Pose> relative = relative_poses(poses);
  std::vector<double> energies(pairs_.size(), 0.0);
  for_pairs([&](std::size_t i) {
    for_tiles(pairs_[i], [&](const TileInput& in) { energies[i] += energy_of_tile(relative[i], k, kernel_, in); });
  });
  return std::accumulate(energies.begin(), energies.end(), 0.0);
}

void PairSystem::linearize(const double* poses, const double* intrinsics, double* hessian, double* gradient) const {
  const Intrinsics k = load_intrinsics(intrinsics);
  const std::vector<Pose> relative = relative_poses(poses);
  std::vector<double> sums(pairs_.size() * kSums, 0.0);
  for_pairs([&](std::size_t i) {
    for_tiles(pairs_[i],
              [&](const TileInput& in) { sums_of_tile(relative[i], k, kernel_, in, sums.data() + kSums * i); });
  });
  std::fill(hessian, hessian + static_cast<std::size_t>(size_) * static_cast<std::size_t>(size_), 0.0);
  std::fill(gradient, gradient + size_, 0.0);
  for (std::size_t i = 0; i < pairs_.size(); ++i)
    spread(pairs_[i], relative[i], &sums[kSums * i], hessian, gradient);
}

void PairSystem::spread(const Pair& pair, const Pose& target_T_source, const double* sums, double* hessian,
                        double* gradient) const {
  // (target twist, intrinsics, residual) in full, then twist of the source = -Ad^T twist of the target.
  double full[kColumns][kColumns];
  for (int i = 0, at = 0; i < kColumns; ++i)
    for (int j = i; j < kColumns; ++j, ++at) full[i][j] = full[j][i] = sums[at];
  double adjoint[6][6] = {};
  const Mat3 lower = skew(target_T_source.center) * target_T_source.rotation;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      adjoint[i][j] = adjoint[3 + i][3 + j] = target_T_source.rotation(i, j);
      adjoint[3 + i][j] = lower(i, j);
    }
  // Rows of `moved`: the source twist times every column of `full`.
  double moved[6][kColumns], source_source[6][6];
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < kColumns; ++j) {
      double sum = 0.0;
      for (int m = 0; m < 6; ++m) sum -= adjoint[m][i] * full[m][j];
      moved[i][j] = sum;
    }
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) {
      double sum = 0.0;
      for (int m = 0; m < 6; ++m) sum -= moved[i][m] * adjoint[m][j];
      source_source[i][j] = sum;
    }
  // Order of the pair's sixteen entries: source twist, target twist, intrinsics.
  std::int64_t columns[16];
  for (int i = 0; i < 6; ++i) {
    columns[i] = pose_columns_[static_cast<std::size_t>(6 * pair.source + i)];
    columns[6 + i] = pose_columns_[static_cast<std::size_t>(6 * pair.target + i)];
  }
  for (int i = 0; i < 4; ++i) columns[12 + i] = intrinsics_columns_[static_cast<std::size_t>(i)];
  const auto entry = [&](int i, int j) {
    if (i < 6) return j < 6 ? source_source[i][j] : moved[i][j - 6];
    return j < 6 ? moved[j][i - 6] : full[i - 6][j - 6];
  };
  for (int i = 0; i < 16; ++i) {
    if (columns[i] < 0) continue;
    gradient[columns[i]] += i < 6 ? moved[i][kColumns - 1] : full[i - 6][kColumns - 1];
    for (int j = 0; j < 16; ++j)
      if (columns[j] >= 0) hessian[columns[i] * size_ + columns[j]] += entry(i, j);
  }
}

}  // namespace uni4d_fg
