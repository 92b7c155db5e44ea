// Python entry points of the factor types: factor_types, residual and linearize, and <name>_residual, <name>_linearize.
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>

#include "arrays.hpp"
#include "factor_types.hpp"
#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

namespace {

constexpr int kGrain = 2000;

using FloatArray = nb::ndarray<nb::numpy, double>;
using Linearized = std::pair<FloatArray, std::vector<FloatArray>>;

std::string joined(const std::vector<ArgumentInfo>& arguments) {
  std::string text;
  for (const ArgumentInfo& argument : arguments) text += (text.empty() ? "" : ", ") + std::string(argument.name);
  return text.empty() ? "none" : text;
}

/// A type and the names of its arguments as Python strings, which calls look up.
struct BoundType {
  const FactorType* type;
  std::vector<nb::str> names;
};

/// All types; never freed, because the interpreter may be gone by then.
const std::vector<BoundType>& bound_types() {
  static const auto* const types = [] {
    auto* out = new std::vector<BoundType>;
    for (const FactorType& type : factor_types()) {
      out->push_back({&type, {}});
      for (std::size_t i = 0; i < type.num_arguments(); ++i) out->back().names.emplace_back(type.argument(i).name);
    }
    return out;
  }();
  return *types;
}

const BoundType& find(const std::string& name) {
  std::string known;
  for (const BoundType& bound : bound_types())
    if (name == bound.type->name) return bound;
  for (const FactorType& type : factor_types()) known += (known.empty() ? "" : ", ") + std::string(type.name);
  refuse("factor type '" + name + "': this build of uni4d-fg-cpp has none of this name; it has " + known);
}

/// Return the arguments of a type, variables first, from two sequences, the second of which may be a dict by name.
std::vector<AnyArray> collect(const BoundType& bound, nb::handle variables, nb::handle data) {
  const FactorType& type = *bound.type;
  const std::string name = type.name;
  std::vector<AnyArray> values;
  values.reserve(type.num_arguments());
  if (!nb::isinstance<nb::sequence>(variables) || nb::isinstance<nb::str>(variables))
    throw nb::type_error((name + ": variables: expected a list of arrays").c_str());
  for (nb::handle array : variables) values.push_back({nb::borrow(array)});
  if (values.size() != type.variables.size())
    refuse(name + ": expected " + std::to_string(type.variables.size()) + " variables (" + joined(type.variables) +
           "), got " + std::to_string(values.size()));
  if (nb::isinstance<nb::dict>(data)) {
    const auto by_name = nb::borrow<nb::dict>(data);
    for (std::size_t i = type.variables.size(); i < type.num_arguments(); ++i) {
      nb::handle value = PyDict_GetItemWithError(by_name.ptr(), bound.names[i].ptr());
      if (!value.is_valid()) refuse(name + ": data '" + type.argument(i).name + "' is missing");
      values.push_back({nb::borrow(value)});
    }
    if (by_name.size() != type.data.size())
      refuse(name + ": expected " + std::to_string(type.data.size()) + " data (" + joined(type.data) + "), got " +
             nb::str(nb::list(by_name.keys())).c_str());
  } else if (!data.is_none()) {
    if (!nb::isinstance<nb::sequence>(data) || nb::isinstance<nb::str>(data))
      throw nb::type_error((name + ": data: expected a dict or a list of arrays").c_str());
    for (nb::handle array : data) values.push_back({nb::borrow(array)});
  }
  if (values.size() != type.num_arguments())
    refuse(name + ": expected " + std::to_string(type.data.size()) + " data (" + joined(type.data) + "), got " +
           std::to_string(values.size() - type.variables.size()));
  return values;
}

/// Check the arguments of a type, run a kernel over them and return the residual and, if asked, the Jacobians.
Linearized run(const FactorType& type, const std::vector<AnyArray>& values, bool linearize, int threads) {
  const double* in[kMostArguments] = {};
  std::int64_t rows = kAnyLength;
  for (std::size_t i = 0; i < values.size(); ++i) {
    const ArgumentInfo& argument = type.argument(i);
    Shape shape{rows};
    for (const int length : argument.shape)
      if (length > 0) shape.append(length);
    const View<double> view = expect_floats(values[i], argument.name, shape);
    if (argument.positive) expect_positive(view, argument.name);
    rows = view.rows();
    in[i] = view.data;
  }
  const int count = expect_count(rows, type.variables[0].name);
  const int workers = useful_threads(expect_threads(threads), count, kGrain);
  const auto n = static_cast<std::size_t>(count), dim = static_cast<std::size_t>(type.dim);
  std::vector<NewArray> results;
  results.emplace_back(std::vector<std::size_t>{n, dim});
  if (linearize)
    for (const ArgumentInfo& variable : type.variables)
      results.emplace_back(std::vector<std::size_t>{n, dim, static_cast<std::size_t>(variable.tangent)});
  double* out[kMostArguments + 1] = {};
  for (std::size_t i = 0; i < results.size(); ++i) out[i] = results[i].data();
  {
    nb::gil_scoped_release release;
    const BatchKernel kernel = linearize ? type.linearize : type.residual;
    parallel_for(count, workers, [&](int begin, int end, int) { kernel(in, out, begin, end); });
  }
  std::vector<FloatArray> jacobians;
  for (std::size_t i = 1; i < results.size(); ++i) jacobians.push_back(results[i].release());
  return {results[0].release(), jacobians};
}

/// Return the arguments of <name>_residual(*variables, **data, threads=0); each may also be given by its name.
std::vector<AnyArray> collect_named(const BoundType& bound, const nb::args& positional, const nb::kwargs& named,
                                    int& threads) {
  const FactorType& type = *bound.type;
  const std::string name = type.name;
  const auto raise = [&](const std::string& what) { throw nb::type_error((name + ": " + what).c_str()); };
  if (positional.size() > type.variables.size())
    raise("expected at most " + std::to_string(type.variables.size()) + " positional arguments (" +
          joined(type.variables) + "), got " + std::to_string(positional.size()));
  std::vector<AnyArray> values;
  values.reserve(type.num_arguments());
  std::size_t used = 0;
  for (std::size_t i = 0; i < type.num_arguments(); ++i) {
    nb::handle value = PyDict_GetItemWithError(named.ptr(), bound.names[i].ptr());
    if (i < positional.size()) {
      if (value.is_valid()) raise("'" + std::string(type.argument(i).name) + "' is given twice");
      values.push_back({positional[i]});
      continue;
    }
    if (!value.is_valid()) raise("'" + std::string(type.argument(i).name) + "' is missing");
    values.push_back({nb::borrow(value)});
    ++used;
  }
  threads = 0;
  if (named.contains("threads")) {
    if (!nb::try_cast(named["threads"], threads)) raise("threads: expected an int");
    ++used;
  }
  if (used != named.size())
    raise("expected the variables " + joined(type.variables) + ", the data " + joined(type.data) +
          " and threads, got " + nb::str(nb::list(named.keys())).c_str());
  return values;
}

nb::dict describe(const FactorType& type) {
  nb::list variables, data, positive;
  nb::dict shapes, tangents, out;
  for (const ArgumentInfo& variable : type.variables) {
    variables.append(variable.name);
    tangents[variable.name] = variable.tangent;
  }
  for (const ArgumentInfo& datum : type.data) data.append(datum.name);
  for (std::size_t i = 0; i < type.num_arguments(); ++i) {
    const ArgumentInfo& argument = type.argument(i);
    nb::list shape;
    for (const int length : argument.shape)
      if (length > 0) shape.append(length);
    shapes[argument.name] = nb::tuple(shape);
    if (argument.positive) positive.append(argument.name);
  }
  out["dim"] = type.dim;
  out["variables"] = variables;
  out["data"] = data;
  out["shapes"] = shapes;
  out["tangents"] = tangents;
  out["positive"] = positive;
  return out;
}

}  // namespace

void bind_factor_types(nb::module_& module) {
  module.def(
      "factor_types",
      [] {
        nb::dict out;
        for (const FactorType& type : factor_types()) out[type.name] = describe(type);
        return out;
      },
      "Return, by name, every factor type that has a kernel: dim of the residual, names of variables and data in "
      "order, "
      "shapes of a row by name, tangents of the variables, and the data that must be positive.");
  module.def(
      "residual",
      [](const std::string& name, nb::handle variables, nb::handle data, int threads) {
        const BoundType& bound = find(name);
        return run(*bound.type, collect(bound, variables, data), false, threads).first;
      },
      nb::arg("name"), nb::arg("variables"), nb::arg("data") = nb::none(), nb::arg("threads") = 0,
      "Return the residuals (N, d) of a factor type; variables in order, data by name or in order.");
  module.def(
      "linearize",
      [](const std::string& name, nb::handle variables, nb::handle data, int threads) {
        const BoundType& bound = find(name);
        return run(*bound.type, collect(bound, variables, data), true, threads);
      },
      nb::arg("name"), nb::arg("variables"), nb::arg("data") = nb::none(), nb::arg("threads") = 0,
      "Return the residuals (N, d) of a factor type and the Jacobian (N, d, tangent) of each variable.");
  for (const BoundType& bound : bound_types()) {
    const FactorType& type = *bound.type;
    const std::string name = type.name;
    if (nb::hasattr(module, (name + "_residual").c_str()))
      throw std::runtime_error("factor type '" + name + "' is declared twice");
    const std::string text =
        "variables: " + joined(type.variables) + "; data, by name: " + joined(type.data) + "; threads.";
    module.def((name + "_residual").c_str(),
               [&bound](const nb::args& variables, const nb::kwargs& data) {
                 int threads = 0;
                 const std::vector<AnyArray> values = collect_named(bound, variables, data, threads);
                 return run(*bound.type, values, false, threads).first;
               },
               ("Return the residuals (N, d); " + text).c_str());
    module.def((name + "_linearize").c_str(),
               [&bound](const nb::args& variables, const nb::kwargs& data) {
                 int threads = 0;
                 const std::vector<AnyArray> values = collect_named(bound, variables, data, threads);
                 return run(*bound.type, values, true, threads);
               },
               ("Return the residuals (N, d) and the Jacobians (N, d, tangent); " + text).c_str());
  }
}

}  // namespace uni4d_fg
