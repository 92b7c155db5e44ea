#include "arrays.hpp"

namespace uni4d_fg {

void bind_batches(nb::module_&) {}

}  // namespace uni4d_fg
