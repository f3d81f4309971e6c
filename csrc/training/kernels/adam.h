// Adam on selected rows (Kingma & Ba 2015, algorithm 1, on the rows a mask selects).
#pragma once
#include "table.h"
#include "vector.h"

namespace perception::training::PERCEPTION_LEVEL {

inline float root(float x) { return __builtin_sqrtf(x); }
inline double root(double x) { return __builtin_sqrt(x); }

template <class T>
bool all_finite(const T *values, int64_t n) {
  // 0 x is 0 for a finite x and NaN otherwise, and NaN stays in a sum.
  constexpr int size = Pack<T>::size;
  typename Pack<T>::type lanes[4] = {};
  int64_t i = 0;
  for (; i + 4 * size <= n; i += 4 * size)
    for (int k = 0; k < 4; ++k) lanes[k] += T(0) * PERCEPTION_LOAD(T, values + i + k * size);
  T sum = 0;
  for (; i < n; ++i) sum += T(0) * values[i];
  const typename Pack<T>::type all = (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]);
  for (int k = 0; k < size; ++k) sum += all[k];
  return sum == T(0);
}

// RateStep 0: one rate for all elements; 1: one per element. Selected: where select is 0 the factors become 1 and 0,
// which leaves every finite number as it was (masked stores would be slow on some processors). Their gradients, which
// may be left from an earlier step, are not looked at.
template <class T, int RateStep, bool Selected = false>
void update(const AdamRows<T> &a, int64_t from, int64_t n, const T *__restrict select = nullptr) {
  T *__restrict param = a.param + from, *__restrict first = a.first + from, *__restrict second = a.second + from;
  const T *__restrict grad = a.grad + from, *__restrict rate = a.rate;
  const T eps = a.eps, scale = a.second_scale, rate0 = a.rate[0];
  const T keep1 = a.beta1, keep2 = a.beta2, gain1 = T(1) - keep1, gain2 = T(1) - keep2;
#pragma GCC ivdep
  for (int64_t i = 0; i < n; ++i) {
    const bool take = !Selected || select[i] != T(0);
    const T g = take ? grad[i] : T(0);
    const T m = (take ? keep1 : T(1)) * first[i] + (take ? gain1 : T(0)) * g;
    const T v = (take ? keep2 : T(1)) * second[i] + (take ? gain2 : T(0)) * (g * g);
    first[i] = m;
    second[i] = v;
    param[i] -= (take ? RateStep ? rate[i] : rate0 : T(0)) * m / (root(v) * scale + eps);
  }
}

constexpr int64_t kBlockElements = 1024;

// Rows [from, to), those selected, one at a time. Returns how many were skipped.
template <class T>
int64_t update_each(const AdamRows<T> &a, int64_t from, int64_t to) {
  int64_t skipped = 0;
  for (int64_t row = from; row < to; ++row) {
    if (a.visible && !a.visible[row]) continue;
    if (!all_finite(a.grad + row * a.width, a.width)) {
      ++skipped;
      continue;
    }
    a.uniform ? update<T, 0>(a, row * a.width, a.width) : update<T, 1>(a, row * a.width, a.width);
  }
  return skipped;
}

template <class T, int Fixed>  // Fixed > 0: the width at compile time
void repeat(const uint8_t *visible, int64_t rows, int64_t width, T *__restrict select) {
  const int64_t w = Fixed > 0 ? Fixed : width;
  for (int64_t row = 0; row < rows; ++row)
    for (int64_t k = 0; k < w; ++k) select[row * w + k] = T(visible[row]);
}

// Scattered rows: cheaper to compute all of the block and take those selected.
template <class T>
void update_selected(const AdamRows<T> &a, int64_t from, int64_t to) {
  alignas(64) T select[kBlockElements];
  const int64_t w = a.width;
  (w == 1   ? repeat<T, 1>
   : w == 3 ? repeat<T, 3>
   : w == 4 ? repeat<T, 4>
   : w == 8 ? repeat<T, 8>
            : repeat<T, 0>)(a.visible + from, to - from, w, select);
  update<T, 0, true>(a, from * w, (to - from) * w, select);
}

template <class T>
int64_t adam(const AdamRows<T> &a, int64_t begin, int64_t end) {
  const int64_t width = a.width, block = width < kBlockElements ? kBlockElements / width : 1;
  int64_t skipped = 0;
  for (int64_t from = begin; from < end; from += block) {
    const int64_t to = from + block < end ? from + block : end, rows = to - from;
    int64_t chosen = rows;
    if (a.visible) {
      chosen = 0;
      for (int64_t row = from; row < to; ++row) chosen += a.visible[row] != 0;
    }
    if (chosen == 0) continue;
    const bool whole = a.uniform && (chosen == rows || (width < kBlockElements && 3 * chosen >= rows));
    if (!whole || !all_finite(a.grad + from * width, rows * width)) {
      skipped += update_each(a, from, to);
      continue;
    }
    if (chosen == rows)
      update<T, 0>(a, from * width, rows * width);
    else
      update_selected(a, from, to);
  }
  return skipped;
}

}  // namespace perception::training::PERCEPTION_LEVEL
