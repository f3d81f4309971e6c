// Vec<T> and Mask<T>: one native register of the level this file is compiled for, with the few operations the
// kernels need. AVX-512 and AVX2 use intrinsics; the baseline uses GCC's vector extensions (any processor).
#pragma once
#include <cstdint>
#include <cstring>

#if defined(PERCEPTION_LEVEL_avx512)
#include "simd_avx512.h"
#elif defined(PERCEPTION_LEVEL_avx2)
#include "simd_avx2.h"
#else
#include "simd_baseline.h"
#endif

namespace perception::PERCEPTION_LEVEL {

template <class T>
constexpr int kParts = 16 / Vec<T>::kLanes;  // registers per granule of 16 pixels

// 2^x for x in (-100, 0]; results for other x are arbitrary and must be masked out.
// float: minimax polynomial of degree 5 on [0, 1), relative error 1.5e-7. double: Taylor of degree 17, 1 ulp or so.
inline Vec<float> exp2_nonpositive(Vec<float> x) {
  Vec<float> whole = floor(x), r = x - whole;
  Vec<float> p = Vec<float>(1.8775767e-3f);
  p = fma(p, r, Vec<float>(8.9893397e-3f));
  p = fma(p, r, Vec<float>(5.5826318e-2f));
  p = fma(p, r, Vec<float>(2.4015361e-1f));
  p = fma(p, r, Vec<float>(6.9315308e-1f));
  p = fma(p, r, Vec<float>(9.9999994e-1f));
  return scale_by_power_of_two(p, whole);
}

inline Vec<double> exp2_nonpositive(Vec<double> x) {
  // ln(2)^k / k!, from k = 17 down to 1
  constexpr double kTaylor[] = {5.533046532458238e-18, 1.357024794875514e-16, 3.132436707088427e-15,
                                6.778726354822543e-14, 1.3691488853904124e-12, 2.5678435993488196e-11,
                                4.44553827187081e-10, 7.054911620801121e-09, 1.0178086009239696e-07,
                                1.3215486790144305e-06, 1.5252733804059838e-05, 0.00015403530393381606,
                                0.0013333558146428441, 0.009618129107628477, 0.055504108664821576,
                                0.2402265069591007, 0.6931471805599453};
  Vec<double> whole = floor(x), r = x - whole;
  Vec<double> p = Vec<double>(kTaylor[0]);
  for (int k = 1; k < 17; ++k) p = fma(p, r, Vec<double>(kTaylor[k]));
  p = fma(p, r, Vec<double>(1.0));
  return scale_by_power_of_two(p, whole);
}

}  // namespace perception::PERCEPTION_LEVEL
