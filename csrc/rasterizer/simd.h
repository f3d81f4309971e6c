// Vec<T> and Mask<T>: one native register of the level this file is compiled for, with the few operations the kernels
// need. AVX-512 and AVX2 use intrinsics, for float; the baseline uses GCC's vector extensions (any processor).
#pragma once
#include <cstdint>
#include <cstring>
#include <type_traits>

#if defined(PERCEPTION_LEVEL_avx512) || defined(PERCEPTION_LEVEL_avx2)
#include <immintrin.h>
#endif

namespace perception::PERCEPTION_LEVEL {

template <class T>
struct Native;  // the register Real and what a comparison gives, Bits
#if defined(PERCEPTION_LEVEL_avx512)
template <>
struct Native<float> {
  using Real = __m512;
  using Bits = __mmask16;
};
#elif defined(PERCEPTION_LEVEL_avx2)
template <>
struct Native<float> {
  using Real = __m256;
  using Bits = __m256;
};
#else
template <>
struct Native<float> {
  typedef float Real __attribute__((vector_size(16)));
  typedef int32_t Bits __attribute__((vector_size(16)));  // all ones or all zeros
};
template <>
struct Native<double> {
  typedef double Real __attribute__((vector_size(16)));
  typedef int64_t Bits __attribute__((vector_size(16)));
};
#endif

template <class T>
struct Mask {
  typename Native<T>::Bits m;
};

template <class T>
struct Vec {
  using Real = typename Native<T>::Real;
  static constexpr int kLanes = sizeof(Real) / sizeof(T);
  Real v;
  Vec() = default;
  Vec(Real x) : v(x) {}
  explicit Vec(T x) : v(x - Real{}) {}
  static Vec load(const T *p) {
    Real r;
    std::memcpy(&r, p, sizeof r);
    return r;
  }
  void store(T *p) const { std::memcpy(p, &v, sizeof v); }
  friend Vec operator+(Vec a, Vec b) { return a.v + b.v; }
  friend Vec operator-(Vec a, Vec b) { return a.v - b.v; }
  friend Vec operator*(Vec a, Vec b) { return a.v * b.v; }
};

}  // namespace perception::PERCEPTION_LEVEL

// What differs from level to level:
//   fma(a, b, c) = a b + c, fnma(a, b, c) = c - a b, min, max, comparisons >= and <
//   fraction(a, whole): a - floor(a), and the rest in the form that scale_by_power_of_two(p, whole) = p 2^whole wants
//   reciprocal(a): relative error below 2e-7 in float
//   magnitude(a) = |a|
//   &, |, and_not(a, b) = a and not b, bits(m): lane j as bit j, any(m)
//   keep(m, a) = m ? a : 0, select(m, a, b) = m ? a : b
//   sum(a) over the lanes; transpose_sum(v): lane j is the sum over the lanes of v[j]
//   append_to_lists(masks, ids, lists, stride, counts): for j < 16, where bit g of masks[j] is set, appends ids[j] to
//     list g, of counts[g] numbers at lists + g stride. Writes up to 16 numbers past the end of each list.
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
  Vec<float> whole, r = fraction(x, whole);
  Vec<float> p = Vec<float>(1.8775767e-3f);
  p = fma(p, r, Vec<float>(8.9893397e-3f));
  p = fma(p, r, Vec<float>(5.5826318e-2f));
  p = fma(p, r, Vec<float>(2.4015361e-1f));
  p = fma(p, r, Vec<float>(6.9315308e-1f));
  p = fma(p, r, Vec<float>(9.9999994e-1f));
  return scale_by_power_of_two(p, whole);
}

#if defined(PERCEPTION_LEVEL_baseline)
inline Vec<double> exp2_nonpositive(Vec<double> x) {
  // ln(2)^k / k!, from k = 17 down to 1
  constexpr double kTaylor[] = {5.533046532458238e-18,  1.357024794875514e-16,  3.132436707088427e-15,
                                6.778726354822543e-14,  1.3691488853904124e-12, 2.5678435993488196e-11,
                                4.44553827187081e-10,   7.054911620801121e-09,  1.0178086009239696e-07,
                                1.3215486790144305e-06, 1.5252733804059838e-05, 0.00015403530393381606,
                                0.0013333558146428441,  0.009618129107628477,   0.055504108664821576,
                                0.2402265069591007,     0.6931471805599453};
  Vec<double> whole, r = fraction(x, whole);
  Vec<double> p = Vec<double>(kTaylor[0]);
  for (int k = 1; k < 17; ++k) p = fma(p, r, Vec<double>(kTaylor[k]));
  p = fma(p, r, Vec<double>(1.0));
  return scale_by_power_of_two(p, whole);
}
#endif

// Two registers side by side: they share what is broadcast and hide each other's latency.
template <class T>
struct PairMask {
  Mask<T> a, b;
  friend PairMask and_not(PairMask x, PairMask y) { return {and_not(x.a, y.a), and_not(x.b, y.b)}; }
  friend bool any(PairMask x) { return any(x.a | x.b); }
  friend uint32_t bits(PairMask x) { return bits(x.a) | bits(x.b) << Vec<T>::kLanes; }
};

template <class T>
struct Pair {
  static constexpr int kLanes = 2 * Vec<T>::kLanes;
  using V = Vec<T>;
  V a, b;
  Pair() = default;
  Pair(V x, V y) : a(x), b(y) {}
  explicit Pair(T x) : a(x), b(a) {}
  static Pair load(const T *p) { return {V::load(p), V::load(p + V::kLanes)}; }
  void store(T *p) const { a.store(p), b.store(p + V::kLanes); }
  friend Pair operator+(Pair x, Pair y) { return {x.a + y.a, x.b + y.b}; }
  friend Pair operator-(Pair x, Pair y) { return {x.a - y.a, x.b - y.b}; }
  friend Pair operator*(Pair x, Pair y) { return {x.a * y.a, x.b * y.b}; }
  friend Pair fma(Pair x, Pair y, Pair z) { return {fma(x.a, y.a, z.a), fma(x.b, y.b, z.b)}; }
  friend Pair fnma(Pair x, Pair y, Pair z) { return {fnma(x.a, y.a, z.a), fnma(x.b, y.b, z.b)}; }
  friend Pair min(Pair x, Pair y) { return {min(x.a, y.a), min(x.b, y.b)}; }
  friend Pair reciprocal(Pair x) { return {reciprocal(x.a), reciprocal(x.b)}; }
  friend Pair exp2_nonpositive(Pair x) { return {exp2_nonpositive(x.a), exp2_nonpositive(x.b)}; }
  friend Pair keep(PairMask<T> m, Pair x) { return {keep(m.a, x.a), keep(m.b, x.b)}; }
  friend Pair select(PairMask<T> m, Pair x, Pair y) { return {select(m.a, x.a, y.a), select(m.b, x.b, y.b)}; }
  friend PairMask<T> operator>=(Pair x, Pair y) { return {x.a >= y.a, x.b >= y.b}; }
  friend PairMask<T> operator<(Pair x, Pair y) { return {x.a < y.a, x.b < y.b}; }
  // Both registers into one sum.
  friend V add(Pair x, V sum) { return sum + x.a + x.b; }
  friend V add_size(Pair x, V sum) { return sum + magnitude(x.a) + magnitude(x.b); }
  friend V add_product(Pair x, Pair y, V sum) { return fma(x.b, y.b, fma(x.a, y.a, sum)); }
};

template <class T>
inline Vec<T> add(Vec<T> x, Vec<T> sum) {
  return sum + x;
}
template <class T>
inline Vec<T> add_size(Vec<T> x, Vec<T> sum) {
  return sum + magnitude(x);
}
template <class T>
inline Vec<T> add_product(Vec<T> x, Vec<T> y, Vec<T> sum) {
  return fma(x, y, sum);
}

// What the blending loops work on: a granule's register, or two where it takes more than one.
template <class T>
using Pack = std::conditional_t<kParts<T> == 1, Vec<T>, Pair<T>>;
template <class T>
using PackMask = std::conditional_t<kParts<T> == 1, Mask<T>, PairMask<T>>;

}  // namespace perception::PERCEPTION_LEVEL
