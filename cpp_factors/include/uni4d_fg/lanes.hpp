// Four doubles that the compiler keeps in vector registers of whatever width the processor has.
#pragma once

#include <cstring>

#include "uni4d_fg/math.hpp"

namespace uni4d_fg {

#if defined(__GNUC__) || defined(__clang__)
typedef double Lanes __attribute__((vector_size(32)));
#else
struct Lanes {
  double v[4];
  double operator[](int i) const { return v[i]; }
};
inline Lanes operator*(const Lanes& a, const Lanes& b) {
  return {{a.v[0] * b.v[0], a.v[1] * b.v[1], a.v[2] * b.v[2], a.v[3] * b.v[3]}};
}
inline Lanes& operator+=(Lanes& a, const Lanes& b) {
  for (int i = 0; i < 4; ++i) a.v[i] += b.v[i];
  return a;
}
#endif

constexpr int kLanes = 4;

/// Read four doubles; no alignment needed.
UNI4D_FG_INLINE void load_lanes(const double* from, Lanes& out) { std::memcpy(&out, from, sizeof(Lanes)); }

UNI4D_FG_INLINE double sum_of(const Lanes& a) { return (a[0] + a[1]) + (a[2] + a[3]); }

}  // namespace uni4d_fg
