#include "arrays.hpp"

namespace uni4d_fg {

void bind_trajectory_system(nb::module_&) {}

}  // namespace uni4d_fg
