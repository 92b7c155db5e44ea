// Whether pixels look in another frame as a static scene would have it: `cues/appearance.py` says how, and
// `cues/evidence_numpy.py` is the same in NumPy.
#pragma once

#include <cstddef>

namespace uni4d_fg {

/// A frame (h, w) and what another one shows where a static scene has its pixels; intensities in gray levels.
struct ComparedPixels {
  int height = 0, width = 0;
  const float* color = nullptr;                                // (h, w, 3)
  const float* seen = nullptr;                                 // (h, w, 3) of the other frame
  const float *u = nullptr, *v = nullptr;                      // where that is, px
  const float *du = nullptr, *dv = nullptr;                    // its change per unit of log depth, px
  const float* z = nullptr;                                    // the predicted depth
  const float* sigma = nullptr;                                // of log depth
  const float *gxx = nullptr, *gxy = nullptr, *gyy = nullptr;  // products of gradients, summed over colors
  const float* variance = nullptr;                             // of a difference of colors but for what depth does
  const float* contrast = nullptr;                             // variance of the colors around
  const float* texture = nullptr;                              // the same where shadows are looked for; null for not
  const float* nearest = nullptr;                              // least depth around each pixel of the other frame
};

struct EvidenceOptions {
  int patch = 5, shadow_window = 15;  // sides of windows, px
  float deepest_shadow = 0.4F, lit = 0.97F;
  float nearer = 0.9F;  // what is nearer than this part of the predicted depth hides it
  float least = -1.0F, most = 3.0F;
  int step = 4;  // medians are those of every so many pixels
};

/// Write the log odds (h, w) that pixels have moved; 0 where nothing is known.
void moved_evidence(const ComparedPixels& pixels, const EvidenceOptions& options, float* out);

}  // namespace uni4d_fg
