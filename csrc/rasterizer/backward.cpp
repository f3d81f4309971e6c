// Stage 5: the backward pass, splat by splat over each 16x16 tile, replaying the blending front to back. With
//   cg = Σ_channels (cotangent · value of this splat),  R = Σ over the splats behind of w cg,
// dL/dalpha = T cg - R / (1 - alpha), so dL/d ln alpha = w (cg - R / T'), T' the transmittance behind this splat: two
// numbers a pixel, T and R, whatever the number of channels.
//
// The variance enters linearly: with V = Σ w f² - S², S = Σ w f, and any constant c (here the features of the tile's
// first splat, so that large common offsets do not cancel), e = f - c:
//   g S + v V has dL/dw = (g - 2 v (S - c)) e + v e² + const,  const = c g + v (c² - 2 S c),
// and a constant channel is the accumulated alpha, whose gradient is const T_final / (1 - alpha).
#include "kernels.h"
#include "matrix.h"
#include "records.h"
#include "supertile.h"

namespace perception::PERCEPTION_LEVEL {
namespace {

// A 16x16 tile, its state a lane a pixel. Chunks of its list are worked on at a time.
template <class T, bool FEATURES>
struct ColorTile {
  static constexpr int kChunk = FEATURES ? 64 : 128;
  alignas(64) T px[16][16], py[16][16], transmittance[16][16];
  alignas(64) T behind[16][16];                                              // R
  alignas(64) T cotangent[16][4][16];                                        // of red, green, blue, depth
  alignas(64) T products[FEATURES ? 16 : 1][FEATURES ? kChunk + 8 : 1][16];  // per granule and splat: first Σ_c e g,
                                                                             // then the weights
  uint32_t open;                                                             // granules with a pixel that takes light
  uint32_t counts[16], done[16];                                             // splats listed, splats blended
  uint32_t lists[16][kChunk + 64];
  uint32_t splats[kChunk];      // of the chunk, those that touch a granule
  uint16_t masks[kChunk + 16];  // and which
};

template <class T, int NF, bool VAR>
struct BackwardTile : ColorTile<T, (NF > 0)> {
  static constexpr int kFeatures = NF * (VAR ? 2 : 1), kRow = kFeatureRow<T, NF, VAR>, kRecord = kGeometry + kRow;
  alignas(64) T by_channel[16][NF ? kRow : 1][16];  // cotangents of e, e²: a row of pixels a channel
  alignas(64) T by_pixel[16][16][NF ? kRow : 1];    // the same, a row of channels a pixel
};

// Feature channels of one pixel (COUNT of them, a constant NF but in the last slice) with accumulated alpha a: their
// cotangents in terms of e = f - shift go to row (e, then e²), what each adds to R to `behind`.
template <class T, int NF, bool VAR, class Count>
inline void load_pixel_features(int64_t at, Count count, const T *shift, T a, const Outputs<T> &out,
                                const Cotangents<T> &grad, T *row, T *behind) {
  using C = Channels<T, NF>;
  const C s = load_channels<NF>(shift, NF), sum = load_channels<NF>(out.features + at, count), e = sum - s * a;
  C g = {};
  if (grad.features) g = load_channels<NF>(grad.features + at, count);
  C moving = g * e, constant = g * s;
  if constexpr (VAR) {
    C v = {}, square = {};
    if (grad.variance) {
      v = load_channels<NF>(grad.variance + at, count), square = load_channels<NF>(out.variance + at, count);
      square += e * e - (1 - a) * s * (s * a + 2 * e);  // Σ w e²
    }
    const C twice = 2 * v * (sum - s);
    g -= twice;
    moving += v * square - twice * e;
    constant += v * s * (s - 2 * sum);
    store_channels(v, row + NF, NF);
  }
  store_channels(g, row, NF);
  store_channels(moving - constant * (1 - a), behind, NF);
}

// Cotangents and R before the first splat of row `row`, `columns` of it inside the image (a constant 16 but at the
// edge).
template <class T, int NF, bool VAR, class Columns, class Count>
inline void load_row(const Inputs<T> &in, const T *background, int64_t pixel, int row, Columns columns, Slice slice,
                     Count count, const T *shift, const Outputs<T> &out, const Cotangents<T> &grad,
                     BackwardTile<T, NF, VAR> &tile) {
  T constant[16] = {}, behind[16] = {}, cotangent[4][16] = {};
  if (slice.begin == 0) {
    if (grad.alphas)
      for (int i = 0; i < columns; ++i) constant[i] = grad.alphas[pixel + i];
    if (grad.colors)
      for (int c = 0; c < 3; ++c)
        for (int i = 0; i < columns; ++i) {
          const T g = grad.colors[3 * (pixel + i) + c], t = 1 - out.alphas[pixel + i];
          cotangent[c][i] = g;
          behind[i] += g * (out.colors[3 * (pixel + i) + c] - t * background[c]);
          constant[i] -= g * background[c];
        }
    if (grad.depths)
      for (int i = 0; i < columns; ++i) {
        cotangent[3][i] = grad.depths[pixel + i];
        behind[i] += cotangent[3][i] * out.depths[pixel + i];
      }
  }
  for (int i = 0; i < columns; ++i) behind[i] -= constant[i] * (1 - out.alphas[pixel + i]);
  if constexpr (NF > 0) {
    alignas(64) T by_pixel[16][NF] = {}, by_channel[NF][16];
    for (int i = 0; i < columns; ++i)
      load_pixel_features<T, NF, VAR>((pixel + i) * in.dims + slice.begin, count, shift, out.alphas[pixel + i], out,
                                      grad, tile.by_pixel[(row >> 2) * 4 + (i >> 2)][(row & 3) * 4 + (i & 3)],
                                      by_pixel[i]);
    transpose<16, NF>(by_pixel[0], by_channel[0]);
    for (int half = NF / 2; half > 0; half /= 2)
      for (int c = 0; c < half; ++c)
        for (int i = 0; i < 16; ++i) by_channel[c][i] += by_channel[c + half][i];
    for (int i = 0; i < 16; ++i) behind[i] += by_channel[0][i];
  }
  row_to_granules(behind, row, [&](int g) { return tile.behind[g]; });
  for (int c = 0; c < 4; ++c) row_to_granules(cotangent[c], row, [&](int g) { return tile.cotangent[g][c]; });
}

// (x, y): the 16x16 tile relative to its 64x64 tile at (x0, y0).
template <class T, int NF, bool VAR>
void load_tile(const Inputs<T> &in, int camera, int x0, int y0, int x, int y, Slice slice, const T *shift,
               const Outputs<T> &out, const Cotangents<T> &grad, BackwardTile<T, NF, VAR> &tile) {
  T background[3] = {};
  if (in.background) std::memcpy(background, in.background + 3 * camera, sizeof background);
  const bool full = x0 + x + 16 <= in.width && y0 + y + 16 <= in.height;
  tile.open = 0;
  for (int g = 0; g < 16; ++g) {
    const uint32_t inside = pixels_inside(x0 + x, y0 + y, g, in.width, in.height);
    tile.open |= static_cast<uint32_t>(inside != 0) << g;
    granule_pixels(x, y, g, inside, tile.px[g], tile.py[g]);
    for (T &t : tile.transmittance[g]) t = 1;
  }
  if (!full) {
    std::memset(tile.behind, 0, sizeof tile.behind);
    std::memset(tile.cotangent, 0, sizeof tile.cotangent);
    std::memset(tile.by_pixel, 0, sizeof tile.by_pixel);
  }
  for (int row = 0; row < 16 && y0 + y + row < in.height; ++row) {
    const int64_t pixel = (static_cast<int64_t>(camera) * in.height + y0 + y + row) * in.width + x0 + x;
    if (full && slice.count == NF)
      load_row(in, background, pixel, row, std::integral_constant<int, 16>(), slice, std::integral_constant<int, NF>(),
               shift, out, grad, tile);
    else
      load_row(in, background, pixel, row, std::min(16, in.width - x0 - x), slice, slice.count, shift, out, grad, tile);
  }
  if constexpr (NF > 0)
    for (int g = 0; g < 16; ++g)
      transpose<16, BackwardTile<T, NF, VAR>::kRow>(tile.by_pixel[g][0], tile.by_channel[g][0]);
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

// One splat over some pixels of granule g. product: the features' part of cg on entry, the weights on return.
template <class T, bool FEATURES, bool DEPTH>
inline void backward_step(const Splat<T> &s, bool clamps, int g, int lane, T *product, ColorTile<T, FEATURES> &tile,
                          Moments<T, DEPTH> &m) {
  using P = Pack<T>;
  P px = P::load(tile.px[g] + lane);
  bool stopped = false;
  const Blend<T> b = blend(s, px, P::load(tile.py[g] + lane), P::load(tile.transmittance[g] + lane), stopped);
  b.next.store(tile.transmittance[g] + lane);
  if (__builtin_expect(stopped, 0)) {
    px.store(tile.px[g] + lane);
    bool open = false;
    for (int i = 0; i < 16; ++i) open |= tile.px[g][i] < kFar<T>;
    if (!open) tile.open &= ~(1u << g);
  }
  const P w = b.weight;
  const P red = P::load(tile.cotangent[g][0] + lane), green = P::load(tile.cotangent[g][1] + lane),
          blue = P::load(tile.cotangent[g][2] + lane);
  P cg;
  if constexpr (FEATURES) {
    cg = fma(P(s.r), red, P::load(product + lane));
    w.store(product + lane);
  } else {
    cg = P(s.r) * red;
  }
  cg = fma(P(s.b), blue, fma(P(s.g), green, cg));
  P depth;
  if constexpr (DEPTH) {
    depth = P::load(tile.cotangent[g][3] + lane);
    cg = fma(P(s.z), depth, cg);
  }
  const P behind = fnma(w, cg, P::load(tile.behind[g] + lane));
  behind.store(tile.behind[g] + lane);
  P h = w * fnma(behind, reciprocal(b.next), cg);
  if (clamps) h = keep(P(kMaxAlpha<T>) >= b.raw, h);  // a clamped alpha does not move
  const P hu = h * b.u, hy = h * b.dy;
  m.h = add(h, m.h), m.hu = add(hu, m.hu), m.hy = add(hy, m.hy);
  m.huu = add_product(hu, b.u, m.huu), m.huy = add_product(hu, b.dy, m.huy), m.hyy = add_product(hy, b.dy, m.hyy);
  m.rgb[0] = add_product(w, red, m.rgb[0]), m.rgb[1] = add_product(w, green, m.rgb[1]);
  m.rgb[2] = add_product(w, blue, m.rgb[2]);
  if constexpr (DEPTH) m.z = add_product(w, depth, m.z);
}

// Splats [begin, end) of the list that touch an open granule, with their masks; returns how many.
template <class T, bool FEATURES>
int list_splats(const Worker<T> &w, int x, int y, const uint32_t *list, int begin, int end,
                ColorTile<T, FEATURES> &tile) {
  int n = 0;
  for (int j = begin; j < end; ++j) {
    const Splat<T> &s = w.splats[list[j]];
    const uint32_t mask = boxes_touched<T, 1>(s, s.x - x, s.y - y) & tile.open;
    tile.splats[n] = list[j], tile.masks[n] = static_cast<uint16_t>(mask);
    n += mask != 0;
  }
  return n;
}

// products[g][k] = Σ_c e_c g_c at the pixels of granule g for the k-th of the splats that touch it.
// by_channel [16, kRow, 16].
template <int kRow, class T>
[[gnu::noinline]] void feature_products(const Worker<T> &w, int n, const T *by_channel, ColorTile<T, true> &tile) {
  std::memset(tile.counts, 0, sizeof tile.counts), std::memset(tile.done, 0, sizeof tile.done);
  std::memset(tile.masks + n, 0, 16 * sizeof *tile.masks);
  for (int i = 0; i < n; i += 16)
    append_to_lists(tile.masks + i, tile.splats + i, tile.lists[0], sizeof tile.lists[0] / sizeof(uint32_t),
                    tile.counts);
  for (uint32_t rest = tile.open; rest; rest &= rest - 1) {
    const int g = __builtin_ctz(rest);
    uint32_t *list = tile.lists[g];
    for (int k = 0; k < 16; ++k) list[tile.counts[g] + k] = w.n;  // a spare row
    multiply_rows<kRow, 16, false>(
        tile.counts[g], [&](int k) { return w.features.data() + static_cast<std::size_t>(list[k]) * kRow; },
        by_channel + g * kRow * 16, [&](int k) { return tile.products[g][k]; });
  }
}

// Adds to the splats' records Σ over a granule's pixels of the weight times the row of feature cotangents, of which
// by_pixel [16, 16, kRow] has one a pixel.
template <int kRow, class T>
[[gnu::noinline]] void feature_gradients(const Worker<T> &w, const T *by_pixel, ColorTile<T, true> &tile) {
  for (int g = 0; g < 16; ++g) {
    uint32_t *list = tile.lists[g];
    for (int k = 0; k < 16; ++k) list[tile.done[g] + k] = w.n;  // a spare record
    multiply_rows<16, kRow, true>(
        tile.done[g], [&](int k) { return tile.products[g][k]; }, by_pixel + g * 16 * kRow,
        [&](int k) { return w.records.data() + static_cast<std::size_t>(list[k]) * (kGeometry + kRow) + kGeometry; });
  }
}

// Blends the splats of a chunk, of records of `size` numbers.
template <bool DEPTH, class T, bool FEATURES>
[[gnu::noinline]] void blend_chunk(Worker<T> &w, int count, int size, ColorTile<T, FEATURES> &tile) {
  for (int j = 0; j < count; ++j) {
    uint32_t mask = tile.masks[j] & tile.open;
    if (!mask) continue;
    const uint32_t at = tile.splats[j];
    const Splat<T> &s = w.splats[at];
    const bool clamps = s.log_opacity > T(-0.002);  // log2 of a little less than the largest alpha
    Moments<T, DEPTH> m;
    for (; mask; mask &= mask - 1) {
      const int g = __builtin_ctz(mask);
      T *product = FEATURES ? tile.products[g][tile.done[g]++] : nullptr;
      for (int lane = 0; lane < 16; lane += Pack<T>::kLanes) backward_step(s, clamps, g, lane, product, tile, m);
    }
    T *record = w.records.data() + static_cast<std::size_t>(at) * size;
    const bool first = !w.touched[at];
    m.store(record, first);
    if (FEATURES && first)
      for (int c = kGeometry; c < size; c += Vec<T>::kLanes) Vec<T>(T(0)).store(record + c);
    w.touched[at] = 1;
  }
}

template <class T, int NF, bool VAR>
void backward_tile(Worker<T> &w, bool depth, int x, int y, const uint32_t *list, int n,
                   BackwardTile<T, NF, VAR> &tile) {
  using Tile = BackwardTile<T, NF, VAR>;
  auto &colors = static_cast<ColorTile<T, (NF > 0)> &>(tile);
  for (int begin = 0; begin < n && tile.open; begin += Tile::kChunk) {
    const int count = list_splats(w, x, y, list, begin, n < begin + Tile::kChunk ? n : begin + Tile::kChunk, colors);
    if constexpr (NF > 0) feature_products<Tile::kRow>(w, count, tile.by_channel[0][0], colors);
    depth ? blend_chunk<true>(w, count, Tile::kRecord, colors) : blend_chunk<false>(w, count, Tile::kRecord, colors);
    if constexpr (NF > 0) feature_gradients<Tile::kRow>(w, tile.by_pixel[0][0], colors);
  }
}

// Writes one splat's record to its slot: the geometry's moments, then the feature gradient Σ w (g' + 2 v e).
template <class T, int NF, bool VAR>
inline void store_record(const Worker<T> &w, int j, uint64_t slot, Scratch<T> &scratch) {
  using Tile = BackwardTile<T, NF, VAR>;
  const T *from = w.records.data() + static_cast<std::size_t>(j) * Tile::kRecord;
  const T *e = w.features.data() + static_cast<std::size_t>(j) * Tile::kRow;
  T *to = scratch.records.data() + slot * (kGeometry + NF);
  std::memcpy(to, from, (kGeometry + NF) * sizeof(T));
  if constexpr (VAR) {
    const auto moved = 2 * load_channels<NF>(e, NF) * load_channels<NF>(from + kGeometry + NF, NF);
    store_channels(load_channels<NF>(from + kGeometry, NF) + moved, to + kGeometry, NF);
  }
}

template <class T, int NF, bool VAR>
void backward_supertile(const Inputs<T> &in, int camera, const Frame<T> &f, int index, Slice slice, Scratch<T> &scratch,
                        Worker<T> &w, const Outputs<T> &out, const Cotangents<T> &grad) {
  using Tile = BackwardTile<T, NF, VAR>;
  load_supertile<NF, Tile::kRow>(in, f, index, slice, w);
  if (!w.n) return;
  T shift[NF ? NF : 1] = {};
  for (int c = 0; c < NF; ++c) shift[c] = w.features[c];
  if constexpr (NF > 0) {
    for (int j = 0; j < w.n; ++j) {
      T *row = w.features.data() + static_cast<std::size_t>(j) * Tile::kRow;
      const auto e = load_channels<NF>(row, NF) - load_channels<NF>(shift, NF);
      store_channels(e, row, NF);
      if constexpr (VAR) store_channels(e * e, row + NF, NF);
      for (int c = Tile::kFeatures; c < Tile::kRow; ++c) row[c] = 0;
    }
    std::memset(w.features.data() + static_cast<std::size_t>(w.n) * Tile::kRow, 0, Tile::kRow * sizeof(T));
  }
  std::memset(w.touched.reserve(w.n), 0, w.n * sizeof(uint16_t));
  w.records.reserve(static_cast<std::size_t>(w.n + 1) * Tile::kRecord);
  Tile &tile = *reinterpret_cast<Tile *>(w.tile.reserve(sizeof(Tile) / sizeof(T) + 1));
  const int x0 = index % f.tiles_x * 64, y0 = index / f.tiles_x * 64;
  for (int q = 0; q < 16; ++q) {
    const int x = (q & 3) * 16, y = (q >> 2) * 16;
    if (x0 + x >= in.width || y0 + y >= in.height || !w.counts[q]) continue;
    load_tile(in, camera, x0, y0, x, y, slice, shift, out, grad, tile);
    backward_tile(w, grad.depths != nullptr, x, y, w.lists.data() + q * static_cast<std::size_t>(w.stride), w.counts[q],
                  tile);
  }
  for_each_slot(f, index, w, scratch, kGeometry + NF,
                [&](int j, uint64_t slot) { store_record<T, NF, VAR>(w, j, slot, scratch); });
}

}  // namespace

template <class T>
void backward(const Inputs<T> &in, int camera, const Options &opt, const Frame<T> &f, Slice slice, TileRange range,
              Scratch<T> &scratch, const Outputs<T> &out, const Cotangents<T> &grad) {
  with_shape<T>(slice, opt.variance, [&](auto width, auto variance) {
    parallel_for(opt.threads, f.tiles_x * f.tiles_y, [&](std::size_t i, int worker) {
      const int tile = f.tile_order[i];
      if (tile < range.begin || tile >= range.end) return;
      backward_supertile<T, width(), variance()>(in, camera, f, tile, slice, scratch, scratch.workers[worker], out,
                                                 grad);
    });
  });
}

#define INSTANTIATE(T)                                                                                              \
  template void backward(const Inputs<T> &, int, const Options &, const Frame<T> &, Slice, TileRange, Scratch<T> &, \
                         const Outputs<T> &, const Cotangents<T> &);
INSTANTIATE(float)
#ifdef PERCEPTION_LEVEL_baseline
INSTANTIATE(double)
#endif

}  // namespace perception::PERCEPTION_LEVEL
