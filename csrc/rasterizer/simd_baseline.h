// 128-bit registers through GCC's vector extensions: compiles for any processor.
#pragma once
#include "simd.h"

namespace perception::baseline {

template <class T>
constexpr int kMantissa = sizeof(T) == 4 ? 23 : 52;

template <class T>
inline Vec<T> fma(Vec<T> a, Vec<T> b, Vec<T> c) {
  return a.v * b.v + c.v;
}
template <class T>
inline Vec<T> fnma(Vec<T> a, Vec<T> b, Vec<T> c) {
  return c.v - a.v * b.v;
}
template <class T>
inline Vec<T> min(Vec<T> a, Vec<T> b) {
  return a.v < b.v ? a.v : b.v;
}
template <class T>
inline Vec<T> max(Vec<T> a, Vec<T> b) {
  return a.v > b.v ? a.v : b.v;
}
template <class T>
inline Vec<T> magnitude(Vec<T> a) {
  return max(a, Vec<T>(T(0)) - a);
}
template <class T>
inline Vec<T> reciprocal(Vec<T> a) {
  return (typename Vec<T>::Real{} + 1) / a.v;
}
template <class T>
inline Vec<T> keep(Mask<T> m, Vec<T> a) {
  return m.m ? a.v : typename Vec<T>::Real{};
}
template <class T>
inline Vec<T> select(Mask<T> m, Vec<T> a, Vec<T> b) {
  return m.m ? a.v : b.v;
}
template <class T>
inline Mask<T> operator>=(Vec<T> a, Vec<T> b) {
  return {a.v >= b.v};
}
template <class T>
inline Mask<T> operator<(Vec<T> a, Vec<T> b) {
  return {a.v < b.v};
}
template <class T>
Mask<T> operator&(Mask<T> a, Mask<T> b) {
  return {a.m & b.m};
}
template <class T>
Mask<T> operator|(Mask<T> a, Mask<T> b) {
  return {a.m | b.m};
}
template <class T>
Mask<T> and_not(Mask<T> a, Mask<T> b) {
  return {a.m & ~b.m};
}
template <class T>
uint32_t bits(Mask<T> a) {
  uint32_t b = 0;
  for (int i = 0; i < Vec<T>::kLanes; ++i) b |= static_cast<uint32_t>(a.m[i] & 1) << i;
  return b;
}
template <class T>
bool any(Mask<T> a) {
  uint64_t words[2];
  std::memcpy(words, &a.m, 16);
  return (words[0] | words[1]) != 0;
}
template <class T>
Vec<T> fraction(Vec<T> a, Vec<T> &whole) {  // for |a| below 2^31; other lanes are arbitrary
  Vec<T> clamped = max(min(a, Vec<T>(T(1e9))), Vec<T>(T(-1e9)));
  typename Native<T>::Bits i = __builtin_convertvector(clamped.v, typename Native<T>::Bits);
  typename Vec<T>::Real r = __builtin_convertvector(i, typename Vec<T>::Real);
  whole = r > a.v ? r - 1 : r;
  return a - whole;
}
template <class T>
Vec<T> scale_by_power_of_two(Vec<T> p, Vec<T> whole) {
  using Int = typename Native<T>::Bits;
  using Element = std::conditional_t<sizeof(T) == 4, int32_t, int64_t>;
  Vec<T> exponent = max(whole, Vec<T>(T(-100)));  // lanes below carry no meaning
  Int b, e = __builtin_convertvector(min(exponent, Vec<T>(T(0))).v, Int) * (Element{1} << kMantissa<T>);
  std::memcpy(&b, &p.v, 16);
  b += e;
  typename Vec<T>::Real r;
  std::memcpy(&r, &b, 16);
  return r;
}
template <class T>
T sum(Vec<T> a) {
  T s = 0;
  for (int i = 0; i < Vec<T>::kLanes; ++i) s += a.v[i];
  return s;
}
template <class T>
Vec<T> transpose_sum(const Vec<T> *v) {
  Vec<T> r;
  for (int i = 0; i < Vec<T>::kLanes; ++i) r.v[i] = sum(v[i]);
  return r;
}

inline void append_to_lists(const uint16_t *masks, const uint32_t *ids, uint32_t *lists, int stride, uint32_t *counts) {
  for (int j = 0; j < 16; ++j)
    for (uint32_t m = masks[j]; m; m &= m - 1) {
      int g = __builtin_ctz(m);
      lists[g * static_cast<std::size_t>(stride) + counts[g]++] = ids[j];
    }
}

}  // namespace perception::baseline
