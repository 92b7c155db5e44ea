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

/// tile (7, 8) += sum over the landmarks `shared` of A^T B with A, B (3, 8); row 7 is not used.
UNI4D_FG_INLINE void multiply(std::uint64_t shared, const Places& at, double* tile) {
  Simd8 sums[kFrameColumns] = {};
  while (shared != 0) {
    const int landmark = lowest_bit(shared);
    shared &= shared - 1;
    const double* a = at.rows + static_cast<std::size_t>(at.row_place[landmark]) * kWidth;
    const int column = at.column_place != nullptr ? at.column_place[landmark] : landmark;
    const double* b = at.columns + static_cast<std::size_t>(column) * kWidth;
    for (int k = 0; k < 3; ++k) {
      const Simd8 right = load_simd8(b + k * kSimd8Width);
      for (int row = 0; row < kFrameColumns; ++row) sums[row] += a[k * kSimd8Width + row] * right;
    }
  }
  for (int row = 0; row < kFrameColumns; ++row)
    store_simd8(load_simd8(tile + row * kSimd8Width) + sums[row], tile + row * kSimd8Width);
}

constexpr int kScale = kFrameColumns - 1;
constexpr std::size_t kTile = kFrameColumns * kSimd8Width;

/// The border with itself, over all landmarks of the chunk: its rows of landmarks that are not there are 0.
UNI4D_FG_INLINE void multiply_corner(const TileInput& in) {
  int own[kChunkLandmarks];
  for (int i = 0; i < kChunkLandmarks; ++i) own[i] = i;
  multiply(~std::uint64_t{0}, {in.border, own, in.border, nullptr}, in.corner_tile);
}

UNI4D_FG_INLINE void multiply_all(const LandmarkChunk& chunk, const TileInput& in) {
  const int* frames = chunk.frames.data();
  const std::uint64_t* seen = chunk.seen.data();
  const std::size_t count = chunk.frames.size();
  for (std::size_t i = 0; i < count; ++i) {
    const auto frame = static_cast<std::size_t>(frames[i]);
    const int* place = in.place + i * kChunkLandmarks;
    multiply(seen[i], {in.whitened, place, in.border, nullptr}, in.border_tiles + frame * kTile);
    for (std::size_t j = i; j < count; ++j) {
      const std::uint64_t shared = seen[i] & seen[j];
      if (shared == 0) continue;
      double* tile = in.tiles + static_cast<std::size_t>(in.tile_begin[frame] + frames[j] - frames[i]) * kTile;
      multiply(shared, {in.whitened, place, in.whitened, in.place + j * kChunkLandmarks}, tile);
    }
  }
  multiply_corner(in);
}

}  // namespace

UNI4D_FG_WIDE_CLONES void whiten_pairs(const LandmarkChunk& chunk, const double* coupling, const double* factors,
                                       double* whitened) {
  const std::uint8_t* landmark = chunk.pair_landmark.data();
  const auto pairs = static_cast<std::size_t>(chunk.num_pairs());
  // Forward substitution on three rows of eight columns at once: a row is one Simd8.
  for (std::size_t i = 0; i < pairs; ++i) {
    const double* in = coupling + i * kWidth;
    const double* f = factors + 6 * landmark[i];
    double* out = whitened + i * kWidth;
    const Simd8 first = load_simd8(in) * f[0];
    const Simd8 second = (load_simd8(in + kSimd8Width) - f[1] * first) * f[2];
    const Simd8 third = (load_simd8(in + 2 * kSimd8Width) - f[3] * first - f[4] * second) * f[5];
    store_simd8(first, out);
    store_simd8(second, out + kSimd8Width);
    store_simd8(third, out + 2 * kSimd8Width);
  }
}

UNI4D_FG_WIDE_CLONES void multiply_tiles(const LandmarkChunk& chunk, const TileInput& in) {
  multiply_all(chunk, in);
}

UNI4D_FG_WIDE_CLONES void multiply_scales(const LandmarkChunk& chunk, const double* coupling, const double* factors,
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
    Simd8 with_border{};
    for (int n = 0; n < kScaleRow; ++n) with_border += own[n] * load_simd8(in.border + n * kSimd8Width);
    double* border_row = in.border_tiles + frame * kTile + kScale * kSimd8Width;
    store_simd8(load_simd8(border_row) + with_border, border_row);
    double* tiles = in.tiles + in.tile_begin[frame] * static_cast<std::int64_t>(kTile) + kEntry;
    for (std::size_t j = i; j < count; ++j) {
      if ((seen[i] & seen[j]) == 0) continue;
      const double* other = rows + j * kScaleRow;
      Simd8 even{}, odd{};
      for (int n = 0; n < kScaleRow; n += 2 * kSimd8Width) {
        even += load_simd8(own + n) * load_simd8(other + n);
        odd += load_simd8(own + n + kSimd8Width) * load_simd8(other + n + kSimd8Width);
      }
      tiles[static_cast<std::size_t>(frames[j] - frames[i]) * kTile] += sum(even + odd);
    }
  }
  multiply_corner(in);
}

UNI4D_FG_WIDE_CLONES void apply_coupling(const LandmarkChunk& chunk, const double* coupling, const double* frame_step,
                                         double* out) {
  const std::uint8_t* landmark = chunk.pair_landmark.data();
  const int* frames = chunk.frames.data();
  const int* begin = chunk.frame_begin.data();
  const std::size_t count = chunk.frames.size();
  for (std::size_t f = 0; f < count; ++f) {
    const Simd8 step = load_simd8(frame_step + static_cast<std::size_t>(frames[f]) * kSimd8Width);
    for (int i = begin[f]; i < begin[f + 1]; ++i) {
      const double* in = coupling + static_cast<std::size_t>(i) * kWidth;
      double* point = out + 3 * landmark[i];
      for (int k = 0; k < 3; ++k) point[k] += sum(load_simd8(in + k * kSimd8Width) * step);
    }
  }
}

}  // namespace uni4d_fg::landmark_passes
