// Where a point lies between the pixels of an image.
#pragma once

#include "uni4d_fg/math.hpp"

namespace uni4d_fg {

/// The upper left of the four pixels around a point, and how far the point is from it; that of the first pixel, and
/// not shown, where the point is outside of the image.
struct PixelPlace {
  int at;
  float p, q;
  int shown;
};

/// Where (u, v) lies; `ahead` is false if that is behind the camera.
UNI4D_FG_INLINE PixelPlace pixel_place(float u, float v, bool ahead, int height, int width) {
  const float right = static_cast<float>(width - 1), bottom = static_cast<float>(height - 1);
  const bool inside = ahead & (u >= 0.0F) & (v >= 0.0F) & (u <= right) & (v <= bottom);
  const float uc = inside ? u : 0.0F, vc = inside ? v : 0.0F;
  int i = static_cast<int>(uc), j = static_cast<int>(vc);
  i = i < width - 2 ? i : width - 2;
  j = j < height - 2 ? j : height - 2;
  return {j * width + i, uc - static_cast<float>(i), vc - static_cast<float>(j), inside ? 1 : 0};
}

}  // namespace uni4d_fg
