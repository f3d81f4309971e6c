#pragma once
#include "simd.h"

namespace perception::avx2 {

using VF = Vec<float>;
using MF = Mask<float>;
inline VF fma(VF a, VF b, VF c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }
inline VF fnma(VF a, VF b, VF c) { return _mm256_fnmadd_ps(a.v, b.v, c.v); }
inline VF min(VF a, VF b) { return _mm256_min_ps(a.v, b.v); }
inline VF max(VF a, VF b) { return _mm256_max_ps(a.v, b.v); }
inline VF magnitude(VF a) { return _mm256_andnot_ps(_mm256_set1_ps(-0.f), a.v); }
inline VF fraction(VF a, VF &whole) { return whole = _mm256_floor_ps(a.v), a - whole; }
inline VF scale_by_power_of_two(VF p, VF whole) {
  __m256i e = _mm256_slli_epi32(_mm256_cvtps_epi32(whole.v), 23);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p.v), e));
}
inline VF reciprocal(VF a) {  // one Newton step
  __m256 r = _mm256_rcp_ps(a.v);
  return _mm256_mul_ps(r, _mm256_fnmadd_ps(a.v, r, _mm256_set1_ps(2.f)));
}
inline MF operator>=(VF a, VF b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
inline MF operator<(VF a, VF b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_LT_OQ)}; }
inline MF operator&(MF a, MF b) { return {_mm256_and_ps(a.m, b.m)}; }
inline MF operator|(MF a, MF b) { return {_mm256_or_ps(a.m, b.m)}; }
inline MF and_not(MF a, MF b) { return {_mm256_andnot_ps(b.m, a.m)}; }
inline uint32_t bits(MF a) { return _mm256_movemask_ps(a.m); }
inline bool any(MF a) { return !_mm256_testz_ps(a.m, a.m); }
inline VF keep(MF m, VF a) { return _mm256_and_ps(m.m, a.v); }
inline VF select(MF m, VF a, VF b) { return _mm256_blendv_ps(b.v, a.v, m.m); }
inline float sum(VF a) {
  __m128 s = _mm_add_ps(_mm256_castps256_ps128(a.v), _mm256_extractf128_ps(a.v, 1));
  s = _mm_add_ps(s, _mm_movehl_ps(s, s));
  return _mm_cvtss_f32(_mm_add_ss(s, _mm_movehdup_ps(s)));
}
inline VF transpose_sum(const VF *v) {
  __m256 a = _mm256_hadd_ps(v[0].v, v[1].v), b = _mm256_hadd_ps(v[2].v, v[3].v);
  __m256 c = _mm256_hadd_ps(v[4].v, v[5].v), d = _mm256_hadd_ps(v[6].v, v[7].v);
  __m256 e = _mm256_hadd_ps(a, b), f = _mm256_hadd_ps(c, d);
  return _mm256_add_ps(_mm256_permute2f128_ps(e, f, 0x20), _mm256_permute2f128_ps(e, f, 0x31));
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
