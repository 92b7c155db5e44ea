// What linearization sums up per frame: the symmetric products of the columns (pose 6, log-scale, intrinsics, r).
#pragma once

#include "uni4d_fg/simd.hpp"

namespace uni4d_fg::frame_sums {

/// Places of the sums; products that are always zero have none.
constexpr int kPose = 0;                 ///< 21: lower triangle, row by row
constexpr int kPoseGradient = 21;        ///< 6
constexpr int kPoseScale = 27;           ///< 3: log-scale with pose entries 0, 1, 5
constexpr int kScale = 30;               ///< log-scale squared, log-scale gradient
constexpr int kPoseU = 32;               ///< (5, 2): pose entries 0, 1, 2, 3, 5 with fx, cx
constexpr int kPoseV = 42;               ///< (5, 2): pose entries 0, 1, 2, 4, 5 with fy, cy
constexpr int kIntrinsicsU = 52;         ///< fx fx, fx cx, cx cx
constexpr int kIntrinsicsV = 55;         ///< fy fy, fy cy, cy cy
constexpr int kIntrinsicsGradient = 58;  ///< fx, fy, cx, cy
constexpr int kSums = 62;

constexpr int kPoseOfU[5] = {0, 1, 2, 3, 5};
constexpr int kPoseOfV[5] = {0, 1, 2, 4, 5};
constexpr int kPoseOfDepth[3] = {0, 1, 5};

UNI4D_FG_INLINE constexpr int lower(int row, int column) { return row * (row + 1) / 2 + column; }

}  // namespace uni4d_fg::frame_sums
