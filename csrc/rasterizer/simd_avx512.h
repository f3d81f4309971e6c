#pragma once
#include "simd.h"

namespace perception::avx512 {

using VF = Vec<float>;
using MF = Mask<float>;
inline VF fma(VF a, VF b, VF c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }
inline VF fnma(VF a, VF b, VF c) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }
inline VF min(VF a, VF b) { return _mm512_min_ps(a.v, b.v); }
inline VF max(VF a, VF b) { return _mm512_max_ps(a.v, b.v); }
inline VF magnitude(VF a) { return _mm512_abs_ps(a.v); }
inline VF fraction(VF a, VF &whole) {
  return whole = a, _mm512_reduce_ps(a.v, _MM_FROUND_TO_NEG_INF);
}  // scalef floors
inline VF scale_by_power_of_two(VF p, VF whole) { return _mm512_scalef_ps(p.v, whole.v); }
inline VF reciprocal(VF a) {  // one Newton step
  __m512 r = _mm512_rcp14_ps(a.v);
  return _mm512_mul_ps(r, _mm512_fnmadd_ps(a.v, r, _mm512_set1_ps(2.f)));
}
inline MF operator>=(VF a, VF b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
inline MF operator<(VF a, VF b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
inline MF operator&(MF a, MF b) { return {static_cast<__mmask16>(a.m & b.m)}; }
inline MF operator|(MF a, MF b) { return {static_cast<__mmask16>(a.m | b.m)}; }
inline MF and_not(MF a, MF b) { return {static_cast<__mmask16>(a.m & ~b.m)}; }
inline uint32_t bits(MF a) { return a.m; }
inline bool any(MF a) { return a.m != 0; }
inline VF keep(MF m, VF a) { return _mm512_maskz_mov_ps(m.m, a.v); }
inline VF select(MF m, VF a, VF b) { return _mm512_mask_mov_ps(b.v, m.m, a.v); }
inline float sum(VF a) { return _mm512_reduce_add_ps(a.v); }
inline VF transpose_sum(const VF *in) {
  __m512 a[8], b[4], c[2];
  for (int i = 0; i < 8; ++i)  // lanes of every 128-bit quarter: v[i] v[i+8] v[i] v[i+8]
    a[i] = _mm512_add_ps(_mm512_unpacklo_ps(in[i].v, in[i + 8].v), _mm512_unpackhi_ps(in[i].v, in[i + 8].v));
  for (int i = 0; i < 4; ++i)  // v[i] v[i+4] v[i+8] v[i+12]
    b[i] = _mm512_add_ps(_mm512_unpacklo_ps(a[i], a[i + 4]), _mm512_unpackhi_ps(a[i], a[i + 4]));
  for (int i = 0; i < 2; ++i)  // quarters b[2i] b[2i] b[2i+1] b[2i+1]
    c[i] = _mm512_add_ps(_mm512_shuffle_f32x4(b[2 * i], b[2 * i + 1], 0x88),
                         _mm512_shuffle_f32x4(b[2 * i], b[2 * i + 1], 0xdd));
  __m512 d = _mm512_add_ps(_mm512_shuffle_f32x4(c[0], c[1], 0x88), _mm512_shuffle_f32x4(c[0], c[1], 0xdd));
  // lane 4q + r now belongs to v[q + 4r]: transpose the 4x4 of lanes
  const __m512i order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
  return _mm512_permutexvar_ps(order, d);
}

inline void append_to_lists(const uint16_t *masks, const uint32_t *ids, uint32_t *lists, int stride, uint32_t *counts) {
  __m256i rows = _mm256_loadu_si256(reinterpret_cast<const __m256i *>(masks));
  __m512i id = _mm512_loadu_si512(ids);
  for (int g = 0; g < 16; ++g) {
    __mmask16 column = _mm256_movepi16_mask(_mm256_sll_epi16(rows, _mm_cvtsi32_si128(15 - g)));
    _mm512_storeu_si512(lists + g * static_cast<std::size_t>(stride) + counts[g],
                        _mm512_maskz_compress_epi32(column, id));
    counts[g] += __builtin_popcount(column);
  }
}

}  // namespace perception::avx512
