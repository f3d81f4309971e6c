// exp(x) and 1 / (1 + exp(-x)), for the activated scales and opacities.
#pragma once
#include <cstdint>

#include "vector.h"

namespace perception::training::PERCEPTION_LEVEL {

// exp(x) = 2^n exp(r) with n the integer nearest to x / ln 2 and |r| <= ln 2 / 2; exp(r) by the minimax polynomial of
// Moshier's Cephes library. Within 2 units in the last place from -87 to 88; at least 1e-38, and infinite above 88.
inline float exponential(float x) {
  constexpr float kLowest = -87.3f, kHighest = 88.f, kRound = 12582912.f;  // x + 1.5 2^23 rounds x to an integer
  const float bounded = x < kLowest ? kLowest : x > kHighest ? kHighest : x == x ? x : 0.f;
  const float n = (bounded * 1.44269504f + kRound) - kRound;
  const float r = (bounded - n * 0.693359375f) + n * 2.12194440e-4f;
  float p = 1.9875691500e-4f;
  p = p * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  p = (p * (r * r) + r) + 1.f;
  const int32_t bits = (static_cast<int32_t>(n) + 127) << 23;
  float power;
  __builtin_memcpy(&power, &bits, sizeof power);
  return x == x ? x > kHighest ? __builtin_inff() : p * power : x;
}

inline double exponential(double x) { return __builtin_exp(x); }

template <class T>
void exponentials(const T *values, int64_t n, T *out) {
  for (int64_t i = 0; i < n; ++i) out[i] = exponential(values[i]);
}

// Beyond +-80 as there, so that no result is 0. The steps are loops of their own: GCC takes all in one to pieces.
template <class T>
void logistics(const T *values, int64_t n, T *out) {
  for (int64_t i = 0; i < n; ++i) out[i] = values[i] < T(-80) ? T(80) : -values[i];
  for (int64_t i = 0; i < n; ++i) out[i] = out[i] < T(-80) ? T(-80) : out[i];
  for (int64_t i = 0; i < n; ++i) out[i] = exponential(out[i]);
  for (int64_t i = 0; i < n; ++i) out[i] = T(1) / (T(1) + out[i]);
}

}  // namespace perception::training::PERCEPTION_LEVEL
