// Stage 4: front-to-back blending. Granule by granule, so that a granule's state stays in registers while its list
// of splats runs by.
#pragma once
#include "supertile.h"

namespace perception::PERCEPTION_LEVEL {

// The channels of one granule register: colours, depth, and for every feature channel either its sum, or, with the
// variance, a shift c and the sums of w (f - c) and w (f - c)². The shift is the first contributor's value, so
// neither sum cancels (their ratio to the variance is bounded by 1/w_first <= 255), however large the features.
template <int NF, bool VAR, bool DEPTH>
struct Channels {
  static constexpr int kDepth = 3, kBase = DEPTH ? 4 : 3;
  static constexpr int kSum = kBase, kSquare = kBase + NF, kShift = kBase + 2 * NF;
  static constexpr int kCount = kBase + NF * (VAR ? 3 : 1);
};

template <class T, int NF, bool VAR, bool DEPTH>
struct ForwardTile {
  using C = Channels<NF, VAR, DEPTH>;
  static constexpr int kChunk = 128;
  alignas(64) T sums[16][C::kCount][16];
  alignas(64) T transmittance[16][16];
  uint16_t live[16];
  uint32_t counts[16];
  uint32_t lists[16][kChunk + 32];
};

// Runs one granule's register of pixels over a list of splats; returns the lanes still open, counts the pairs.
template <class T, int NF, bool VAR, bool DEPTH>
inline uint32_t blend_list(const Splat<T> *splats, const T *features, uint8_t *touched, const uint32_t *list, int n,
                           Vec<T> px, Vec<T> py, uint32_t live_bits, T *transmittance, T (*sums)[16],
                           uint64_t &evaluated, uint64_t &contributing) {
  using V = Vec<T>;
  using C = Channels<NF, VAR, DEPTH>;
  Mask<T> live = mask_from_bits<T>(live_bits);
  V t = V::load(transmittance);
  [[maybe_unused]] Mask<T> fresh = t >= V(T(1));
  V acc[C::kCount];
  for (int c = 0; c < C::kCount; ++c) acc[c] = V::load(sums[c]);
  int i = 0, pairs = 0;
  while (i < n) {
    const uint32_t at = list[i++];
    const Splat<T> &s = splats[at];
    const Blend<T> b = blend(s, px, py, t, live);
    t = b.next;
    const V w = b.weight;
    const uint32_t mask = bits(b.mask);
    touched[at] |= mask != 0;
    pairs += __builtin_popcount(mask);
    acc[0] = fma(w, V(s.r), acc[0]);
    acc[1] = fma(w, V(s.g), acc[1]);
    acc[2] = fma(w, V(s.b), acc[2]);
    if constexpr (DEPTH) acc[C::kDepth] = fma(w, V(s.z), acc[C::kDepth]);
    if constexpr (NF > 0) {
      const T *f = features + static_cast<std::size_t>(at) * NF;
      if constexpr (VAR) {
        const Mask<T> first = b.mask & fresh;
        if (__builtin_expect(any(first), 0)) {
          for (int c = 0; c < NF; ++c) acc[C::kShift + c] = select(first, V(f[c]), acc[C::kShift + c]);
          fresh = and_not(fresh, first);
        }
        for (int c = 0; c < NF; ++c) {
          const V e = V(f[c]) - acc[C::kShift + c], we = w * e;
          acc[C::kSum + c] = acc[C::kSum + c] + we;
          acc[C::kSquare + c] = fma(we, e, acc[C::kSquare + c]);
        }
      } else {
        for (int c = 0; c < NF; ++c) acc[C::kSum + c] = fma(w, V(f[c]), acc[C::kSum + c]);
      }
    }
    if (__builtin_expect(!any(live), 0)) break;
  }
  evaluated += static_cast<uint64_t>(i) * V::kLanes, contributing += pairs;
  t.store(transmittance);
  for (int c = 0; c < C::kCount; ++c) acc[c].store(sums[c]);
  return bits(live);
}

// (x, y): the 16x16 tile relative to its 64x64 tile.
template <class T, int NF, bool VAR, bool DEPTH>
void forward_tile(Worker<T> &w, int x, int y, const uint32_t *list, int n, ForwardTile<T, NF, VAR, DEPTH> &tile) {
  using V = Vec<T>;
  constexpr int kChunk = ForwardTile<T, NF, VAR, DEPTH>::kChunk;
  const Grid<T> &grid = kGrid<T>;
  uint32_t open = 0;
  for (int g = 0; g < 16; ++g) open |= static_cast<uint32_t>(tile.live[g] != 0) << g;
  for (int begin = 0; begin < n && open; begin += kChunk) {
    const int end = n < begin + kChunk ? n : begin + kChunk;
    std::memset(tile.counts, 0, sizeof tile.counts);
    for (int i = begin; i < end; i += 16) {
      uint16_t masks[16] = {};
      for (int j = 0; j < 16 && i + j < end; ++j) {
        const Splat<T> &s = w.splats[list[i + j]];
        masks[j] = static_cast<uint16_t>(boxes_touched<T, 1>(s, s.x - x, s.y - y));
      }
      append_to_lists(masks, list + i, tile.lists[0], kChunk + 32, tile.counts);
    }
    for (uint32_t rest = open; rest; rest &= rest - 1) {
      const int g = __builtin_ctz(rest);
      if (!tile.counts[g]) continue;
      uint32_t live = 0;
      for (int p = 0; p < kParts<T>; ++p) {
        const int lane = p * V::kLanes;
        const uint32_t before = tile.live[g] >> lane & ((1u << V::kLanes) - 1);
        if (!before) continue;
        alignas(64) T px[V::kLanes], py[V::kLanes];
        for (int i = 0; i < V::kLanes; ++i) {
          px[i] = T(x) + grid.box_x[1][g] + T((lane + i) & 3), py[i] = T(y) + grid.box_y[1][g] + T((lane + i) >> 2);
        }
        live |= blend_list<T, NF, VAR, DEPTH>(w.splats.data(), w.features.data(), w.touched.data(), tile.lists[g],
                                              tile.counts[g], V::load(px), V::load(py), before,
                                              tile.transmittance[g] + lane,
                                              reinterpret_cast<T(*)[16]>(&tile.sums[g][0][lane]), w.evaluated,
                                              w.contributing)
                << lane;
      }
      tile.live[g] = static_cast<uint16_t>(live);
      if (!live) open &= ~(1u << g);
    }
  }
}

// Feature sums and variances of one pixel, from the sums about a shift: with the mean m and the centred second moment
// M2 of the weighted features, Var = Σ w f² - (Σ w f)² = M2 + A (1 - A) m², both terms non-negative.
template <class T, int NF, bool VAR>
inline void write_features(const T (*sums)[16], int i, T t, int count, T *features, T *variance) {
  T sum[NF], var[NF];
  if constexpr (VAR) {
    const T a = 1 - t, inverse = a > 0 ? 1 / a : T(0);
    for (int c = 0; c < NF; ++c) {
      const T s1 = sums[c][i], s2 = sums[NF + c][i], shift = sums[2 * NF + c][i];
      const T offset = s1 * inverse, mean = shift + offset, m2 = s2 - s1 * offset;
      sum[c] = shift * a + s1;
      var[c] = (m2 > 0 ? m2 : T(0)) + a * t * mean * mean;
    }
    copy_channels<NF>(variance, var, count);
  } else {
    for (int c = 0; c < NF; ++c) sum[c] = sums[c][i];
  }
  copy_channels<NF>(features, sum, count);
}

template <class T, int NF, bool VAR, bool DEPTH>
void write_tile(const Inputs<T> &in, int camera, int x, int y, Slice slice, const ForwardTile<T, NF, VAR, DEPTH> &tile,
                const Outputs<T> &out) {
  using C = Channels<NF, VAR, DEPTH>;
  T background[3] = {};
  if (in.background) std::memcpy(background, in.background + 3 * camera, sizeof background);
  for (int g = 0; g < 16; ++g) {
    const uint32_t inside = pixels_inside(x, y, g, in.width, in.height);
    const int64_t first = (static_cast<int64_t>(camera) * in.height + y + (g >> 2) * 4) * in.width + x + (g & 3) * 4;
    for (int i = 0; i < 16; ++i) {
      if (!(inside >> i & 1)) continue;
      const int64_t pixel = first + static_cast<int64_t>(i >> 2) * in.width + (i & 3);
      const T t = tile.transmittance[g][i];
      const T(*sums)[16] = tile.sums[g];
      if (slice.begin == 0) {
        for (int c = 0; c < 3; ++c) out.colors[3 * pixel + c] = sums[c][i] + t * background[c];
        out.alphas[pixel] = 1 - t;
        if constexpr (DEPTH)
          if (out.depths) out.depths[pixel] = sums[C::kDepth][i];
      }
      if constexpr (NF > 0) {
        const int64_t at = pixel * in.dims + slice.begin;
        write_features<T, NF, VAR>(sums + C::kSum, i, t, slice.count, out.features + at, VAR ? out.variance + at : nullptr);
      }
    }
  }
}

template <class T, int NF, bool VAR, bool DEPTH>
void forward_supertile(const Inputs<T> &in, int camera, const Frame<T> &f, int index, Slice slice, Worker<T> &w,
                       const Outputs<T> &out) {
  using Tile = ForwardTile<T, NF, VAR, DEPTH>;
  load_supertile<NF, NF>(in, f, index, slice, w);
  std::memset(w.touched.reserve(w.n + 1), 0, w.n);
  Tile &tile = *reinterpret_cast<Tile *>(w.tile.reserve(sizeof(Tile) / sizeof(T) + 1));
  const int x0 = index % f.tiles_x * 64, y0 = index / f.tiles_x * 64;
  for (int q = 0; q < 16; ++q) {
    const int x = (q & 3) * 16, y = (q >> 2) * 16;
    if (x0 + x >= in.width || y0 + y >= in.height) continue;
    std::memset(tile.sums, 0, sizeof tile.sums);
    for (int g = 0; g < 16; ++g) {
      for (T &t : tile.transmittance[g]) t = 1;
      tile.live[g] = static_cast<uint16_t>(pixels_inside(x0 + x, y0 + y, g, in.width, in.height));
    }
    forward_tile(w, x, y, w.lists.data() + q * static_cast<std::size_t>(w.stride), w.counts[q], tile);
    write_tile(in, camera, x0 + x, y0 + y, slice, tile, out);
  }
  for (int j = 0; j < w.n; ++j)
    if (w.touched[j]) __atomic_store_n(&out.visible[in.n * camera + f.splats[w.source[j]].id], 1, __ATOMIC_RELAXED);
}

}  // namespace perception::PERCEPTION_LEVEL
