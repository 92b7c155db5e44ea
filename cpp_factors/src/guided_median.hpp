// A weighted median of the planes around chosen pixels, guided by the colors of an image.
//
// `results/fusion/guided_median.py` is the same in NumPy, and says what it is for.
#pragma once

#include <cstdint>

namespace uni4d_fg {

/// What is looked at around a pixel: every `step`-th pixel of a window of half side `reach`, less by distance.
struct MedianWindow {
  int reach = 12, step = 4;
  float spatial = 6.0F;   // standard deviation of the weights by distance, pixels
  float steepest = 0.3F;  // a plane changes a value by at most this part on its way
};

/// A map (height, width) that is finite where its weight is above 0.
///
/// Slopes (height, width, 2) say by what part it grows from a pixel to the one below and to the one on its right;
/// colors (height, width, 3) are in units of sqrt(2) standard deviations of the weights by color.
struct WeightedMap {
  const float* values = nullptr;
  const float* weights = nullptr;
  const float* slopes = nullptr;
  const float* colors = nullptr;
  int height = 0, width = 0;
};

/// `out` (height, width): the map, with a weighted median where `chosen` is not 0.
void guided_median(const WeightedMap& map, const std::uint8_t* chosen, const MedianWindow& window, float* out);

}  // namespace uni4d_fg
