// Whole batches of one factor family: rows of gathered arguments in, residuals and Jacobians out.
#pragma once

namespace uni4d_fg {

/// Most arguments of a family, variables and data together.
constexpr int kMaxArguments = 6;

/// How one argument stores a row.
struct Argument {
  const char* name;
  /// Numbers per row: 16 for a pose (N, 4, 4), otherwise the length of the last axis.
  int columns;
  /// Whether the array is (N,) rather than (N, columns).
  bool scalar;
  /// Width of the Jacobian; 0 for data.
  int tangent;
  bool positive;
};

/// Compute rows [begin, end). `in` holds one pointer per argument; `out` the residual, then one Jacobian per variable.
using BatchKernel = void (*)(const double* const* in, double* const* out, int begin, int end);

/// One family: its arguments (variables first) and its two kernels.
struct BatchFamily {
  const char* name;
  int dim;
  int num_variables;
  int num_arguments;
  Argument arguments[kMaxArguments];
  BatchKernel residual;
  BatchKernel linearize;
};

/// All families, and their number.
extern const BatchFamily kFamilies[];
extern const int kNumFamilies;

}  // namespace uni4d_fg
