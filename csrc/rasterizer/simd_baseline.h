// 128-bit registers through GCC's vector extensions: compiles for any processor.
#pragma once

namespace perception::baseline {

template <class T>
struct Lanes;
template <>
struct Lanes<float> {
  using Integer = int32_t;
  typedef float Real __attribute__((vector_size(16)));
  typedef int32_t Int __attribute__((vector_size(16)));
  static constexpr int kMantissa = 23;
};
template <>
struct Lanes<double> {
  using Integer = int64_t;
  typedef double Real __attribute__((vector_size(16)));
  typedef int64_t Int __attribute__((vector_size(16)));
  static constexpr int kMantissa = 52;
};

template <class T>
struct Mask {
  typename Lanes<T>::Int m;  // all ones or all zeros
};
template <class T>
struct Vec {
  static constexpr int kLanes = 16 / sizeof(T);
  using Real = typename Lanes<T>::Real;
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
  friend Vec fma(Vec a, Vec b, Vec c) { return a.v * b.v + c.v; }
  friend Vec fnma(Vec a, Vec b, Vec c) { return c.v - a.v * b.v; }
  friend Vec min(Vec a, Vec b) { return a.v < b.v ? a.v : b.v; }
  friend Vec max(Vec a, Vec b) { return a.v > b.v ? a.v : b.v; }
  friend Vec reciprocal(Vec a) { return (Real{} + 1) / a.v; }
  friend Mask<T> operator>=(Vec a, Vec b) { return {a.v >= b.v}; }
  friend Mask<T> operator<(Vec a, Vec b) { return {a.v < b.v}; }
  friend Vec keep(Mask<T> m, Vec a) { return m.m ? a.v : Real{}; }
  friend Vec select(Mask<T> m, Vec a, Vec b) { return m.m ? a.v : b.v; }
};

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
Mask<T> mask_from_bits(uint32_t b) {
  Mask<T> r;
  for (int i = 0; i < Vec<T>::kLanes; ++i) r.m[i] = b >> i & 1 ? -1 : 0;
  return r;
}
template <class T>
Vec<T> fraction(Vec<T> a, Vec<T> &whole) {  // for |a| below 2^31; other lanes are arbitrary
  Vec<T> clamped = max(min(a, Vec<T>(T(1e9))), Vec<T>(T(-1e9)));
  typename Lanes<T>::Int i = __builtin_convertvector(clamped.v, typename Lanes<T>::Int);
  typename Lanes<T>::Real r = __builtin_convertvector(i, typename Lanes<T>::Real);
  whole = r > a.v ? r - 1 : r;
  return a - whole;
}
template <class T>
Vec<T> scale_by_power_of_two(Vec<T> p, Vec<T> whole) {
  using Int = typename Lanes<T>::Int;
  using Element = typename Lanes<T>::Integer;
  Vec<T> exponent = max(whole, Vec<T>(T(-100)));  // lanes below carry no meaning
  Int b, e = __builtin_convertvector(min(exponent, Vec<T>(T(0))).v, Int) * (Element(1) << Lanes<T>::kMantissa);
  std::memcpy(&b, &p.v, 16);
  b += e;
  typename Lanes<T>::Real r;
  std::memcpy(&r, &b, 16);
  return r;
}
template <class T>
T sum(Vec<T> a) {
  T s = 0;
  for (int i = 0; i < Vec<T>::kLanes; ++i) s += a.v[i];
  return s;
}
// lane j of the result is the sum over the lanes of v[j]
template <class T>
Vec<T> transpose_sum(const Vec<T> *v) {
  Vec<T> r;
  for (int i = 0; i < Vec<T>::kLanes; ++i) r.v[i] = sum(v[i]);
  return r;
}

// masks[j] bit g set: append ids[j] to list g.
inline void append_to_lists(const uint16_t *masks, const uint32_t *ids, uint32_t *lists, int stride, uint32_t *counts) {
  for (int j = 0; j < 16; ++j)
    for (uint32_t m = masks[j]; m; m &= m - 1) {
      int g = __builtin_ctz(m);
      lists[g * static_cast<std::size_t>(stride) + counts[g]++] = ids[j];
    }
}

}  // namespace perception::baseline
