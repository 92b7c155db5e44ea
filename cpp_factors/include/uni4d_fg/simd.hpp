// SIMD types: eight doubles, one factor per lane, four doubles, and sixteen floats.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <new>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "uni4d_fg/math.hpp"

// As UNI4D_FG_CLONES, with a third version for processors with 512-bit vectors: a Simd8 is one of their registers.
#if defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12 && defined(__x86_64__) && defined(__linux__) && \
    !defined(UNI4D_FG_NO_CLONES)
#define UNI4D_FG_WIDE_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define UNI4D_FG_WIDE_CLONES UNI4D_FG_CLONES
#endif

// SIMD values are passed by value between inlined functions only: how a call would pass them does not matter.
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC diagnostic ignored "-Wpsabi"
#endif

namespace uni4d_fg {

constexpr int kSimd8Width = 8;
constexpr int kSimd4Width = 4;
constexpr int kSimdFloatWidth = 16;

#if defined(__GNUC__) || defined(__clang__)

typedef double Simd8 __attribute__((vector_size(64)));
typedef double Simd4 __attribute__((vector_size(32)));
typedef float SimdFloat __attribute__((vector_size(64)));

#else

template <typename T, int width>
struct Simd {
  using value_type = T;
  T lane[width];
  T& operator[](int i) { return lane[i]; }
  T operator[](int i) const { return lane[i]; }
};
#define UNI4D_FG_SIMD_OPERATOR(op)                                                             \
  template <typename T, int width>                                                             \
  Simd<T, width> operator op(const Simd<T, width>& a, const Simd<T, width>& b) {               \
    Simd<T, width> out;                                                                        \
    for (int i = 0; i < width; ++i) out.lane[i] = a.lane[i] op b.lane[i];                      \
    return out;                                                                                \
  }                                                                                            \
  template <typename T, int width>                                                             \
  Simd<T, width> operator op(typename Simd<T, width>::value_type a, const Simd<T, width>& b) { \
    Simd<T, width> out;                                                                        \
    for (int i = 0; i < width; ++i) out.lane[i] = a op b.lane[i];                              \
    return out;                                                                                \
  }                                                                                            \
  template <typename T, int width>                                                             \
  Simd<T, width> operator op(const Simd<T, width>& a, typename Simd<T, width>::value_type b) { \
    Simd<T, width> out;                                                                        \
    for (int i = 0; i < width; ++i) out.lane[i] = a.lane[i] op b;                              \
    return out;                                                                                \
  }
UNI4D_FG_SIMD_OPERATOR(+)
UNI4D_FG_SIMD_OPERATOR(-)
UNI4D_FG_SIMD_OPERATOR(*)
UNI4D_FG_SIMD_OPERATOR(/)
#undef UNI4D_FG_SIMD_OPERATOR
template <typename T, int width>
Simd<T, width> operator-(const Simd<T, width>& a) {
  return T(-1) * a;
}
template <typename T, int width>
Simd<T, width>& operator+=(Simd<T, width>& a, const Simd<T, width>& b) {
  return a = a + b;
}
using Simd8 = Simd<double, kSimd8Width>;
using Simd4 = Simd<double, kSimd4Width>;
using SimdFloat = Simd<float, kSimdFloatWidth>;

#endif

UNI4D_FG_INLINE Simd8 broadcast(double value) { return Simd8{} + value; }

UNI4D_FG_INLINE Simd8 load_simd8(const double* p) {
  Simd8 out;
  std::memcpy(&out, p, sizeof(Simd8));
  return out;
}

UNI4D_FG_INLINE void store_simd8(const Simd8& a, double* p) { std::memcpy(p, &a, sizeof(Simd8)); }

/// Read four doubles; no alignment needed.
UNI4D_FG_INLINE void load_simd4(const double* p, Simd4& out) { std::memcpy(&out, p, sizeof(Simd4)); }

/// Read sixteen floats; no alignment needed.
UNI4D_FG_INLINE SimdFloat load_floats(const float* p) {
  SimdFloat out;
  std::memcpy(&out, p, sizeof(SimdFloat));
  return out;
}

/// Sum of the lanes, always in the same order.
UNI4D_FG_INLINE double sum(const SimdFloat& a) {
  float part[4];
  for (int i = 0; i < 4; ++i) part[i] = (a[i] + a[i + 4]) + (a[i + 8] + a[i + 12]);
  return (static_cast<double>(part[0]) + part[1]) + (static_cast<double>(part[2]) + part[3]);
}

UNI4D_FG_INLINE double sum(const Simd4& a) { return (a[0] + a[1]) + (a[2] + a[3]); }

UNI4D_FG_INLINE void prefetch_for_writing(const double* p) {
#if defined(__GNUC__) || defined(__clang__)
  __builtin_prefetch(p, 1, 3);
#else
  (void)p;
#endif
}

/// Larger of a value and a bound, per lane; the bound where the value is NaN.
UNI4D_FG_INLINE Simd8 larger(const Simd8& value, double bound) {
  Simd8 out;
  for (int i = 0; i < kSimd8Width; ++i) out[i] = larger(value[i], bound);
  return out;
}

/// Smaller of a value and a bound, per lane; the value where it is NaN.
UNI4D_FG_INLINE Simd8 at_most(const Simd8& value, double bound) {
  Simd8 out;
  for (int i = 0; i < kSimd8Width; ++i) out[i] = at_most(value[i], bound);
  return out;
}

/// 1 where a value lies above a bound, else 0, per lane.
UNI4D_FG_INLINE Simd8 is_above(const Simd8& value, double bound) {
  Simd8 out;
  for (int i = 0; i < kSimd8Width; ++i) out[i] = is_above(value[i], bound);
  return out;
}

UNI4D_FG_INLINE Simd8 square_root(const Simd8& a) {
  Simd8 out;
  for (int i = 0; i < kSimd8Width; ++i) out[i] = std::sqrt(a[i]);
  return out;
}

/// log(a) of finite a that are not denormal, to two units in the last place; what it returns for others is not defined.
UNI4D_FG_INLINE Simd8 natural_log(const Simd8& a) {
#if defined(__GNUC__) || defined(__clang__)
  typedef std::uint64_t Bits8 __attribute__((vector_size(64)));
  // a = 2^k m with m in [sqrt(1/2), sqrt(2)): adding moves the step of the exponent from 1 to there.
  constexpr std::uint64_t kOne = 0x3FF0000000000000, kRootOfHalf = 0x3FE6A09E667F3BCD, kMantissa = 0x000FFFFFFFFFFFFF;
  constexpr std::uint64_t kExponentOf2To52 = 0x4330000000000000;
  Bits8 bits;
  std::memcpy(&bits, &a, sizeof(bits));
  bits += kOne - kRootOfHalf;
  const Bits8 exponent = (bits >> 52) | kExponentOf2To52;
  const Bits8 mantissa = (bits & kMantissa) + kRootOfHalf;
  Simd8 k, m;
  std::memcpy(&k, &exponent, sizeof(k));
  std::memcpy(&m, &mantissa, sizeof(m));
  k = k - (4503599627370496.0 + 1023.0);
  // log m = 2 artanh(s) with s = (m - 1) / (m + 1), |s| < 0.172.
  const Simd8 s = (m - 1.0) / (m + 1.0), z = s * s;
  Simd8 series = broadcast(1.0 / 21.0);
  for (int odd = 19; odd >= 3; odd -= 2) series = series * z + 1.0 / odd;
  constexpr double kLog2High = 0x1.62e42fefa38p-1, kLog2Low = 0x1.ef35793c7673p-45;
  return k * kLog2High + (2.0 * s + (2.0 * s * z * series + k * kLog2Low));
#else
  Simd8 out;
  for (int i = 0; i < kSimd8Width; ++i) out[i] = std::log(a[i]);
  return out;
#endif
}

/// log(1 + a) of a that are not negative.
UNI4D_FG_INLINE Simd8 log_one_plus(const Simd8& a) {
  const Simd8 sum = 1.0 + a;
  // What the sum lost of a, to first order.
  return natural_log(sum) + (a - (sum - 1.0)) / sum;
}

/// Sum of the lanes, always in the same order.
UNI4D_FG_INLINE double sum(const Simd8& a) { return ((a[0] + a[1]) + (a[2] + a[3])) + ((a[4] + a[5]) + (a[6] + a[7])); }

/// Transpose an 8x8 matrix: out[i][j] = in[j][i].
UNI4D_FG_INLINE void transpose(const Simd8* in, Simd8* out) {
#if defined(__clang__) || (defined(__GNUC__) && __GNUC__ >= 12)
  Simd8 pairs[8], fours[8];
  for (int i = 0; i < 8; i += 2) {
    pairs[i] = __builtin_shufflevector(in[i], in[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
    pairs[i + 1] = __builtin_shufflevector(in[i], in[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  }
  for (int i = 0; i < 8; i += 4)
    for (int j = 0; j < 2; ++j) {
      fours[i + j] = __builtin_shufflevector(pairs[i + j], pairs[i + j + 2], 0, 1, 8, 9, 4, 5, 12, 13);
      fours[i + j + 2] = __builtin_shufflevector(pairs[i + j], pairs[i + j + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    }
  for (int i = 0; i < 4; ++i) {
    out[i] = __builtin_shufflevector(fours[i], fours[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
    out[i + 4] = __builtin_shufflevector(fours[i], fours[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
  }
#else
  for (int i = 0; i < 8; ++i)
    for (int j = 0; j < 8; ++j) out[i][j] = in[j][i];
#endif
}

/// Memory aligned for SIMD, in large pages where it is large; values are left as they are unless given.
template <typename T>
struct SimdAllocator {
  using value_type = T;
  SimdAllocator() = default;
  template <typename U>
  SimdAllocator(const SimdAllocator<U>&) {}
  T* allocate(std::size_t n) {
    void* p = ::operator new(n * sizeof(T), alignment(n));
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    // A refusal changes nothing but speed.
    if (alignment(n) == kLargePage) (void)madvise(p, n * sizeof(T), MADV_HUGEPAGE);
#endif
    return static_cast<T*>(p);
  }
  void deallocate(T* p, std::size_t n) { ::operator delete(p, alignment(n)); }
  template <typename U>
  void construct(U* p) {
    ::new (static_cast<void*>(p)) U;
  }
  template <typename U, typename... Arguments>
  void construct(U* p, Arguments&&... arguments) {
    ::new (static_cast<void*>(p)) U(std::forward<Arguments>(arguments)...);
  }
  template <typename U>
  bool operator==(const SimdAllocator<U>&) const {
    return true;
  }
  template <typename U>
  bool operator!=(const SimdAllocator<U>&) const {
    return false;
  }

 private:
  static constexpr std::align_val_t kLargePage{std::size_t{2} << 20};
  static std::align_val_t alignment(std::size_t n) {
    return n * sizeof(T) >= 4 * static_cast<std::size_t>(kLargePage) ? kLargePage : std::align_val_t(64);
  }
};

using AlignedDoubles = std::vector<double, SimdAllocator<double>>;

}  // namespace uni4d_fg
