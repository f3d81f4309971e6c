// Stage 5: the backward pass, splat by splat over each 16x16 tile, replaying the blending front to back. With
//   cg = Σ_channels (cotangent · value of this splat),  R = Σ over the splats behind of w cg,
// dL/dalpha = T cg - R / (1 - alpha): two numbers a pixel, T and R, whatever the number of channels.
//
// The variance enters linearly: with V = Σ w f² - S², S = Σ w f, and any constant c (here the features of the tile's
// first splat, so that large common offsets do not cancel), e = f - c:
//   g S + v V has dL/dw = (g - 2 v (S - c)) e + v e² + const,  const = c g + v (c² - 2 S c),
// and a constant channel is the accumulated alpha, whose gradient is const T_final / (1 - alpha).
#pragma once
#include "supertile.h"

namespace perception::PERCEPTION_LEVEL {

// A record is what one splat gathers over one 64x64 tile:
// [0] Σ h, [1] Σ h u, [2] Σ h dy, [3] Σ h u², [4] Σ h u dy, [5] Σ h dy² (h = dL/d ln alpha), [6..8] Σ w g_rgb, [9] Σ w g_z,
// then from kGeometry on Σ w g' and, with the variance, Σ w v for every feature channel.
constexpr int kGeometry = 16;

template <class T, int NF, bool VAR, bool DEPTH>
struct BackwardTile {
  static constexpr int kBase = DEPTH ? 4 : 3;
  static constexpr int kFeatures = NF * (VAR ? 2 : 1);                                     // channels e, e²
  static constexpr int kRow = (kFeatures + Vec<T>::kLanes - 1) / Vec<T>::kLanes * Vec<T>::kLanes;  // padded
  static constexpr int kRecord = kGeometry + kRow;
  alignas(64) T cotangent[16][kBase + kFeatures][16];
  alignas(64) T by_pixel[16][16][kRow ? kRow : 1];  // the features' cotangents again, a row a pixel
  alignas(64) T weight[16][16];
  alignas(64) T transmittance[16][16], behind[16][16];
  Mask<T> live[16][kParts<T>];
  uint32_t open;  // granules with a live pixel
};

// Feature channels of one pixel: their cotangents in terms of e = f - shift go to row (e, then e²). Returns what they
// add to R and, through `constant`, to the alpha channel.
template <class T, int NF, bool VAR>
inline T load_pixel_features(int64_t at, int count, const T *shift, T a, const Outputs<T> &out, const Cotangents<T> &grad,
                             T *row, T &constant) {
  T g[NF] = {}, sum[NF] = {}, behind[NF], steady[NF];
  const std::size_t bytes = count * sizeof(T);
  std::memcpy(sum, out.features + at, bytes);
  if (grad.features) std::memcpy(g, grad.features + at, bytes);
  for (int c = 0; c < NF; ++c) behind[c] = g[c] * (sum[c] - shift[c] * a), steady[c] = g[c] * shift[c];
  if constexpr (VAR) {
    T v[NF] = {}, variance[NF] = {};
    if (grad.variance) {
      std::memcpy(v, grad.variance + at, bytes);
      std::memcpy(variance, out.variance + at, bytes);
    }
    for (int c = 0; c < NF; ++c) {
      const T e = sum[c] - shift[c] * a, twice = 2 * v[c] * (sum[c] - shift[c]);
      const T square = variance[c] + e * e - (1 - a) * shift[c] * (shift[c] * a + 2 * e);  // Σ w e²
      g[c] -= twice;
      behind[c] += v[c] * square - twice * e;
      steady[c] += v[c] * shift[c] * (shift[c] - 2 * sum[c]);
      row[NF + c] = v[c];
    }
  }
  T total = 0;
  for (int c = 0; c < NF; ++c) row[c] = g[c], total += behind[c], constant += steady[c];
  return total;
}

// One pixel's cotangents and R before the first splat.
template <class T, int NF, bool VAR, bool DEPTH>
inline void load_pixel(const Inputs<T> &in, const T *background, int64_t pixel, Slice slice, const T *shift,
                       const Outputs<T> &out, const Cotangents<T> &grad, int g, int i,
                       BackwardTile<T, NF, VAR, DEPTH> &tile) {
  const T a = out.alphas[pixel], t = 1 - a;
  T constant = 0, behind = 0;
  if (slice.begin == 0) {
    if (grad.alphas) constant = grad.alphas[pixel];
    for (int c = 0; c < 3; ++c) {
      const T v = grad.colors ? grad.colors[3 * pixel + c] : T(0);
      tile.cotangent[g][c][i] = v;
      behind += v * (out.colors[3 * pixel + c] - t * background[c]);
      constant -= v * background[c];
    }
    if constexpr (DEPTH) {
      const T v = grad.depths ? grad.depths[pixel] : T(0);
      tile.cotangent[g][3][i] = v;
      if (grad.depths) behind += v * out.depths[pixel];
    }
  }
  if constexpr (NF > 0)
    behind += load_pixel_features<T, NF, VAR>(pixel * in.dims + slice.begin, slice.count, shift, a, out, grad,
                                              tile.by_pixel[g][i], constant);
  tile.behind[g][i] = behind - constant * t;
}

template <class T, int NF, bool VAR, bool DEPTH>
void load_tile(const Inputs<T> &in, int camera, int x, int y, Slice slice, const T *shift, const Outputs<T> &out,
               const Cotangents<T> &grad, BackwardTile<T, NF, VAR, DEPTH> &tile) {
  using Tile = BackwardTile<T, NF, VAR, DEPTH>;
  T background[3] = {};
  if (in.background) std::memcpy(background, in.background + 3 * camera, sizeof background);
  tile.open = 0;
  for (int g = 0; g < 16; ++g) {
    const uint32_t inside = pixels_inside(x, y, g, in.width, in.height);
    tile.open |= static_cast<uint32_t>(inside != 0) << g;
    for (int p = 0; p < kParts<T>; ++p) tile.live[g][p] = mask_from_bits<T>(inside >> (p * Vec<T>::kLanes));
    for (T &t : tile.transmittance[g]) t = 1;
    if (inside != 0xffff || slice.begin > 0) {  // what load_pixel leaves out is zero
      std::memset(tile.cotangent[g], 0, sizeof tile.cotangent[g]);
      std::memset(tile.by_pixel[g], 0, sizeof tile.by_pixel[g]);
      std::memset(tile.behind[g], 0, sizeof tile.behind[g]);
    }
    const int64_t first = (static_cast<int64_t>(camera) * in.height + y + (g >> 2) * 4) * in.width + x + (g & 3) * 4;
    for (int i = 0; i < 16; ++i)
      if (inside >> i & 1)
        load_pixel(in, background, first + static_cast<int64_t>(i >> 2) * in.width + (i & 3), slice, shift, out, grad, g, i, tile);
    for (int c = 0; c < Tile::kFeatures; ++c)
      for (int i = 0; i < 16; ++i) tile.cotangent[g][Tile::kBase + c][i] = tile.by_pixel[g][i][c];
  }
}

// The sums over pixels that one splat gathers, a lane a pixel.
template <class T, bool DEPTH>
struct Moments {
  Vec<T> h, hu, hy, huu, huy, hyy, rgb[3], z;
  Moments() {
    const Vec<T> zero(T(0));
    h = hu = hy = huu = huy = hyy = rgb[0] = rgb[1] = rgb[2] = z = zero;
  }
  void store(T *record, bool first) const {
    using V = Vec<T>;
    const V zero(T(0));
    const V all[kGeometry] = {h, hu, hy, huu, huy, hyy, rgb[0], rgb[1], rgb[2], z, zero, zero, zero, zero, zero, zero};
    constexpr int kUsed = DEPTH ? 10 : 9;
    for (int c = 0; c < kGeometry; c += V::kLanes) {
      const V s = c < kUsed ? transpose_sum(all + c) : zero;
      (first ? s : s + V::load(record + c)).store(record + c);
    }
  }
};

// One splat over one register of pixels of granule g.
template <class T, int NF, bool VAR, bool DEPTH>
inline void backward_step(const Splat<T> &s, const T *features, Vec<T> px, Vec<T> py, int g, int p,
                          BackwardTile<T, NF, VAR, DEPTH> &tile, Moments<T, DEPTH> &m) {
  using V = Vec<T>;
  using Tile = BackwardTile<T, NF, VAR, DEPTH>;
  const int lane = p * V::kLanes;
  const V t = V::load(tile.transmittance[g] + lane);
  const Blend<T> b = blend(s, px, py, t, tile.live[g][p]);
  b.next.store(tile.transmittance[g] + lane);
  const T(*cotangent)[16] = reinterpret_cast<const T(*)[16]>(&tile.cotangent[g][0][lane]);
  const V w = b.weight;
  const V g0 = V::load(cotangent[0]), g1 = V::load(cotangent[1]), g2 = V::load(cotangent[2]);
  V cg = fma(V(s.b), g2, fma(V(s.g), g1, V(s.r) * g0));
  m.rgb[0] = fma(w, g0, m.rgb[0]), m.rgb[1] = fma(w, g1, m.rgb[1]), m.rgb[2] = fma(w, g2, m.rgb[2]);
  if constexpr (DEPTH) {
    const V gz = V::load(cotangent[3]);
    cg = fma(V(s.z), gz, cg);
    m.z = fma(w, gz, m.z);
  }
  if constexpr (NF > 0) {
    V cg2(T(0));
    for (int c = 0; c < Tile::kFeatures; c += 2) {
      cg = fma(V(features[c]), V::load(cotangent[Tile::kBase + c]), cg);
      cg2 = fma(V(features[c + 1]), V::load(cotangent[Tile::kBase + c + 1]), cg2);
    }
    cg = cg + cg2;
    w.store(tile.weight[g] + lane);
  }
  const V behind = fnma(w, cg, V::load(tile.behind[g] + lane));
  behind.store(tile.behind[g] + lane);
  const V g_alpha = fnma(behind, reciprocal(V(T(1)) - b.alpha), t * cg);
  const Mask<T> moves = b.mask & (V(kMaxAlpha<T>) >= b.raw);  // a clamped alpha does not move
  const V h = keep(moves, b.raw * g_alpha);
  const V hu = h * b.u, hy = h * b.dy;
  m.h = m.h + h, m.hu = m.hu + hu, m.hy = m.hy + hy;
  m.huu = fma(hu, b.u, m.huu), m.huy = fma(hu, b.dy, m.huy), m.hyy = fma(hy, b.dy, m.hyy);
}

// Σ over the pixels of the granules in `mask` of weight times the row of feature cotangents.
template <class T, int NF, bool VAR, bool DEPTH>
inline void feature_sums(uint32_t mask, const BackwardTile<T, NF, VAR, DEPTH> &tile, T *record, bool first) {
  using V = Vec<T>;
  constexpr int kRow = BackwardTile<T, NF, VAR, DEPTH>::kRow, kVectors = kRow / V::kLanes, kChains = kVectors >= 4 ? 1 : 4 / kVectors;
  V acc[kChains][kVectors];
  for (auto &chain : acc)
    for (V &v : chain) v = V(T(0));
  for (; mask; mask &= mask - 1) {
    const int g = __builtin_ctz(mask);
    for (int i = 0; i < 16; i += kChains)
      for (int k = 0; k < kChains; ++k) {
        const V w(tile.weight[g][i + k]);
        for (int v = 0; v < kVectors; ++v) acc[k][v] = fma(w, V::load(tile.by_pixel[g][i + k] + v * V::kLanes), acc[k][v]);
      }
  }
  for (int v = 0; v < kVectors; ++v) {
    V s = acc[0][v];
    for (int k = 1; k < kChains; ++k) s = s + acc[k][v];
    (first ? s : s + V::load(record + v * V::kLanes)).store(record + v * V::kLanes);
  }
}

template <class T, int NF, bool VAR, bool DEPTH>
void backward_tile(Worker<T> &w, int x, int y, const uint32_t *list, int n, BackwardTile<T, NF, VAR, DEPTH> &tile) {
  using V = Vec<T>;
  using Tile = BackwardTile<T, NF, VAR, DEPTH>;
  alignas(64) T px[4][16], py[4][16];  // pixel centres by the granule's column, row
  for (int column = 0; column < 4; ++column)
    for (int i = 0; i < 16; ++i) {
      px[column][i] = T(x) + T(column * 4 + 0.5) + T(i & 3), py[column][i] = T(y) + T(column * 4 + 0.5) + T(i >> 2);
    }
  for (int j = 0; j < n && tile.open; ++j) {
    const uint32_t at = list[j];
    const Splat<T> s = w.splats[at];
    const uint32_t mask = boxes_touched<T, 1>(s, s.x - x, s.y - y) & tile.open;
    if (!mask) continue;
    const T *features = w.features.data() + static_cast<std::size_t>(at) * Tile::kFeatures;
    Moments<T, DEPTH> m;
    for (uint32_t rest = mask; rest; rest &= rest - 1) {
      const int g = __builtin_ctz(rest);
      bool live = false;
      for (int p = 0; p < kParts<T>; ++p) {
        const int lane = p * V::kLanes;
        backward_step(s, features, V::load(px[g & 3] + lane), V::load(py[g >> 2] + lane), g, p, tile, m);
        live |= any(tile.live[g][p]);
      }
      if (!live) tile.open &= ~(1u << g);
    }
    T *record = w.records.data() + static_cast<std::size_t>(at) * Tile::kRecord;
    const bool first = !w.touched[at];
    m.store(record, first);
    if constexpr (NF > 0) feature_sums(mask, tile, record + kGeometry, first);
    w.touched[at] = 1;
  }
}

// Writes the records of one 64x64 tile to their slots (one a splat and tile it touches): the geometry's moments, then
// the feature gradient Σ w (g' + 2 v e).
template <class T, int NF, bool VAR, bool DEPTH>
void store_records(const Frame<T> &f, int index, const Worker<T> &w, Scratch<T> &scratch) {
  using Tile = BackwardTile<T, NF, VAR, DEPTH>;
  const int tx = index % f.tiles_x, ty = index / f.tiles_x;
  for (int j = 0; j < w.n; ++j) {
    if (!w.touched[j]) continue;
    const Splat<T> &s = w.splats[j];
    const uint64_t slot = scratch.slots[w.source[j]] + (ty - s.y0) * (s.x1 - s.x0 + 1) + (tx - s.x0);
    const T *from = w.records.data() + static_cast<std::size_t>(j) * Tile::kRecord;
    const T *e = w.features.data() + static_cast<std::size_t>(j) * Tile::kFeatures;
    T *to = scratch.records.data() + slot * (kGeometry + NF);
    for (int c = 0; c < kGeometry + NF; ++c) to[c] = from[c];
    if constexpr (VAR)
      for (int c = 0; c < NF; ++c) to[kGeometry + c] += 2 * e[c] * from[kGeometry + NF + c];
    scratch.touched[slot] = 1;
  }
}

template <class T, int NF, bool VAR, bool DEPTH>
void backward_supertile(const Inputs<T> &in, int camera, const Frame<T> &f, int index, Slice slice, Scratch<T> &scratch,
                        Worker<T> &w, const Outputs<T> &out, const Cotangents<T> &grad) {
  using Tile = BackwardTile<T, NF, VAR, DEPTH>;
  load_supertile(in, f, index, slice, NF, Tile::kFeatures, w);
  if (!w.n) return;
  T shift[NF ? NF : 1] = {};
  for (int c = 0; c < NF; ++c) shift[c] = w.features[c];
  for (int j = 0; j < w.n; ++j) {
    T *f_row = w.features.data() + static_cast<std::size_t>(j) * Tile::kFeatures;
    for (int c = 0; c < NF; ++c) {
      f_row[c] -= shift[c];
      if constexpr (VAR) f_row[NF + c] = f_row[c] * f_row[c];
    }
  }
  std::memset(w.touched.reserve(w.n), 0, w.n);
  w.records.reserve(static_cast<std::size_t>(w.n) * Tile::kRecord);
  Tile &tile = *reinterpret_cast<Tile *>(w.tile.reserve(sizeof(Tile) / sizeof(T) + 1));
  const int x0 = index % f.tiles_x * 64, y0 = index / f.tiles_x * 64;
  for (int q = 0; q < 16; ++q) {
    const int x = (q & 3) * 16, y = (q >> 2) * 16;
    if (x0 + x >= in.width || y0 + y >= in.height || !w.counts[q]) continue;
    load_tile(in, camera, x0 + x, y0 + y, slice, shift, out, grad, tile);
    backward_tile(w, x, y, w.lists.data() + q * static_cast<std::size_t>(w.stride), w.counts[q], tile);
  }
  store_records<T, NF, VAR, DEPTH>(f, index, w, scratch);
}

}  // namespace perception::PERCEPTION_LEVEL
