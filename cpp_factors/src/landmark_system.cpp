#include "uni4d_fg/math.hpp"
