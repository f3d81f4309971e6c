// Unaligned packs of the widest register of this translation unit (GCC and Clang vector extensions).
#pragma once

namespace perception::training::PERCEPTION_LEVEL {

#if defined(PERCEPTION_LEVEL_avx512)
constexpr int kVectorBytes = 64;
#elif defined(PERCEPTION_LEVEL_avx2)
constexpr int kVectorBytes = 32;
#else
constexpr int kVectorBytes = 16;
#endif

template <class T>
struct Pack;

template <>
struct Pack<float> {
  static constexpr int size = kVectorBytes / sizeof(float);
  typedef float type __attribute__((vector_size(kVectorBytes), aligned(4), may_alias));
  typedef float half __attribute__((vector_size(kVectorBytes / 2), aligned(4), may_alias));
};

template <>
struct Pack<double> {
  static constexpr int size = kVectorBytes / sizeof(double);
  typedef double type __attribute__((vector_size(kVectorBytes), aligned(8), may_alias));
  typedef type half;
};

#define PERCEPTION_LOAD(T, p) (*reinterpret_cast<const typename Pack<T>::type *>(p))
#define PERCEPTION_STORE(T, p) (*reinterpret_cast<typename Pack<T>::type *>(p))

// As many doubles as fit a register, converted from values (GCC takes wider conversions to pieces).
typedef double Doubles __attribute__((vector_size(kVectorBytes)));

template <class T>
Doubles load_doubles(const T *values) {
  return __builtin_convertvector(*reinterpret_cast<const typename Pack<T>::half *>(values), Doubles);
}

// Sum in double in four interleaved series, added up in one order.
template <class T, bool Squared>
double sum_row(const T *values, int64_t n) {
  constexpr int size = kVectorBytes / sizeof(double);
  Doubles lanes[4] = {};
  int64_t i = 0;
  for (; i + 4 * size <= n; i += 4 * size)
    for (int k = 0; k < 4; ++k) {
      const Doubles v = load_doubles(values + i + k * size);
      lanes[k] += Squared ? v * v : v;
    }
  double total = 0;
  for (; i < n; ++i) total += Squared ? double(values[i]) * double(values[i]) : double(values[i]);
  const Doubles sum = (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]);
  for (int k = 0; k < size; ++k) total += sum[k];
  return total;
}

}  // namespace perception::training::PERCEPTION_LEVEL
