// Adam on selected rows (Kingma & Ba 2015, algorithm 1, on the rows a mask selects).
#pragma once
#include "table.h"

namespace perception::training::PERCEPTION_LEVEL {

inline float root(float x) { return __builtin_sqrtf(x); }
inline double root(double x) { return __builtin_sqrt(x); }

template <class T>
bool all_finite(const T *__restrict values, int64_t n) {
  // x - x is 0 for a finite x and NaN otherwise; NaN is the only value not equal to itself.
  int bad = 0;
  for (int64_t i = 0; i < n; ++i) bad |= !(values[i] - values[i] == T(0));
  return !bad;
}

// rate_step 0: one rate for all elements; 1: one per element.
template <class T, int RateStep>
void update(const AdamRows<T> &a, int64_t from, int64_t n) {
  T *__restrict param = a.param + from, *__restrict first = a.first + from, *__restrict second = a.second + from;
  const T *__restrict grad = a.grad + from, *__restrict rate = a.rate;
  const T beta1 = a.beta1, beta2 = a.beta2, eps = a.eps, scale = a.second_scale;
  for (int64_t i = 0; i < n; ++i) {
    const T g = grad[i];
    const T m = beta1 * first[i] + (T(1) - beta1) * g;
    const T v = beta2 * second[i] + (T(1) - beta2) * g * g;
    first[i] = m;
    second[i] = v;
    param[i] -= rate[RateStep * i] * m / (root(v) * scale + eps);
  }
}

template <class T>
int64_t adam(const AdamRows<T> &a, int64_t begin, int64_t end, int64_t *updated) {
  const int64_t width = a.width;
  int64_t skipped = 0, done = 0;
  auto row_by_row = [&](int64_t from, int64_t to) {
    for (int64_t row = from; row < to; ++row) {
      if (!all_finite(a.grad + row * width, width)) {
        ++skipped;
        continue;
      }
      a.uniform ? update<T, 0>(a, row * width, width) : update<T, 1>(a, row * width, width);
      ++done;
    }
  };
  for (int64_t row = begin; row < end;) {
    if (a.visible && !a.visible[row]) {
      ++row;
      continue;
    }
    int64_t stop = row + 1;  // a run of selected rows, short enough to stay in the L1
    while (stop < end && (stop - row) * width < 2048 && (!a.visible || a.visible[stop])) ++stop;
    if (a.uniform && stop - row > 1 && all_finite(a.grad + row * width, (stop - row) * width)) {
      update<T, 0>(a, row * width, (stop - row) * width);
      done += stop - row;
    } else {
      row_by_row(row, stop);
    }
    row = stop;
  }
  *updated = done;
  return skipped;
}

}  // namespace perception::training::PERCEPTION_LEVEL
