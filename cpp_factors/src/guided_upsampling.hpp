// Joint bilateral upsampling: a map brought to the size of an image, with the image's edges.
//
// `results/fusion/upsampling.py` is the same in NumPy, and says what it is for.
#pragma once

#include <cstdint>

namespace uni4d_fg {

/// Standard deviations of the weights, by distance in pixels of the map and by color, of 255.
struct GuidedWeights {
  float spatial = 1.0F, color = 1.0F;
};

/// A map (h, w), NaN where missing, and the image at its size, (h, w, 3) of 255.
struct CoarseMap {
  const float* values = nullptr;
  const float* colors = nullptr;
  int height = 0, width = 0;
};

/// `out` (height, width): the map at the size of `image` (height, width, 3); NaN where all around is.
void upsample_guided(const CoarseMap& coarse, const std::uint8_t* image, int height, int width,
                     const GuidedWeights& weights, int threads, float* out);

}  // namespace uni4d_fg
