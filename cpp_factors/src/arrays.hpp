// The boundary with Python: every array is checked here, with a message that names the argument.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cmath>
#include <cstdint>
#include <initializer_list>
#include <string>
#include <utility>
#include <vector>

#include "uni4d_fg/robust.hpp"

namespace uni4d_fg {

namespace nb = nanobind;

/// Argument type of every entry point that takes an array. It accepts any Python object; what it is is checked by the
/// functions below, which know the argument's name.
struct AnyArray {
  nb::object object;
};

/// A length that `expect_*` accepts whatever it is.
constexpr std::int64_t kAnyLength = -1;

/// An expected shape of at most four axes.
class Shape {
 public:
  Shape(std::initializer_list<std::int64_t> lengths) {
    for (const std::int64_t length : lengths) append(length);
  }
  void append(std::int64_t length) { lengths_[size_++] = length; }
  std::size_t size() const { return size_; }
  std::int64_t operator[](std::size_t i) const { return lengths_[i]; }

 private:
  std::int64_t lengths_[4];
  std::size_t size_ = 0;
};

/// What is known about an array that passed: a pointer to C-contiguous values and its shape.
template <typename T>
struct View {
  const T* data = nullptr;
  std::vector<std::int64_t> shape;
  std::int64_t rows() const { return shape.empty() ? 0 : shape[0]; }
  /// Number of values.
  std::int64_t size() const;
};

/// Number of axes. Raises TypeError "name: expected a numeric NumPy array, got list" for anything else.
std::size_t num_axes(const AnyArray& array, const char* name);

/// Check dtype float64, C-contiguity, shape (kAnyLength leaves an axis open) and, if asked, that all is finite.
/// Raises ValueError "name: expected float64 (N, 2) C-contiguous, got float32 (5, 2)".
View<double> expect_floats(const AnyArray& array, const char* name, const Shape& shape, bool finite = true);

/// Check dtype float32, C-contiguity and shape; values may be anything.
View<float> expect_singles(const AnyArray& array, const char* name, const Shape& shape);

/// The same of dtype uint8.
View<std::uint8_t> expect_bytes(const AnyArray& array, const char* name, const Shape& shape);

/// Check dtype int64, C-contiguity and shape.
View<std::int64_t> expect_integers(const AnyArray& array, const char* name, const Shape& shape);

/// Check dtype int64, C-contiguity, shape (n,) and that every entry lies in [0, limit).
View<std::int64_t> expect_rows(const AnyArray& array, const char* name, std::int64_t length, std::int64_t limit);

/// Check a sigma: (n,) or (n, dim), finite and positive. `columns` is 1 or dim.
struct Sigma {
  View<double> view;
  int columns = 1;
};
Sigma expect_sigma(const AnyArray& array, const char* name, std::int64_t length, int dim);

/// Check weights: (n,), finite and not negative.
View<double> expect_weights(const AnyArray& array, const char* name, std::int64_t length);

/// Check a kernel code and a threshold > 0.
Kernel expect_kernel(int kind, double threshold);

/// Raise ValueError unless every value is positive.
void expect_positive(const View<double>& view, const char* name);

/// Check a number of threads (0: the cores) and return the number of workers.
int expect_threads(int threads);

/// Raise ValueError when a count does not fit an int.
int expect_count(std::int64_t count, const char* name);

[[noreturn]] void refuse(const std::string& message);

/// Hand a new C-contiguous array to Python. Take the GIL before.
template <typename T>
class NewArrayOf {
 public:
  explicit NewArrayOf(std::vector<std::size_t> shape) : shape_(std::move(shape)) {
    std::size_t size = 1;
    for (const std::size_t length : shape_) size *= length;
    data_ = new T[size > 0 ? size : 1];
    owner_ = nb::capsule(data_, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  }
  T* data() { return data_; }
  nb::ndarray<nb::numpy, T> release() { return {data_, shape_.size(), shape_.data(), owner_}; }

 private:
  std::vector<std::size_t> shape_;
  T* data_;
  nb::capsule owner_;
};

using NewArray = NewArrayOf<double>;

}  // namespace uni4d_fg

namespace nanobind::detail {

template <>
struct type_caster<uni4d_fg::AnyArray> {
  NB_TYPE_CASTER(uni4d_fg::AnyArray, const_name("numpy.typing.NDArray"))
  bool from_python(handle source, uint8_t, cleanup_list*) noexcept {
    value.object = borrow(source);
    return true;
  }
};

}  // namespace nanobind::detail
