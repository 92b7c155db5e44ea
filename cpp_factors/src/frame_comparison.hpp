// What the depth maps of other frames say of one frame's, pixel by pixel.
//
// `results/fusion/averaging.py` is the same in NumPy, and says what it is for.
#pragma once

#include <vector>

namespace uni4d_fg {

/// The inverse depth (H, W) of another frame, NaN where missing, and where that frame sees pixels of the first one:
/// pixel x at inverse depth rho is at `turn` (x, y, 1) + rho `shift`, whose third entry is z over the first depth.
struct ComparedFrame {
  const float* inverse_depth = nullptr;
  int height = 0, width = 0;
  float turn[9] = {};
  float shift[3] = {};
};

/// Two frames agree, or are alike, where the ratio of their depths is below this and above its inverse.
struct ComparisonBounds {
  float agree = 1.0F, alike = 1.0F;
};

/// Sums over the other frames, (H, W) each, written: `product` of the depth ratios of those that agree, and how many
/// agree, have depth there, and are alike.
struct ComparisonSums {
  float *product, *agreeing, *seeing, *alike;
};

void compare_frames(const float* inverse_depth, int height, int width, const std::vector<ComparedFrame>& others,
                    const ComparisonBounds& bounds, int threads, const ComparisonSums& sums);

}  // namespace uni4d_fg
