// SIMD types: eight doubles, one factor per lane, and sixteen floats, in registers of 64, 32 or 16 bytes.
//
// A compiler that is handed vectors wider than a register takes them apart badly (through memory, three times as slow),
// so that a value is as many registers as it needs, and what computes with it is compiled once per width.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <new>
#include <type_traits>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "uni4d_fg/math.hpp"

// As UNI4D_FG_CLONES, with a third version for processors with 512-bit vectors: for loops that the compiler vectorizes.
//
// UNI4D_FG_DISPATCH(returns, name, (parameters), (arguments), body) defines a function whose body, in which kBytes is
// the width of a register, is compiled for each kind of processor; which one runs is decided when it is called.
#if defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12 && defined(__x86_64__) && defined(__linux__) && \
    !defined(UNI4D_FG_NO_CLONES)
#define UNI4D_FG_WIDE_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#define UNI4D_FG_DISPATCH(returns, name, parameters, arguments, ...)           \
  namespace {                                                                  \
  __attribute__((target("arch=x86-64-v4"))) returns name##_in_512 parameters { \
    constexpr int kBytes = 64;                                                 \
    __VA_ARGS__;                                                               \
  }                                                                            \
  __attribute__((target("arch=x86-64-v3"))) returns name##_in_256 parameters { \
    constexpr int kBytes = 32;                                                 \
    __VA_ARGS__;                                                               \
  }                                                                            \
  returns name##_in_128 parameters {                                           \
    constexpr int kBytes = 16;                                                 \
    __VA_ARGS__;                                                               \
  }                                                                            \
  }                                                                            \
  returns name parameters {                                                    \
    if (__builtin_cpu_supports("x86-64-v4")) return name##_in_512 arguments;   \
    if (__builtin_cpu_supports("x86-64-v3")) return name##_in_256 arguments;   \
    return name##_in_128 arguments;                                            \
  }
#else
#define UNI4D_FG_WIDE_CLONES UNI4D_FG_CLONES
#define UNI4D_FG_DISPATCH(returns, name, parameters, arguments, ...) \
  returns name parameters {                                          \
    constexpr int kBytes = ::uni4d_fg::kOwnBytes;                    \
    __VA_ARGS__;                                                     \
  }
#endif

// SIMD values are passed by value between inlined functions only: how a call would pass them does not matter.
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC diagnostic ignored "-Wpsabi"
#endif

namespace uni4d_fg {

constexpr int kSimd8Width = 8;
constexpr int kSimd4Width = 4;
constexpr int kSimdFloatWidth = 16;

/// Bytes of a register of the processor that all of the code is compiled for; 8 where the compiler has no vectors.
#if defined(UNI4D_FG_OWN_BYTES)
constexpr int kOwnBytes = UNI4D_FG_OWN_BYTES;
#elif !defined(__GNUC__) && !defined(__clang__)
constexpr int kOwnBytes = 8;
#elif defined(__AVX512F__)
constexpr int kOwnBytes = 64;
#elif defined(__AVX__)
constexpr int kOwnBytes = 32;
#else
constexpr int kOwnBytes = 16;
#endif

namespace simd {

/// What a register of so many bytes holds: numbers of type T, and integers of their size.
template <typename T, int bytes>
struct Register;

#if defined(__GNUC__) || defined(__clang__)
#define UNI4D_FG_REGISTER(T, Integer, bytes)                      \
  template <>                                                     \
  struct Register<T, bytes> {                                     \
    typedef T Numbers __attribute__((vector_size(bytes)));        \
    typedef Integer Integers __attribute__((vector_size(bytes))); \
  };
UNI4D_FG_REGISTER(double, std::uint64_t, 64)
UNI4D_FG_REGISTER(double, std::uint64_t, 32)
UNI4D_FG_REGISTER(double, std::uint64_t, 16)
UNI4D_FG_REGISTER(float, std::uint32_t, 64)
UNI4D_FG_REGISTER(float, std::uint32_t, 32)
UNI4D_FG_REGISTER(float, std::uint32_t, 16)
#undef UNI4D_FG_REGISTER
#else
template <>
struct Register<double, 8> {
  using Numbers = double;
  using Integers = std::uint64_t;
};
template <>
struct Register<float, 8> {
  using Numbers = float;
  using Integers = std::uint32_t;
};
#endif

}  // namespace simd

/// `width` numbers.
template <typename T, int width, int bytes>
struct Simd {
  using Part = typename simd::Register<T, bytes>::Numbers;
  static constexpr int kLanes = static_cast<int>(sizeof(Part) / sizeof(T));
  static constexpr int kParts = width / kLanes;
  Part part[kParts];

  UNI4D_FG_INLINE T operator[](int i) const {
    if constexpr (kLanes == 1)
      return part[i];
    else
      return part[i / kLanes][i % kLanes];
  }
  UNI4D_FG_INLINE void set(int i, T value) {
    if constexpr (kLanes == 1)
      part[i] = value;
    else
      part[i / kLanes][i % kLanes] = value;
  }
};

template <int bytes>
using Simd8 = Simd<double, kSimd8Width, bytes>;
template <int bytes>
using Simd4 = Simd<double, kSimd4Width, (bytes < 32 ? bytes : 32)>;
template <int bytes>
using SimdFloat = Simd<float, kSimdFloatWidth, bytes>;

#define UNI4D_FG_SIMD_OPERATOR(op)                                                                                    \
  template <typename T, int width, int bytes>                                                                         \
  UNI4D_FG_INLINE Simd<T, width, bytes> operator op(const Simd<T, width, bytes>& a, const Simd<T, width, bytes>& b) { \
    Simd<T, width, bytes> out;                                                                                        \
    for (int i = 0; i < out.kParts; ++i) out.part[i] = a.part[i] op b.part[i];                                        \
    return out;                                                                                                       \
  }                                                                                                                   \
  template <typename T, int width, int bytes>                                                                         \
  UNI4D_FG_INLINE Simd<T, width, bytes> operator op(const std::common_type_t<T>& a, const Simd<T, width, bytes>& b) { \
    Simd<T, width, bytes> out;                                                                                        \
    for (int i = 0; i < out.kParts; ++i) out.part[i] = a op b.part[i];                                                \
    return out;                                                                                                       \
  }                                                                                                                   \
  template <typename T, int width, int bytes>                                                                         \
  UNI4D_FG_INLINE Simd<T, width, bytes> operator op(const Simd<T, width, bytes>& a, const std::common_type_t<T>& b) { \
    Simd<T, width, bytes> out;                                                                                        \
    for (int i = 0; i < out.kParts; ++i) out.part[i] = a.part[i] op b;                                                \
    return out;                                                                                                       \
  }
UNI4D_FG_SIMD_OPERATOR(+)
UNI4D_FG_SIMD_OPERATOR(-)
UNI4D_FG_SIMD_OPERATOR(*)
UNI4D_FG_SIMD_OPERATOR(/)
#undef UNI4D_FG_SIMD_OPERATOR

template <typename T, int width, int bytes>
UNI4D_FG_INLINE Simd<T, width, bytes> operator-(const Simd<T, width, bytes>& a) {
  Simd<T, width, bytes> out;
  for (int i = 0; i < out.kParts; ++i) out.part[i] = -a.part[i];
  return out;
}

template <typename T, int width, int bytes>
UNI4D_FG_INLINE Simd<T, width, bytes>& operator+=(Simd<T, width, bytes>& a, const Simd<T, width, bytes>& b) {
  for (int i = 0; i < a.kParts; ++i) a.part[i] += b.part[i];
  return a;
}

/// Read as many numbers as a SIMD value holds; no alignment needed.
template <typename Value, typename T>
UNI4D_FG_INLINE Value load(const T* p) {
  Value out;
  for (int i = 0; i < out.kParts; ++i) std::memcpy(&out.part[i], p + i * out.kLanes, sizeof(out.part[i]));
  return out;
}

template <typename T, int width, int bytes>
UNI4D_FG_INLINE void store(const Simd<T, width, bytes>& a, T* p) {
  for (int i = 0; i < a.kParts; ++i) std::memcpy(p + i * a.kLanes, &a.part[i], sizeof(a.part[i]));
}

/// Sum of the lanes, always in the same order.
template <int bytes>
UNI4D_FG_INLINE double sum(const Simd8<bytes>& a) {
  return ((a[0] + a[1]) + (a[2] + a[3])) + ((a[4] + a[5]) + (a[6] + a[7]));
}

template <int bytes>
UNI4D_FG_INLINE double sum(const Simd<double, kSimd4Width, bytes>& a) {
  return (a[0] + a[1]) + (a[2] + a[3]);
}

template <int bytes>
UNI4D_FG_INLINE double sum(const SimdFloat<bytes>& a) {
  float part[4];
  for (int i = 0; i < 4; ++i) part[i] = (a[i] + a[i + 4]) + (a[i + 8] + a[i + 12]);
  return (static_cast<double>(part[0]) + part[1]) + (static_cast<double>(part[2]) + part[3]);
}

UNI4D_FG_INLINE void prefetch_for_writing(const double* p) {
#if defined(__GNUC__) || defined(__clang__)
  __builtin_prefetch(p, 1, 3);
#else
  (void)p;
#endif
}

/// Larger of a value and a bound, per lane; the bound where the value is NaN.
template <int bytes>
UNI4D_FG_INLINE Simd8<bytes> larger(const Simd8<bytes>& value, double bound) {
  Simd8<bytes> out;
  const typename Simd8<bytes>::Part limit = bound + typename Simd8<bytes>::Part{};
  for (int i = 0; i < out.kParts; ++i) out.part[i] = value.part[i] > limit ? value.part[i] : limit;
  return out;
}

/// Smaller of a value and a bound, per lane; the value where it is NaN.
template <typename T, int width, int bytes>
UNI4D_FG_INLINE Simd<T, width, bytes> at_most(const Simd<T, width, bytes>& value, std::common_type_t<T> bound) {
  Simd<T, width, bytes> out;
  const typename Simd<T, width, bytes>::Part limit = bound + typename Simd<T, width, bytes>::Part{};
  for (int i = 0; i < out.kParts; ++i) out.part[i] = limit < value.part[i] ? limit : value.part[i];
  return out;
}

/// Absolute value per lane.
template <typename T, int width, int bytes>
UNI4D_FG_INLINE Simd<T, width, bytes> magnitude(const Simd<T, width, bytes>& a) {
  Simd<T, width, bytes> out;
  for (int i = 0; i < out.kParts; ++i) out.part[i] = a.part[i] < 0 ? -a.part[i] : a.part[i];
  return out;
}

/// 1 where a value lies above a bound, else 0, per lane.
template <int bytes>
UNI4D_FG_INLINE Simd8<bytes> is_above(const Simd8<bytes>& value, double bound) {
  using Part = typename Simd8<bytes>::Part;
  Simd8<bytes> out;
  const Part limit = bound + Part{}, one = 1.0 + Part{};
  for (int i = 0; i < out.kParts; ++i) out.part[i] = value.part[i] > limit ? one : Part{};
  return out;
}

template <int bytes>
UNI4D_FG_INLINE Simd8<bytes> square_root(const Simd8<bytes>& a) {
  Simd8<bytes> out;
  for (int i = 0; i < kSimd8Width; ++i) out.set(i, std::sqrt(a[i]));
  return out;
}

/// log(a) of finite a that are not denormal, to two units in the last place; what it returns for others is not defined.
template <int bytes>
UNI4D_FG_INLINE Simd8<bytes> natural_log(const Simd8<bytes>& a) {
  Simd8<bytes> out;
#if defined(__GNUC__) || defined(__clang__)
  using Numbers = typename Simd8<bytes>::Part;
  using Bits = typename simd::Register<double, bytes>::Integers;
  // a = 2^k m with m in [sqrt(1/2), sqrt(2)): adding moves the step of the exponent from 1 to there.
  constexpr std::uint64_t kOne = 0x3FF0000000000000, kRootOfHalf = 0x3FE6A09E667F3BCD, kMantissa = 0x000FFFFFFFFFFFFF;
  constexpr std::uint64_t kExponentOf2To52 = 0x4330000000000000;
  for (int i = 0; i < out.kParts; ++i) {
    Bits bits;
    std::memcpy(&bits, &a.part[i], sizeof(bits));
    bits += kOne - kRootOfHalf;
    const Bits exponent = (bits >> 52) | kExponentOf2To52;
    const Bits mantissa = (bits & kMantissa) + kRootOfHalf;
    Numbers k, m;
    std::memcpy(&k, &exponent, sizeof(k));
    std::memcpy(&m, &mantissa, sizeof(m));
    k = k - (4503599627370496.0 + 1023.0);
    // log m = 2 artanh(s) with s = (m - 1) / (m + 1), |s| < 0.172.
    const Numbers s = (m - 1.0) / (m + 1.0), z = s * s;
    Numbers series = Numbers{} + 1.0 / 21.0;
    for (int odd = 19; odd >= 3; odd -= 2) series = series * z + 1.0 / odd;
    constexpr double kLog2High = 0x1.62e42fefa38p-1, kLog2Low = 0x1.ef35793c7673p-45;
    out.part[i] = k * kLog2High + (2.0 * s + (2.0 * s * z * series + k * kLog2Low));
  }
#else
  for (int i = 0; i < kSimd8Width; ++i) out.set(i, std::log(a[i]));
#endif
  return out;
}

/// log(1 + a) of a that are not negative.
template <int bytes>
UNI4D_FG_INLINE Simd8<bytes> log_one_plus(const Simd8<bytes>& a) {
  const Simd8<bytes> sum = 1.0 + a;
  // What the sum lost of a, to first order.
  return natural_log(sum) + (a - (sum - 1.0)) / sum;
}

/// Transpose an 8x8 matrix: out[i][j] = in[j][i].
template <int bytes>
UNI4D_FG_INLINE void transpose(const Simd8<bytes>* in, Simd8<bytes>* out) {
#if defined(__clang__) || (defined(__GNUC__) && __GNUC__ >= 12)
  using Part = typename Simd8<bytes>::Part;
  if constexpr (bytes == 64) {
    Part pairs[8], fours[8];
    for (int i = 0; i < 8; i += 2) {
      const Part &a = in[i].part[0], &b = in[i + 1].part[0];
      pairs[i] = __builtin_shufflevector(a, b, 0, 8, 2, 10, 4, 12, 6, 14);
      pairs[i + 1] = __builtin_shufflevector(a, b, 1, 9, 3, 11, 5, 13, 7, 15);
    }
    for (int i = 0; i < 8; i += 4)
      for (int j = 0; j < 2; ++j) {
        fours[i + j] = __builtin_shufflevector(pairs[i + j], pairs[i + j + 2], 0, 1, 8, 9, 4, 5, 12, 13);
        fours[i + j + 2] = __builtin_shufflevector(pairs[i + j], pairs[i + j + 2], 2, 3, 10, 11, 6, 7, 14, 15);
      }
    for (int i = 0; i < 4; ++i) {
      out[i].part[0] = __builtin_shufflevector(fours[i], fours[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
      out[i + 4].part[0] = __builtin_shufflevector(fours[i], fours[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
  } else if constexpr (bytes == 32) {
    // Four blocks of 4x4, each put where its mirror image was.
    for (int row = 0; row < 2; ++row)
      for (int column = 0; column < 2; ++column) {
        const auto* from = in + 4 * column;
        Part pairs[4];
        for (int i = 0; i < 4; i += 2) {
          pairs[i] = __builtin_shufflevector(from[i].part[row], from[i + 1].part[row], 0, 4, 2, 6);
          pairs[i + 1] = __builtin_shufflevector(from[i].part[row], from[i + 1].part[row], 1, 5, 3, 7);
        }
        for (int i = 0; i < 2; ++i) {
          out[4 * row + i].part[column] = __builtin_shufflevector(pairs[i], pairs[i + 2], 0, 1, 4, 5);
          out[4 * row + i + 2].part[column] = __builtin_shufflevector(pairs[i], pairs[i + 2], 2, 3, 6, 7);
        }
      }
  } else {
    for (int row = 0; row < 4; ++row)
      for (int column = 0; column < 4; ++column) {
        const Part &a = in[2 * column].part[row], &b = in[2 * column + 1].part[row];
        out[2 * row].part[column] = __builtin_shufflevector(a, b, 0, 2);
        out[2 * row + 1].part[column] = __builtin_shufflevector(a, b, 1, 3);
      }
  }
#else
  for (int i = 0; i < 8; ++i)
    for (int j = 0; j < 8; ++j) out[i].set(j, in[j][i]);
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
