// Registration of patches: where each one's first view is found in an image, under an affine warp.
#pragma once

#include <cstdint>

namespace uni4d_fg {

/// What the patches have in common.
struct PatchSettings {
  int half = 7;                   ///< The patch has 2 half + 1 pixels a side, a template one more on each side.
  const double* weight = nullptr; ///< (2 half + 1)^2, row by row.
  double stiffness = 0.0;         ///< What holds the affine part where it starts: gray levels squared.
  int max_iterations = 0;
  double convergence_px = 0.0;
};

/// Gray image, row by row.
struct GrayImage {
  const std::uint8_t* data = nullptr;
  int height = 0;
  int width = 0;
};

/// Register `count` of the templates, each (2 half + 3)^2 with NaN where it left its image, by the inverse compositional
/// algorithm (Baker and Matthews 2004) on differences of patches of equal mean and deviation. `warp` (count, 6) holds
/// u, v and the affine part by rows; it is replaced by the result. `correlation` is -1 where there is none.
void register_patches(const float* templates, const std::int64_t* rows, int count, const GrayImage& image,
                      const PatchSettings& settings, int threads, double* warp, double* correlation);

}  // namespace uni4d_fg
