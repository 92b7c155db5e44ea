// Every factor type that has a header in include/uni4d_fg/factors, as kernels over whole batches: rows of gathered
// arguments in, residuals and Jacobians out.
#pragma once

#include <array>
#include <string_view>
#include <vector>

namespace uni4d_fg {

/// Most arguments of a factor type, variables and data together.
constexpr int kMostArguments = 16;

/// How the rows of one argument are stored.
struct ArgumentInfo {
  const char* name;
  int numbers;               ///< Per row.
  std::array<int, 2> shape;  ///< Of a row; 0 where there is no such axis.
  int tangent;               ///< Width of a variable's Jacobian.
  bool positive;
};

/// Compute rows [begin, end). `in` holds one pointer per argument, variables first; `out` the residual, then one
/// Jacobian per variable.
using BatchKernel = void (*)(const double* const* in, double* const* out, int begin, int end);

struct FactorType {
  const char* name;
  int dim;  ///< Of the residual.
  std::vector<ArgumentInfo> variables, data;
  BatchKernel residual;
  BatchKernel linearize;

  std::size_t num_arguments() const { return variables.size() + data.size(); }
  const ArgumentInfo& argument(std::size_t i) const {
    return i < variables.size() ? variables[i] : data[i - variables.size()];
  }
};

/// All of them, in the order of their headers.
const std::vector<FactorType>& factor_types();

}  // namespace uni4d_fg
