// Constants of the 3DGS equations that projection and blending share.
#pragma once

namespace perception {

constexpr int kBlock = 256;  // Gaussians worked on together
template <class T>
constexpr T kLog2E = T(1.4426950408889634);
template <class T>
constexpr T kLogThreshold = T(-7.994353436858858);  // log2(1/255)
template <class T>
constexpr T kMaxAlpha = T(0.999);
template <class T>
constexpr T kMinTransmittance = T(1e-4);

}  // namespace perception
