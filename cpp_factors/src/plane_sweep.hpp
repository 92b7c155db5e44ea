// Multi-view depth of one image: a cost volume over planes of inverse depth, aggregated semi-globally.
//
// Collins 1996 (plane sweep), Hirschmueller 2008 (semi-global matching). `results/fusion/multiview/sweep_numpy.py` is
// the same in NumPy.
#pragma once

#include <cstdint>
#include <vector>

namespace uni4d_fg {

/// One other image and where it sees the reference: pixel x at inverse depth rho is at `turn` (x, y, 1) + rho `shift`.
struct SweepView {
  const float* image = nullptr;  // (H, W), NaN where nothing may be matched
  float turn[9] = {};
  float shift[3] = {};
};

struct SweepOptions {
  int radius = 2;                   // half side of the matching window, px
  float noise = 0.01F;              // standard deviation of the images' noise, in their unit
  float difference_share = 0.4F;    // part of the cost that differences of gray values are, beside correlation
  float largest_difference = 0.1F;  // larger differences are all alike
  int small_step = 30;              // penalty of a change by one plane, where the image is flat
  int large_step = 100;             // penalty of a larger one, alike
  float edge_contrast = 0.05F;      // image difference that halves the penalty of a large change
  int threads = 1;
};

/// Per pixel of the reference, (H, W): the best plane (refined between planes), the aggregated cost there, that of
/// the best plane elsewhere, and the matching cost, 0 to 255, there.
struct SweepResult {
  std::vector<float> plane, cost, rival, match;
};

/// `image` (H, W), NaN where the reference is not to be matched; `inverse_depth` of the planes, ascending, at most 256.
SweepResult plane_sweep(const float* image, int height, int width, const std::vector<SweepView>& views,
                        const std::vector<float>& inverse_depth, const SweepOptions& options);

}  // namespace uni4d_fg
