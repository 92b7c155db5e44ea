#include "factor_types.hpp"

#include <utility>

#include "uni4d_fg/factor_type.hpp"

namespace uni4d_fg {

namespace {

std::vector<FactorType>& listed() {
  static std::vector<FactorType> types;
  return types;
}

/// Type as which argument i is read.
template <typename Type>
using Arguments = decltype(std::tuple_cat(Type::kVariables, Type::kData));
template <typename Type, std::size_t i>
using Row = Stored<typename std::tuple_element_t<i, Arguments<Type>>::Type>;

template <typename Type>
constexpr auto all_arguments() {
  return std::make_index_sequence<std::tuple_size_v<Arguments<Type>>>();
}

template <typename Type>
constexpr auto all_variables() {
  return std::make_index_sequence<std::tuple_size_v<decltype(Type::kVariables)>>();
}

template <typename Type, std::size_t... a>
UNI4D_FG_INLINE void residual_row(const double* const* in, double* const* out, long n, std::index_sequence<a...>) {
  Type::residual(Row<Type, a>::load(in[a] + Row<Type, a>::kNumbers * n)..., out[0] + Type::kDim * n);
}

/// The Jacobian of variable v is output v + 1; variables are the first arguments.
template <typename Type, std::size_t... a, std::size_t... v>
UNI4D_FG_INLINE void linearize_row(const double* const* in, double* const* out, long n, std::index_sequence<a...>,
                                   std::index_sequence<v...>) {
  Type::linearize(Row<Type, a>::load(in[a] + Row<Type, a>::kNumbers * n)..., out[0] + Type::kDim * n,
                  out[v + 1] + Type::kDim * Row<Type, v>::kTangent * n...);
}

template <typename T>
ArgumentInfo info_of(const Argument<T>& argument, bool variable) {
  const bool number = !variable && std::is_same_v<T, double>;
  const std::array<int, 2> shape = number ? std::array<int, 2>{0, 0} : Stored<T>::kShape;
  return {argument.name, Stored<T>::kNumbers, shape, variable ? Stored<T>::kTangent : 0, argument.positive};
}

template <typename Type>
bool list(BatchKernel residual, BatchKernel linearize) {
  static_assert(std::tuple_size_v<decltype(Type::kVariables)> > 0, "a factor reads a variable");
  static_assert(std::tuple_size_v<Arguments<Type>> <= kMostArguments, "too many arguments");
  FactorType type{Type::kName, Type::kDim, {}, {}, residual, linearize};
  std::apply([&](const auto&... each) { (type.variables.push_back(info_of(each, true)), ...); }, Type::kVariables);
  std::apply([&](const auto&... each) { (type.data.push_back(info_of(each, false)), ...); }, Type::kData);
  listed().push_back(std::move(type));
  return true;
}

}  // namespace

}  // namespace uni4d_fg

// What a header's last line means here: two loops over rows, compiled for several processors, and a place in the list.
// Functions with such versions cannot be templates, hence the macro.
#undef UNI4D_FG_FACTOR_TYPE
#define UNI4D_FG_FACTOR_TYPE(Type)                                                                                    \
  namespace batch_kernels {                                                                                           \
  UNI4D_FG_CLONES void Type##_residual(const double* const* in, double* const* out, int begin, int end) {             \
    for (long n = begin; n < end; ++n) residual_row<Type>(in, out, n, all_arguments<Type>());                         \
  }                                                                                                                   \
  UNI4D_FG_CLONES void Type##_linearize(const double* const* in, double* const* out, int begin, int end) {            \
    for (long n = begin; n < end; ++n) linearize_row<Type>(in, out, n, all_arguments<Type>(), all_variables<Type>()); \
  }                                                                                                                   \
  const bool Type##_is_listed = list<Type>(Type##_residual, Type##_linearize);                                        \
  }

// Written by CMake: one #include per header in include/uni4d_fg/factors.
#include "uni4d_fg/all_factors.hpp"

namespace uni4d_fg {

const std::vector<FactorType>& factor_types() { return listed(); }

}  // namespace uni4d_fg
