// Per-label sums over the pixels of a feature map, and the way back.
#pragma once
#include "table.h"

namespace perception::training::PERCEPTION_LEVEL {

template <class T, int Fixed>  // Fixed > 0: the width at compile time
void accumulate_width(const T *features, const int32_t *slots, const T *reference, int64_t begin, int64_t end,
                      int64_t width, double *sums) {
  const int64_t d = Fixed > 0 ? Fixed : width;
  for (int64_t p = begin; p < end; ++p) {
    const int32_t slot = slots[p];
    if (slot < 0) continue;
    const T *__restrict f = features + p * d;
    const T *__restrict ref = reference + slot * d;
    double *__restrict sum = sums + slot * 2 * d;
    for (int64_t k = 0; k < d; ++k) {
      const double e = double(f[k]) - double(ref[k]);
      sum[k] += e;
      sum[d + k] += e * e;
    }
  }
}

template <class T>
void accumulate(const T *features, const int32_t *slots, const T *reference, int64_t begin, int64_t end, int64_t width,
                double *sums) {
  const auto run = width == 8 ? accumulate_width<T, 8> : width == 16 ? accumulate_width<T, 16> : accumulate_width<T, 0>;
  run(features, slots, reference, begin, end, width, sums);
}

template <class T, int Fixed>
void spread_width(const T *features, const int32_t *slots, const double *mean, const double *pull, const double *push,
                  int64_t begin, int64_t end, int64_t width, T *out) {
  const int64_t d = Fixed > 0 ? Fixed : width;
  for (int64_t p = begin; p < end; ++p) {
    const int32_t slot = slots[p];
    T *__restrict to = out + p * d;
    if (slot < 0) {
      for (int64_t k = 0; k < d; ++k) to[k] = T(0);
      continue;
    }
    const T *__restrict f = features + p * d;
    const double *__restrict centre = mean + slot * d, *__restrict shift = push + slot * d;
    const double factor = pull[slot];
    for (int64_t k = 0; k < d; ++k) to[k] = T(factor * (double(f[k]) - centre[k]) + shift[k]);
  }
}

template <class T>
void spread(const T *features, const int32_t *slots, const double *mean, const double *pull, const double *push,
            int64_t begin, int64_t end, int64_t width, T *out) {
  const auto run = width == 8 ? spread_width<T, 8> : width == 16 ? spread_width<T, 16> : spread_width<T, 0>;
  run(features, slots, mean, pull, push, begin, end, width, out);
}

}  // namespace perception::training::PERCEPTION_LEVEL
