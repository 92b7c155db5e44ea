#include "arrays.hpp"

#include <limits>
#include <new>

#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

namespace {

using Imported = nb::ndarray<nb::ro, nb::device::cpu>;

Imported import(const AnyArray& argument, const char* name) {
  const nb::object& object = argument.object;
  // Only plain numbers reach nanobind's import: strings and dates have no DLPack type.
  Imported array;
  bool numeric = false;
  const nb::object dtype = nb::getattr(object, "dtype", nb::none());
  if (nb::hasattr(dtype, "kind")) {
    const nb::str kind(dtype.attr("kind"));
    numeric = std::string("biufc").find(kind.c_str()) != std::string::npos && nb::cast<bool>(dtype.attr("isnative"));
  }
  if (!numeric || !nb::try_cast(object, array, false) || !array.is_valid()) {
    PyErr_Clear();
    std::string got = nb::inst_name(object).c_str();
    if (!dtype.is_none()) got += std::string(" of ") + nb::str(dtype).c_str();
    throw nb::type_error((std::string(name) + ": expected a numeric NumPy array, got " + got).c_str());
  }
  return array;
}

std::string dtype_name(nb::dlpack::dtype dtype) {
  const char* kind = "dtype";
  switch (static_cast<nb::dlpack::dtype_code>(dtype.code)) {
    case nb::dlpack::dtype_code::Int:
      kind = "int";
      break;
    case nb::dlpack::dtype_code::UInt:
      kind = "uint";
      break;
    case nb::dlpack::dtype_code::Float:
      kind = "float";
      break;
    case nb::dlpack::dtype_code::Complex:
      kind = "complex";
      break;
    case nb::dlpack::dtype_code::Bool:
      return "bool";
    default:
      break;
  }
  return kind + std::to_string(static_cast<int>(dtype.bits));
}

template <typename Lengths>
std::string shape_text(const Lengths& shape) {
  std::string text = "(";
  for (std::size_t i = 0; i < shape.size(); ++i) {
    if (i > 0) text += ", ";
    text += shape[i] == kAnyLength ? "N" : std::to_string(shape[i]);
  }
  return text + (shape.size() == 1 ? ",)" : ")");
}

std::vector<std::int64_t> shape_of(const Imported& array) {
  std::vector<std::int64_t> shape;
  for (std::size_t i = 0; i < array.ndim(); ++i) shape.push_back(static_cast<std::int64_t>(array.shape(i)));
  return shape;
}

bool contiguous(const Imported& array) {
  for (std::size_t i = 0; i < array.ndim(); ++i)
    if (array.shape(i) == 0) return true;
  std::int64_t expected = 1;
  for (std::size_t i = array.ndim(); i-- > 0;) {
    const auto length = static_cast<std::int64_t>(array.shape(i));
    if (length != 1 && array.stride(i) != expected) return false;
    expected *= length;
  }
  return true;
}

template <typename T>
View<T> expect(const AnyArray& argument, const char* name, const Shape& expected, const char* dtype) {
  // The values stay alive with the argument itself; the import only looks at them.
  const Imported array = import(argument, name);
  const std::vector<std::int64_t> shape = shape_of(array);
  bool fits = shape.size() == expected.size() && array.dtype() == nb::dtype<T>();
  for (std::size_t i = 0; fits && i < shape.size(); ++i) fits = expected[i] == kAnyLength || expected[i] == shape[i];
  const bool dense = contiguous(array);
  if (!fits || !dense)
    refuse(std::string(name) + ": expected " + dtype + " " + shape_text(expected) + " C-contiguous, got " +
           dtype_name(array.dtype()) + " " + shape_text(shape) + (dense ? "" : " with strides"));
  return {static_cast<const T*>(array.data()), shape};
}

}  // namespace

std::size_t num_axes(const AnyArray& array, const char* name) { return import(array, name).ndim(); }

void refuse(const std::string& message) { throw nb::value_error(message.c_str()); }

template <typename T>
std::int64_t View<T>::size() const {
  std::int64_t size = 1;
  for (const std::int64_t length : shape) size *= length;
  return size;
}
template struct View<double>;
template struct View<float>;
template struct View<std::uint8_t>;
template struct View<std::int64_t>;

View<double> expect_floats(const AnyArray& array, const char* name, const Shape& shape, bool finite) {
  View<double> view = expect<double>(array, name, shape, "float64");
  if (finite) {
    const std::int64_t size = view.size();
    // x - x is 0 for a finite x and NaN otherwise: a sum that the compiler can turn into vector code.
    double differences[4] = {0.0, 0.0, 0.0, 0.0};
    std::int64_t i = 0;
    for (; i + 4 <= size; i += 4)
      for (int lane = 0; lane < 4; ++lane) differences[lane] += view.data[i + lane] - view.data[i + lane];
    for (; i < size; ++i) differences[0] += view.data[i] - view.data[i];
    if (!(differences[0] + differences[1] + differences[2] + differences[3] == 0.0)) {
      for (i = 0; i < size; ++i)
        if (!std::isfinite(view.data[i]))
          refuse(std::string(name) + ": every value must be finite; value " + std::to_string(i) +
                 " (flat index) is not");
    }
  }
  return view;
}

View<float> expect_singles(const AnyArray& array, const char* name, const Shape& shape) {
  return expect<float>(array, name, shape, "float32");
}

View<std::uint8_t> expect_bytes(const AnyArray& array, const char* name, const Shape& shape) {
  return expect<std::uint8_t>(array, name, shape, "uint8");
}

View<std::int64_t> expect_integers(const AnyArray& array, const char* name, const Shape& shape) {
  return expect<std::int64_t>(array, name, shape, "int64");
}

View<std::int64_t> expect_rows(const AnyArray& array, const char* name, std::int64_t length, std::int64_t limit) {
  View<std::int64_t> view = expect<std::int64_t>(array, name, {length}, "int64");
  for (std::int64_t i = 0; i < view.rows(); ++i)
    if (view.data[i] < 0 || view.data[i] >= limit)
      refuse(std::string(name) + ": entry " + std::to_string(i) + " is " + std::to_string(view.data[i]) +
             ", outside [0, " + std::to_string(limit) + ")");
  return view;
}

void expect_positive(const View<double>& view, const char* name) {
  for (std::int64_t i = 0; i < view.size(); ++i)
    if (!(view.data[i] > 0.0))
      refuse(std::string(name) + ": every value must be positive; value " + std::to_string(i) + " is " +
             std::to_string(view.data[i]));
}

Sigma expect_sigma(const AnyArray& array, const char* name, std::int64_t length, int dim) {
  Sigma sigma;
  if (num_axes(array, name) == 2) {
    sigma.view = expect_floats(array, name, {length, dim});
    sigma.columns = dim;
  } else {
    sigma.view = expect_floats(array, name, {length});
  }
  expect_positive(sigma.view, name);
  return sigma;
}

View<double> expect_weights(const AnyArray& array, const char* name, std::int64_t length) {
  View<double> view = expect_floats(array, name, {length});
  for (std::int64_t i = 0; i < view.rows(); ++i)
    if (view.data[i] < 0.0)
      refuse(std::string(name) + ": weights must not be negative; weight " + std::to_string(i) + " is " +
             std::to_string(view.data[i]));
  return view;
}

Kernel expect_kernel(int kind, double threshold) {
  if (kind < 0 || kind >= kKernelKinds)
    refuse("kernel: expected a code in [0, " + std::to_string(kKernelKinds) + "), got " + std::to_string(kind));
  if (!(threshold > 0.0) || !std::isfinite(threshold))
    refuse("threshold: expected a positive number, got " + std::to_string(threshold));
  return {static_cast<KernelKind>(kind), threshold};
}

int expect_threads(int threads) {
  if (threads < 0) refuse("threads: expected 0 (the cores) or a positive number, got " + std::to_string(threads));
  return resolve_threads(threads);
}

int expect_count(std::int64_t count, const char* name) {
  if (count < 0 || count > std::numeric_limits<int>::max())
    refuse(std::string(name) + ": " + std::to_string(count) + " rows are too many");
  return static_cast<int>(count);
}

}  // namespace uni4d_fg
