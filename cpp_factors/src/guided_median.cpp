#include "guided_median.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

#include "exp_minus.hpp"
#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

namespace {

/// Pixels of a row that are worked on together, so few that what is around all of them stays in the cache.
constexpr int kChunk = 2 * kSimdFloatWidth;

/// The map with a margin at either side of its rows, in which nothing weighs anything: what is around a pixel needs no
/// test. One plane for each quantity; what weighs nothing is 0 in all.
struct Planes {
  std::ptrdiff_t stride;
  std::vector<float> value, weight, down, right, red, green, blue;

  Planes(const WeightedMap& map, int margin) : stride(map.width + 2 * margin + kChunk) {
    for (std::vector<float>* plane : {&value, &weight, &down, &right, &red, &green, &blue})
      plane->assign(static_cast<std::size_t>(stride * map.height), 0.0F);
    for (int y = 0; y < map.height; ++y)
      for (int x = 0; x < map.width; ++x) {
        const std::ptrdiff_t from = static_cast<std::ptrdiff_t>(y) * map.width + x;
        const auto to = static_cast<std::size_t>(y * stride + margin + x);
        red[to] = map.colors[3 * from];
        green[to] = map.colors[3 * from + 1];
        blue[to] = map.colors[3 * from + 2];
        if (!(map.weights[from] > 0.0F)) continue;
        weight[to] = map.weights[from];
        value[to] = map.values[from];
        down[to] = map.slopes[2 * from];
        right[to] = map.slopes[2 * from + 1];
      }
  }
};

/// For a chunk of pixels, what the plane through one pixel around each is there, and how much it weighs.
UNI4D_FG_WIDE_CLONES void look_at_tap(const float* __restrict value, const float* __restrict weight,
                                      const float* __restrict down, const float* __restrict right,
                                      const float* __restrict red, const float* __restrict green,
                                      const float* __restrict blue, std::ptrdiff_t away, float dy, float dx, float far,
                                      float steepest, float* __restrict found, float* __restrict weighed) {
  for (std::ptrdiff_t k = 0; k < kChunk; ++k) {
    const float r = red[k + away] - red[k], g = green[k + away] - green[k], b = blue[k + away] - blue[k];
    const float back = -(dy * down[k + away] + dx * right[k + away]);
    const float above = back > -steepest ? back : -steepest, part = above < steepest ? above : steepest;
    found[k] = value[k + away] * (1.0F + part);
    const float unlike = r * r + g * g + b * b + far;
    weighed[k] = weight[k + away] * exp_minus(unlike < kFarthest ? unlike : kFarthest);
  }
}

/// Per lane the least of `count` values (count, kChunk) with half of the weight up to it, for as many pixels as a SIMD
/// value holds; values that weigh nothing are none of those.
///
/// Instead of being sorted, they are narrowed down: `least` and `most` are values, and the one that is sought lies
/// between. A pivot is put where it would be if the weight were spread evenly between them; now and then in the middle,
/// as that guess may come near from one side only. Of the values on the pivot's other side than the one that is sought
/// the nearest is the next bound, so that each turn rules out one at least.
template <int kBytes>
UNI4D_FG_INLINE void middle_of(const float* values, const float* weights, int count, float* out) {
  using Lanes = SimdFloat<kBytes>;
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  constexpr float kMostGuess = 0.999F;
  Lanes least, most, below, half;
  for (int i = 0; i < Lanes::kParts; ++i) {
    const typename Lanes::Part zero{};
    least.part[i] = kInfinity + zero;
    most.part[i] = -kInfinity + zero;
    below.part[i] = zero;
    half.part[i] = zero;
  }
  for (int n = 0; n < count; ++n) {
    const Lanes value = load<Lanes>(values + n * kChunk), weight = load<Lanes>(weights + n * kChunk);
    half += weight;
    for (int i = 0; i < Lanes::kParts; ++i) {
      const auto low = weight.part[i] > 0 ? value.part[i] : least.part[i];
      const auto high = weight.part[i] > 0 ? value.part[i] : most.part[i];
      least.part[i] = low < least.part[i] ? low : least.part[i];
      most.part[i] = high > most.part[i] ? high : most.part[i];
    }
  }
  Lanes upto = half;
  half = 0.5F * half;
  for (int turn = 0; turn < count; ++turn) {
    bool is_done = true;
    for (int lane = 0; lane < kSimdFloatWidth; ++lane) is_done &= !(least[lane] < most[lane]);
    if (is_done) break;
    Lanes pivot, mass, before, after;
    for (int i = 0; i < Lanes::kParts; ++i) {
      const typename Lanes::Part zero{};
      auto share = (half.part[i] - below.part[i]) / (upto.part[i] - below.part[i]);
      share = share < kMostGuess ? share : kMostGuess + zero;
      if (turn % 3 == 2) share = 0.5F + zero;
      const auto between = least.part[i] + share * (most.part[i] - least.part[i]);
      pivot.part[i] = (between >= least.part[i]) & (between < most.part[i]) ? between : least.part[i];
      mass.part[i] = zero;
      before.part[i] = -kInfinity + zero;
      after.part[i] = kInfinity + zero;
    }
    for (int n = 0; n < count; ++n) {
      const Lanes value = load<Lanes>(values + n * kChunk), weight = load<Lanes>(weights + n * kChunk);
      for (int i = 0; i < Lanes::kParts; ++i) {
        const typename Lanes::Part zero{};
        const auto is_below = value.part[i] <= pivot.part[i];
        mass.part[i] += is_below ? weight.part[i] : zero;
        const auto low = is_below & (weight.part[i] > 0) ? value.part[i] : before.part[i];
        const auto high = (value.part[i] > pivot.part[i]) & (weight.part[i] > 0) ? value.part[i] : after.part[i];
        before.part[i] = low > before.part[i] ? low : before.part[i];
        after.part[i] = high < after.part[i] ? high : after.part[i];
      }
    }
    for (int i = 0; i < Lanes::kParts; ++i) {
      const auto is_open = least.part[i] < most.part[i];
      const auto is_enough = mass.part[i] >= half.part[i], is_short = mass.part[i] < half.part[i];
      most.part[i] = is_open & is_enough ? before.part[i] : most.part[i];
      upto.part[i] = is_open & is_enough ? mass.part[i] : upto.part[i];
      least.part[i] = is_open & is_short ? after.part[i] : least.part[i];
      below.part[i] = is_open & is_short ? mass.part[i] : below.part[i];
    }
  }
  store(most, out);
}

/// Registers of 32 bytes at most: GCC 12 takes two conditions that are joined apart lane by lane where they are of 64
/// bytes, which is thirty times as slow.
constexpr int bytes_for_conditions(int bytes) { return bytes < 32 ? bytes : 32; }

UNI4D_FG_DISPATCH(void, middle_of_chunk, (const float* values, const float* weights, int count, float* out),
                  (values, weights, count, out),
                  for (int k = 0; k < kChunk; k += kSimdFloatWidth)
                      middle_of<bytes_for_conditions(kBytes)>(values + k, weights + k, count, out + k))

}  // namespace

void guided_median(const WeightedMap& map, const std::uint8_t* chosen, const MedianWindow& window, float* out) {
  const int side = 2 * window.reach / window.step + 1;
  const auto most = static_cast<std::size_t>(side * side * kChunk);
  std::vector<float> values(most), weights(most), middle(kChunk);
  const Planes planes(map, window.reach);
  const float scale = 0.5F / (window.spatial * window.spatial);
  for (int y = 0; y < map.height; ++y)
    for (int x = 0; x < map.width; x += kChunk) {
      const std::ptrdiff_t first = static_cast<std::ptrdiff_t>(y) * map.width + x;
      const int width = std::min(kChunk, map.width - x);
      std::copy(map.values + first, map.values + first + width, out + first);
      if (std::none_of(chosen + first, chosen + first + width, [](std::uint8_t one) { return one != 0; })) continue;
      const std::ptrdiff_t own = y * planes.stride + window.reach + x;
      std::size_t count = 0;
      for (int dy = -window.reach; dy <= window.reach; dy += window.step) {
        if (y + dy < 0 || y + dy >= map.height) continue;
        for (int dx = -window.reach; dx <= window.reach; dx += window.step, ++count)
          look_at_tap(planes.value.data() + own, planes.weight.data() + own, planes.down.data() + own,
                      planes.right.data() + own, planes.red.data() + own, planes.green.data() + own,
                      planes.blue.data() + own, dy * planes.stride + dx, static_cast<float>(dy), static_cast<float>(dx),
                      scale * static_cast<float>(dy * dy + dx * dx), window.steepest, &values[count * kChunk],
                      &weights[count * kChunk]);
      }
      middle_of_chunk(values.data(), weights.data(), static_cast<int>(count), middle.data());
      // Not finite where nothing around weighs anything.
      for (int k = 0; k < width; ++k)
        if (chosen[first + k] != 0 && std::isfinite(middle[static_cast<std::size_t>(k)]))
          out[first + k] = middle[static_cast<std::size_t>(k)];
    }
}

}  // namespace uni4d_fg
