#include <nanobind/nanobind.h>

namespace nb = nanobind;

namespace uni4d_fg {
void bind_factor_types(nb::module_& module);
void bind_whitening(nb::module_& module);
void bind_pair_system(nb::module_& module);
void bind_landmark_system(nb::module_& module);
void bind_trajectory_system(nb::module_& module);
void bind_patch_registration(nb::module_& module);
void bind_plane_sweep(nb::module_& module);
void bind_frame_comparison(nb::module_& module);
void bind_guided_median(nb::module_& module);
void bind_guided_upsampling(nb::module_& module);
void bind_triangulation(nb::module_& module);
void bind_moved_evidence(nb::module_& module);
}  // namespace uni4d_fg

NB_MODULE(_core, module) {
  module.doc() = "C++ factors and linear solvers for uni4d_fg.";
  // Objects that outlive the interpreter's own clean-up (in a failed test, say) are no reason to print.
  nb::set_leak_warnings(false);
  // Raised by every new entry point and every change of a signature or of a meaning.
  module.attr("ABI") = 15;
  uni4d_fg::bind_factor_types(module);
  uni4d_fg::bind_whitening(module);
  uni4d_fg::bind_pair_system(module);
  uni4d_fg::bind_landmark_system(module);
  uni4d_fg::bind_trajectory_system(module);
  uni4d_fg::bind_patch_registration(module);
  uni4d_fg::bind_plane_sweep(module);
  uni4d_fg::bind_frame_comparison(module);
  uni4d_fg::bind_guided_median(module);
  uni4d_fg::bind_guided_upsampling(module);
  uni4d_fg::bind_triangulation(module);
  uni4d_fg::bind_moved_evidence(module);
}
