// The products of the elimination. Two frames of a chunk share the landmarks in the intersection of two bit masks;
// their 7x8 tile of E V^{-1} E^T stays in registers over all of them. Of cameras that are frozen but for their
// log-scales one entry of a tile is left: a product of two rows over all landmarks of the chunk.
#include <algorithm>

#include "landmark_cholesky.hpp"
#include "landmark_passes.hpp"

namespace uni4d_fg::landmark_passes {

namespace {

/// Index of the lowest bit that is set.
UNI4D_FG_INLINE int lowest_bit(std::uint64_t mask) {
#if defined(__GNUC__) || defined(__clang__)
  return __builtin_ctzll(mask);
#else
  int bit = 0;
  while ((mask >> bit & 1) == 0) ++bit;
  return bit;
#endif
}

/// The two factors of a product: whitened blocks (3, 8), and which of them belongs to landmark 0..63 of the chunk.
struct Places {
  const double* rows;
  const int* row_place;
  const double* columns;
  const int* column_place;  ///< null: the landmark itself
};

/// Rows `first` to `end` of tile (7, 8) += sum over the landmarks `shared` of A^T B with A, B (3, 8).
template <int kBytes, int first, int end>
UNI4D_FG_INLINE void multiply_rows(std::uint64_t shared, const Places& at, double* tile) {
  Simd8<kBytes> sums[end - first] = {};
  while (shared != 0) {
    const int landmark = lowest_bit(shared);
    shared &= shared - 1;
    const double* a = at.rows + static_cast<std::size_t>(at.row_place[landmark]) * kWidth;
    const int column = at.column_place != nullptr ? at.column_place[landmark] : landmark;
    const double* b = at.columns + static_cast<std::size_t>(column) * kWidth;
    for (int k = 0; k < 3; ++k) {
      const auto right = load<Simd8<kBytes>>(b + k * kSimd8Width);
      for (int row = first; row < end; ++row) sums[row - first] += a[k * kSimd8Width + row] * right;
    }
  }
  for (int row = first; row < end; ++row)
    store(load<Simd8<kBytes>>(tile + row * kSimd8Width) + sums[row - first], tile + row * kSimd8Width);
}

/// tile (7, 8) += sum over the landmarks `shared` of A^T B with A, B (3, 8); row 7 is not used. As many rows at once as
/// registers hold: a processor has 32 of 64 bytes, and 16 of those that are less wide.
template <int kBytes>
UNI4D_FG_INLINE void multiply(std::uint64_t shared, const Places& at, double* tile) {
  if constexpr (kBytes == 64) {
    multiply_rows<kBytes, 0, kFrameColumns>(shared, at, tile);
  } else if constexpr (kBytes == 32) {
    multiply_rows<kBytes, 0, 4>(shared, at, tile);
    multiply_rows<kBytes, 4, kFrameColumns>(shared, at, tile);
  } else {
    multiply_rows<kBytes, 0, 2>(shared, at, tile);
    multiply_rows<kBytes, 2, 4>(shared, at, tile);
    multiply_rows<kBytes, 4, 6>(shared, at, tile);
    multiply_rows<kBytes, 6, kFrameColumns>(shared, at, tile);
  }
}

constexpr int kScale = kFrameColumns - 1;
constexpr std::size_t kTile = kFrameColumns * kSimd8Width;

/// The border with itself, over all landmarks of the chunk: its rows of landmarks that are not there are 0.
template <int kBytes>
UNI4D_FG_INLINE void multiply_corner(const TileInput& in) {
  int own[kChunkLandmarks];
  for (int i = 0; i < kChunkLandmarks; ++i) own[i] = i;
  multiply<kBytes>(~std::uint64_t{0}, {in.border, own, in.border, nullptr}, in.corner_tile);
}

template <int kBytes>
UNI4D_FG_INLINE void multiply_all(const LandmarkChunk& chunk, const TileInput& in) {
  const int* frames = chunk.frames.data();
  const std::uint64_t* seen = chunk.seen.data();
  const std::size_t count = chunk.frames.size();
  for (std::size_t i = 0; i < count; ++i) {
    const auto frame = static_cast<std::size_t>(frames[i]);
    const int* place = in.place + i * kChunkLandmarks;
    multiply<kBytes>(seen[i], {in.whitened, place, in.border, nullptr}, in.border_tiles + frame * kTile);
    for (std::size_t j = i; j < count; ++j) {
      const std::uint64_t shared = seen[i] & seen[j];
      if (shared == 0) continue;
      double* tile = in.tiles + static_cast<std::size_t>(in.tile_begin[frame] + frames[j] - frames[i]) * kTile;
      multiply<kBytes>(shared, {in.whitened, place, in.whitened, in.place + j * kChunkLandmarks}, tile);
    }
  }
  multiply_corner<kBytes>(in);
}

template <int kBytes>
UNI4D_FG_INLINE void whiten(const LandmarkChunk& chunk, const double* coupling, const double* factors,
                            double* whitened) {
  const std::uint8_t* landmark = chunk.pair_landmark.data();
  const auto pairs = static_cast<std::size_t>(chunk.num_pairs());
  // Forward substitution on three rows of eight columns at once: a row is one Simd8<kBytes>.
  for (std::size_t i = 0; i < pairs; ++i) {
    const double* in = coupling + i * kWidth;
    const double* f = factors + 6 * landmark[i];
    double* out = whitened + i * kWidth;
    const Simd8<kBytes> first = load<Simd8<kBytes>>(in) * f[0];
    const Simd8<kBytes> second = (load<Simd8<kBytes>>(in + kSimd8Width) - f[1] * first) * f[2];
    const Simd8<kBytes> third = (load<Simd8<kBytes>>(in + 2 * kSimd8Width) - f[3] * first - f[4] * second) * f[5];
    store(first, out);
    store(second, out + kSimd8Width);
    store(third, out + 2 * kSimd8Width);
  }
}

template <int kBytes>
UNI4D_FG_INLINE void multiply_log_scales(const LandmarkChunk& chunk, const double* coupling, const double* factors,
                                         double* rows, const TileInput& in) {
  const std::uint8_t* landmark = chunk.pair_landmark.data();
  const int* frames = chunk.frames.data();
  const int* begin = chunk.frame_begin.data();
  const std::uint64_t* seen = chunk.seen.data();
  const std::size_t count = chunk.frames.size();
  std::fill_n(rows, count * kScaleRow, 0.0);
  for (std::size_t f = 0; f < count; ++f)
    for (int i = begin[f]; i < begin[f + 1]; ++i) {
      const double* e = coupling + static_cast<std::size_t>(i) * kWidth + kScale;
      double x[3] = {e[0], e[kSimd8Width], e[2 * kSimd8Width]};
      landmark_cholesky::solve_lower(factors + 6 * landmark[i], x);
      double* at = rows + f * kScaleRow + 3 * landmark[i];
      for (int k = 0; k < 3; ++k) at[k] = x[k];
    }
  constexpr std::size_t kEntry = kScale * kSimd8Width + kScale;
  for (std::size_t i = 0; i < count; ++i) {
    const double* own = rows + i * kScaleRow;
    const auto frame = static_cast<std::size_t>(frames[i]);
    Simd8<kBytes> with_border{};
    for (int n = 0; n < kScaleRow; ++n) with_border += own[n] * load<Simd8<kBytes>>(in.border + n * kSimd8Width);
    double* border_row = in.border_tiles + frame * kTile + kScale * kSimd8Width;
    store(load<Simd8<kBytes>>(border_row) + with_border, border_row);
    double* tiles = in.tiles + in.tile_begin[frame] * static_cast<std::int64_t>(kTile) + kEntry;
    for (std::size_t j = i; j < count; ++j) {
      if ((seen[i] & seen[j]) == 0) continue;
      const double* other = rows + j * kScaleRow;
      Simd8<kBytes> even{}, odd{};
      for (int n = 0; n < kScaleRow; n += 2 * kSimd8Width) {
        even += load<Simd8<kBytes>>(own + n) * load<Simd8<kBytes>>(other + n);
        odd += load<Simd8<kBytes>>(own + n + kSimd8Width) * load<Simd8<kBytes>>(other + n + kSimd8Width);
      }
      tiles[static_cast<std::size_t>(frames[j] - frames[i]) * kTile] += sum(even + odd);
    }
  }
  multiply_corner<kBytes>(in);
}

template <int kBytes>
UNI4D_FG_INLINE void apply(const LandmarkChunk& chunk, const double* coupling, const double* frame_step, double* out) {
  const std::uint8_t* landmark = chunk.pair_landmark.data();
  const int* frames = chunk.frames.data();
  const int* begin = chunk.frame_begin.data();
  const std::size_t count = chunk.frames.size();
  for (std::size_t f = 0; f < count; ++f) {
    const Simd8<kBytes> step = load<Simd8<kBytes>>(frame_step + static_cast<std::size_t>(frames[f]) * kSimd8Width);
    for (int i = begin[f]; i < begin[f + 1]; ++i) {
      const double* in = coupling + static_cast<std::size_t>(i) * kWidth;
      double* point = out + 3 * landmark[i];
      for (int k = 0; k < 3; ++k) point[k] += sum(load<Simd8<kBytes>>(in + k * kSimd8Width) * step);
    }
  }
}

}  // namespace

UNI4D_FG_DISPATCH(void, whiten_pairs,
                  (const LandmarkChunk& chunk, const double* coupling, const double* factors, double* whitened),
                  (chunk, coupling, factors, whitened), whiten<kBytes>(chunk, coupling, factors, whitened))

UNI4D_FG_DISPATCH(void, multiply_tiles, (const LandmarkChunk& chunk, const TileInput& in), (chunk, in),
                  multiply_all<kBytes>(chunk, in))

UNI4D_FG_DISPATCH(void, multiply_scales,
                  (const LandmarkChunk& chunk, const double* coupling, const double* factors, double* rows,
                   const TileInput& in),
                  (chunk, coupling, factors, rows, in), multiply_log_scales<kBytes>(chunk, coupling, factors, rows, in))

UNI4D_FG_DISPATCH(void, apply_coupling,
                  (const LandmarkChunk& chunk, const double* coupling, const double* frame_step, double* out),
                  (chunk, coupling, frame_step, out), apply<kBytes>(chunk, coupling, frame_step, out))

}  // namespace uni4d_fg::landmark_passes
