// Edges of swept depth, looked at again: near an edge, each pixel chooses among the depths around it.
//
// Yoon and Kweon 2006 (weights by likeness). `results/fusion/multiview/edges_numpy.py` is the same in NumPy and says
// why.
#pragma once

#include <cstdint>
#include <vector>

#include "plane_sweep.hpp"

namespace uni4d_fg {

/// The inverse depth (H, W), positive, of `image` (H, W), in which pixels near edges that are `chosen` (H, W) have the
/// best one of those around them; where the image is NaN, it stays.
std::vector<float> depth_edges(const float* inverse_depth, const float* image, const std::uint8_t* chosen, int height,
                               int width, const std::vector<SweepView>& views, int threads);

}  // namespace uni4d_fg
