// An exponential that loops can vectorize.
#pragma once

#include <cstdint>
#include <cstring>

#include "uni4d_fg/simd.hpp"

namespace uni4d_fg {

constexpr float kFarthest = 60.0F;  // exponent beyond which what is compared is equally unlike: callers cut it here

/// exp(-x) for x in [0, 87], to 2e-7 of itself, without a branch or a call.
UNI4D_FG_INLINE float exp_minus(float x) {
  const float t = -1.44269504F * x;                            // exp(-x) = 2^t
  const int whole = static_cast<int>(t - 0.5F);                // t is not positive: rounded to the nearest
  const float f = 0.693147181F * (t - static_cast<float>(whole));
  const float value =
      1.0F + f * (1.0F + f * (0.5F + f * (1.0F / 6 + f * (1.0F / 24 + f * (1.0F / 120 + f * (1.0F / 720))))));
  const std::int32_t bits = (whole + 127) << 23;
  float scale;
  std::memcpy(&scale, &bits, sizeof scale);
  return value * scale;
}

}  // namespace uni4d_fg
