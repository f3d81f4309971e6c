#pragma once
#include <immintrin.h>

namespace perception::avx2 {

template <class T>
struct Vec;
template <class T>
struct Mask;

template <>
struct Mask<float> {
  __m256 m;
};
template <>
struct Vec<float> {
  static constexpr int kLanes = 8;
  __m256 v;
  Vec() = default;
  Vec(__m256 x) : v(x) {}
  explicit Vec(float x) : v(_mm256_set1_ps(x)) {}
  static Vec load(const float *p) { return _mm256_loadu_ps(p); }
  void store(float *p) const { _mm256_storeu_ps(p, v); }
};
using VF = Vec<float>;
using MF = Mask<float>;
inline VF operator+(VF a, VF b) { return _mm256_add_ps(a.v, b.v); }
inline VF operator-(VF a, VF b) { return _mm256_sub_ps(a.v, b.v); }
inline VF operator*(VF a, VF b) { return _mm256_mul_ps(a.v, b.v); }
inline VF fma(VF a, VF b, VF c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }
inline VF fnma(VF a, VF b, VF c) { return _mm256_fnmadd_ps(a.v, b.v, c.v); }
inline VF min(VF a, VF b) { return _mm256_min_ps(a.v, b.v); }
inline VF max(VF a, VF b) { return _mm256_max_ps(a.v, b.v); }
// a - floor(a), and what scale_by_power_of_two wants of the rest
inline VF fraction(VF a, VF &whole) { return whole = _mm256_floor_ps(a.v), a - whole; }
inline VF scale_by_power_of_two(VF p, VF whole) {
  __m256i e = _mm256_slli_epi32(_mm256_cvtps_epi32(whole.v), 23);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p.v), e));
}
inline VF reciprocal(VF a) {  // one Newton step: relative error below 2e-7
  __m256 r = _mm256_rcp_ps(a.v);
  return _mm256_mul_ps(r, _mm256_fnmadd_ps(a.v, r, _mm256_set1_ps(2.f)));
}
inline MF operator>=(VF a, VF b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
inline MF operator<(VF a, VF b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_LT_OQ)}; }
inline MF operator&(MF a, MF b) { return {_mm256_and_ps(a.m, b.m)}; }
inline MF operator|(MF a, MF b) { return {_mm256_or_ps(a.m, b.m)}; }
inline MF and_not(MF a, MF b) { return {_mm256_andnot_ps(b.m, a.m)}; }  // a and not b
inline uint32_t bits(MF a) { return _mm256_movemask_ps(a.m); }
inline bool any(MF a) { return !_mm256_testz_ps(a.m, a.m); }
inline VF keep(MF m, VF a) { return _mm256_and_ps(m.m, a.v); }                  // m ? a : 0
inline VF select(MF m, VF a, VF b) { return _mm256_blendv_ps(b.v, a.v, m.m); }  // m ? a : b
inline float sum(VF a) {
  __m128 s = _mm_add_ps(_mm256_castps256_ps128(a.v), _mm256_extractf128_ps(a.v, 1));
  s = _mm_add_ps(s, _mm_movehl_ps(s, s));
  return _mm_cvtss_f32(_mm_add_ss(s, _mm_movehdup_ps(s)));
}
// lane j of the result is the sum over the lanes of v[j]
inline VF transpose_sum(const VF *v) {
  __m256 a = _mm256_hadd_ps(v[0].v, v[1].v), b = _mm256_hadd_ps(v[2].v, v[3].v);
  __m256 c = _mm256_hadd_ps(v[4].v, v[5].v), d = _mm256_hadd_ps(v[6].v, v[7].v);
  __m256 e = _mm256_hadd_ps(a, b), f = _mm256_hadd_ps(c, d);
  return _mm256_add_ps(_mm256_permute2f128_ps(e, f, 0x20), _mm256_permute2f128_ps(e, f, 0x31));
}

template <>
struct Mask<double> {
  __m256d m;
};
template <>
struct Vec<double> {
  static constexpr int kLanes = 4;
  __m256d v;
  Vec() = default;
  Vec(__m256d x) : v(x) {}
  explicit Vec(double x) : v(_mm256_set1_pd(x)) {}
  static Vec load(const double *p) { return _mm256_loadu_pd(p); }
  void store(double *p) const { _mm256_storeu_pd(p, v); }
};
using VD = Vec<double>;
using MD = Mask<double>;
inline VD operator+(VD a, VD b) { return _mm256_add_pd(a.v, b.v); }
inline VD operator-(VD a, VD b) { return _mm256_sub_pd(a.v, b.v); }
inline VD operator*(VD a, VD b) { return _mm256_mul_pd(a.v, b.v); }
inline VD fma(VD a, VD b, VD c) { return _mm256_fmadd_pd(a.v, b.v, c.v); }
inline VD fnma(VD a, VD b, VD c) { return _mm256_fnmadd_pd(a.v, b.v, c.v); }
inline VD min(VD a, VD b) { return _mm256_min_pd(a.v, b.v); }
inline VD max(VD a, VD b) { return _mm256_max_pd(a.v, b.v); }
inline VD fraction(VD a, VD &whole) { return whole = _mm256_floor_pd(a.v), a - whole; }
inline VD scale_by_power_of_two(VD p, VD whole) {
  __m256i e = _mm256_slli_epi64(_mm256_cvtepi32_epi64(_mm256_cvtpd_epi32(whole.v)), 52);
  return _mm256_castsi256_pd(_mm256_add_epi64(_mm256_castpd_si256(p.v), e));
}
inline VD reciprocal(VD a) { return _mm256_div_pd(_mm256_set1_pd(1.0), a.v); }
inline MD operator>=(VD a, VD b) { return {_mm256_cmp_pd(a.v, b.v, _CMP_GE_OQ)}; }
inline MD operator<(VD a, VD b) { return {_mm256_cmp_pd(a.v, b.v, _CMP_LT_OQ)}; }
inline MD operator&(MD a, MD b) { return {_mm256_and_pd(a.m, b.m)}; }
inline MD operator|(MD a, MD b) { return {_mm256_or_pd(a.m, b.m)}; }
inline MD and_not(MD a, MD b) { return {_mm256_andnot_pd(b.m, a.m)}; }
inline uint32_t bits(MD a) { return _mm256_movemask_pd(a.m); }
inline bool any(MD a) { return !_mm256_testz_pd(a.m, a.m); }
inline VD keep(MD m, VD a) { return _mm256_and_pd(m.m, a.v); }
inline VD select(MD m, VD a, VD b) { return _mm256_blendv_pd(b.v, a.v, m.m); }
inline double sum(VD a) {
  __m128d s = _mm_add_pd(_mm256_castpd256_pd128(a.v), _mm256_extractf128_pd(a.v, 1));
  return _mm_cvtsd_f64(_mm_add_sd(s, _mm_unpackhi_pd(s, s)));
}
inline VD transpose_sum(const VD *v) {
  alignas(32) double s[4] = {sum(v[0]), sum(v[1]), sum(v[2]), sum(v[3])};
  return _mm256_load_pd(s);
}

template <class T>
Mask<T> mask_from_bits(uint32_t b);
template <>
inline MF mask_from_bits<float>(uint32_t b) {
  const __m256i lane = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
  return {_mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(_mm256_set1_epi32(b), lane), lane))};
}
template <>
inline MD mask_from_bits<double>(uint32_t b) {
  const __m256i lane = _mm256_setr_epi64x(1, 2, 4, 8);
  return {_mm256_castsi256_pd(_mm256_cmpeq_epi64(_mm256_and_si256(_mm256_set1_epi64x(b), lane), lane))};
}

struct CompressTable {
  uint8_t lanes[256][8];
  constexpr CompressTable() : lanes() {
    for (int m = 0; m < 256; ++m)
      for (int lane = 0, n = 0; lane < 8; ++lane)
        if (m >> lane & 1) lanes[m][n++] = static_cast<uint8_t>(lane);
  }
};
alignas(64) inline constexpr CompressTable kCompress;

// masks[j] bit g set: append ids[j] to list g. Writes up to 16 entries past each list's end.
inline void append_to_lists(const uint16_t *masks, const uint32_t *ids, uint32_t *lists, int stride, uint32_t *counts) {
  __m256i rows = _mm256_loadu_si256(reinterpret_cast<const __m256i *>(masks));
  __m256i id0 = _mm256_loadu_si256(reinterpret_cast<const __m256i *>(ids));
  __m256i id1 = _mm256_loadu_si256(reinterpret_cast<const __m256i *>(ids + 8));
  for (int g = 0; g < 16; ++g) {
    __m256i shifted = _mm256_sll_epi16(rows, _mm_cvtsi32_si128(15 - g));
    uint32_t column =
        _mm_movemask_epi8(_mm_packs_epi16(_mm256_castsi256_si128(shifted), _mm256_extracti128_si256(shifted, 1)));
    if (!column) continue;
    uint32_t *out = lists + g * static_cast<std::size_t>(stride) + counts[g];
    uint32_t low = column & 255, high = column >> 8;
    auto lanes = [](uint32_t m) {
      return _mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i *>(kCompress.lanes[m])));
    };
    _mm256_storeu_si256(reinterpret_cast<__m256i *>(out), _mm256_permutevar8x32_epi32(id0, lanes(low)));
    out += __builtin_popcount(low);
    _mm256_storeu_si256(reinterpret_cast<__m256i *>(out), _mm256_permutevar8x32_epi32(id1, lanes(high)));
    counts[g] += __builtin_popcount(column);
  }
}

}  // namespace perception::avx2
