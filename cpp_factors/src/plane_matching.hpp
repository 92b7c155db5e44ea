// How well an image matches others on planes of inverse depth: normalized cross-correlation over windows, and
// differences of gray values over narrower ones.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "plane_sweep.hpp"

namespace uni4d_fg {

/// Matching costs of an image, 0 to 255, row by row, planes innermost; 128 where nothing is known.
class PlaneMatching {
 public:
  /// What the arguments refer to must outlive the object.
  PlaneMatching(const float* image, int height, int width, const std::vector<SweepView>& views,
                const std::vector<float>& planes, const SweepOptions& options);

  /// Rows that are best matched together: those around them are sampled again by each caller of `band`.
  static constexpr int kBandRows = 40;

  /// Write the costs of rows [begin, end) of all pixels and planes to where they lie in `costs`, that of the image.
  void band(int begin, int end, std::uint8_t* costs) const;

 private:
  struct Ring;

  void describe(const float* image);
  void sample(const SweepView& view, float plane, int y, Ring& ring) const;
  void match(int y, const Ring& ring, std::uint8_t* out) const;
  std::size_t offset(int row) const { return static_cast<std::size_t>(row) * static_cast<std::size_t>(width_); }
  std::size_t padded(int row) const;

  int height_, width_, pitch_;
  const std::vector<SweepView>& views_;
  const std::vector<float>& planes_;
  const SweepOptions& options_;
  std::vector<float> image_;  // with zeros around its rows
  std::vector<float> mean_, variance_;
};

}  // namespace uni4d_fg
