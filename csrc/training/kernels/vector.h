// Unaligned packs of the widest register of this translation unit (GCC and Clang vector extensions).
#pragma once

namespace perception::training::PERCEPTION_LEVEL {

template <class T>
struct Pack;

template <>
struct Pack<float> {
  static constexpr int size = PERCEPTION_VECTOR_BYTES / sizeof(float);
  typedef float type __attribute__((vector_size(PERCEPTION_VECTOR_BYTES), aligned(4), may_alias));
  typedef double wide __attribute__((vector_size(2 * PERCEPTION_VECTOR_BYTES)));
};

template <>
struct Pack<double> {
  static constexpr int size = PERCEPTION_VECTOR_BYTES / sizeof(double);
  typedef double type __attribute__((vector_size(PERCEPTION_VECTOR_BYTES), aligned(8), may_alias));
  typedef double wide __attribute__((vector_size(PERCEPTION_VECTOR_BYTES)));
};

#define PERCEPTION_LOAD(T, p) (*reinterpret_cast<const typename Pack<T>::type *>(p))
#define PERCEPTION_STORE(T, p) (*reinterpret_cast<typename Pack<T>::type *>(p))

// Sum in double: lanes first, then the tail, then the lanes in order.
template <class T, bool Squared>
double sum_row(const T *values, int64_t n) {
  constexpr int size = Pack<T>::size;
  typename Pack<T>::wide lanes = {};
  int64_t i = 0;
  for (; i + size <= n; i += size) {
    const auto v = __builtin_convertvector(PERCEPTION_LOAD(T, values + i), typename Pack<T>::wide);
    lanes += Squared ? v * v : v;
  }
  double total = 0;
  for (; i < n; ++i) total += Squared ? double(values[i]) * double(values[i]) : double(values[i]);
  for (int k = 0; k < size; ++k) total += lanes[k];
  return total;
}

}  // namespace perception::training::PERCEPTION_LEVEL
