// Stage 5: the backward pass, from the gradients of the images to the records of the splats (records.h). Splat by splat
// over each 16x16 tile, it repeats the blending front to back. At one pixel, for splat i of its list:
//   alpha    the splat's opacity there
//   T        the transmittance in front of it, Π_{j<i} (1 - alpha_j); T' = T (1 - alpha) behind it, T_final behind all
//   w        its weight, alpha T
//   x        its value in a channel: red, green, blue, depth or a feature; the image holds Σ w x + T_final background
//   A        the accumulated alpha, Σ w = 1 - T_final
//   g        dL/d(image) of a channel, its cotangent
//   cg       Σ_channels g x, which is dL/dw
//   R        Σ_{j>i} w_j cg_j, over the splats behind
//   k        what multiplies A in the loss: dL/dA, -g background of each channel (T_final = 1 - A), and see below
// Each w_j behind has a factor 1 - alpha, and dA/dalpha = T_final / (1 - alpha), so
//   dL/dalpha = T cg - (R - k T_final) / (1 - alpha)
//   h = dL/d ln alpha = w (cg - (R - k T_final) / T').
// R - k T_final is one number a pixel, `behind`, and with T all that is kept, whatever the number of channels.
//
// A feature channel f has the sum S = Σ w f, the variance V = Σ w f² - S², g = dL/dS and v = dL/dV. With any constant c
// (here the features of the tile's first splat, so that large common offsets do not cancel) and e = f - c,
//   dL/dw = g f + v (f² - 2 S f) = (g - 2 v (S - c)) e + v e² + c g + v (c² - 2 S c).
// The first two terms are linear in e and e²: two channels, with the cotangents g - 2 v (S - c) and v. The last two are
// the same for all splats and belong to k.
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
  alignas(64) T behind[16][16];                                              // R - k T_final
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

// Feature channels of one pixel (`count` of them, a constant NF but in the last slice) that begin at `at`, with
// accumulated alpha a: the cotangents of e, then of e², go to row, what each adds to `behind` to `behind`. shift: c.
template <class T, int NF, bool VAR, class Count>
inline void load_pixel_features(const Pass<T> &pass, int64_t at, Count count, const T *shift, T a, T *row, T *behind) {
  using C = Channels<T, NF>;
  const Outputs<T> &out = pass.out;
  const Cotangents<T> &grad = pass.grad;
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

// Cotangents and `behind` before the first splat, where R is over all splats, for row `row` of a tile: from pixel
// `pixel` of the images on, `columns` of it inside them (a constant 16 but at the edge).
template <class T, int NF, bool VAR, class Columns, class Count>
inline void load_row(const Pass<T> &pass, const T *background, int64_t pixel, int row, Columns columns, Slice slice,
                     Count count, const T *shift, BackwardTile<T, NF, VAR> &tile) {
  const Outputs<T> &out = pass.out;
  const Cotangents<T> &grad = pass.grad;
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
      load_pixel_features<T, NF, VAR>(pass, (pixel + i) * pass.in.dims + slice.begin, count, shift,
                                      out.alphas[pixel + i],
                                      tile.by_pixel[(row >> 2) * 4 + (i >> 2)][(row & 3) * 4 + (i & 3)], by_pixel[i]);
    transpose<16, NF>(by_pixel[0], by_channel[0]);
    for (int half = NF / 2; half > 0; half /= 2)
      for (int c = 0; c < half; ++c)
        for (int i = 0; i < 16; ++i) by_channel[c][i] += by_channel[c + half][i];
    for (int i = 0; i < 16; ++i) behind[i] += by_channel[0][i];
  }
  row_to_granules(behind, row, [&](int g) { return tile.behind[g]; });
  for (int c = 0; c < 4; ++c) row_to_granules(cotangent[c], row, [&](int g) { return tile.cotangent[g][c]; });
}

template <class T, int NF, bool VAR>
void load_tile(const Pass<T> &pass, const TileList &list, Slice slice, const T *shift, BackwardTile<T, NF, VAR> &tile) {
  const Inputs<T> &in = pass.in;
  const int x = list.x0 + list.x, y = list.y0 + list.y;
  T background[3] = {};
  if (in.background) std::memcpy(background, in.background + 3 * pass.camera, sizeof background);
  const bool full = x + 16 <= in.width && y + 16 <= in.height;
  tile.open = 0;
  for (int g = 0; g < 16; ++g) {
    const uint32_t inside = pixels_inside(x, y, g, in.width, in.height);
    tile.open |= static_cast<uint32_t>(inside != 0) << g;
    granule_pixels(list.x, list.y, g, inside, tile.px[g], tile.py[g]);
    for (T &t : tile.transmittance[g]) t = 1;
  }
  if (!full) {
    std::memset(tile.behind, 0, sizeof tile.behind);
    std::memset(tile.cotangent, 0, sizeof tile.cotangent);
    std::memset(tile.by_pixel, 0, sizeof tile.by_pixel);
  }
  for (int row = 0; row < 16 && y + row < in.height; ++row) {
    const int64_t pixel = (static_cast<int64_t>(pass.camera) * in.height + y + row) * in.width + x;
    if (full && slice.count == NF)
      load_row(pass, background, pixel, row, std::integral_constant<int, 16>(), slice,
               std::integral_constant<int, NF>(), shift, tile);
    else
      load_row(pass, background, pixel, row, std::min(16, in.width - x), slice, slice.count, shift, tile);
  }
  if constexpr (NF > 0)
    for (int g = 0; g < 16; ++g)
      transpose<16, BackwardTile<T, NF, VAR>::kRow>(tile.by_pixel[g][0], tile.by_channel[g][0]);
}

// The sums over pixels that one splat gathers, a lane a pixel: numbers [0..11] of its record (records.h). With (dx, dy)
// from the pixel's centre to the splat's mean and u = dx + k dy (k of the splat, see Projected),
//   ln alpha = ln opacity - (u² / var_x + dy² / var_y) / 2,
// so the gradients of mean, var_x, k and var_y are sums of h times u, dy and their products: see picture_gradient.
template <class T, bool DEPTH>
struct Moments {
  Vec<T> h, hu, hy, huu, huy, hyy;  // Σ h, Σ h u, Σ h dy, Σ h u², Σ h u dy, Σ h dy²
  Vec<T> size_u, size_y;            // Σ |h u|, Σ |h dy|
  Vec<T> rgb[3], z;                 // Σ w g of red, green, blue and depth
  Moments() {
    const Vec<T> zero(T(0));
    h = hu = hy = huu = huy = hyy = size_u = size_y = rgb[0] = rgb[1] = rgb[2] = z = zero;
  }
  void store(T *record, bool first) const {
    using V = Vec<T>;
    const V zero(T(0));
    const V all[kGeometry] = {h,      hu,     hy, huu,  huy,  hyy,  size_u, size_y, rgb[0],
                              rgb[1], rgb[2], z,  zero, zero, zero, zero};
    constexpr int kUsed = DEPTH ? 12 : 11;
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
  m.size_u = add_size(hu, m.size_u), m.size_y = add_size(hy, m.size_y);
  m.huu = add_product(hu, b.u, m.huu), m.huy = add_product(hu, b.dy, m.huy), m.hyy = add_product(hy, b.dy, m.hyy);
  m.rgb[0] = add_product(w, red, m.rgb[0]), m.rgb[1] = add_product(w, green, m.rgb[1]);
  m.rgb[2] = add_product(w, blue, m.rgb[2]);
  if constexpr (DEPTH) m.z = add_product(w, depth, m.z);
}

// Splats [begin, end) of the list that touch an open granule, with their masks; returns how many.
template <class T, bool FEATURES>
int list_splats(const Worker<T> &w, const TileList &list, int begin, int end, ColorTile<T, FEATURES> &tile) {
  int n = 0;
  for (int j = begin; j < end; ++j) {
    const Splat<T> &s = w.splats[list.splats[j]];
    const uint32_t mask = boxes_touched<T, 1>(s, s.x - list.x, s.y - list.y) & tile.open;
    tile.splats[n] = list.splats[j], tile.masks[n] = static_cast<uint16_t>(mask);
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
void backward_tile(Worker<T> &w, bool depth, const TileList &list, BackwardTile<T, NF, VAR> &tile) {
  using Tile = BackwardTile<T, NF, VAR>;
  auto &colors = static_cast<ColorTile<T, (NF > 0)> &>(tile);
  for (int begin = 0; begin < list.n && tile.open; begin += Tile::kChunk) {
    const int count = list_splats(w, list, begin, std::min(list.n, begin + Tile::kChunk), colors);
    if constexpr (NF > 0) feature_products<Tile::kRow>(w, count, tile.by_channel[0][0], colors);
    depth ? blend_chunk<true>(w, count, Tile::kRecord, colors) : blend_chunk<false>(w, count, Tile::kRecord, colors);
    if constexpr (NF > 0) feature_gradients<Tile::kRow>(w, tile.by_pixel[0][0], colors);
  }
}

// Writes one splat's record to its slot: the moments, then the feature gradient dL/df = Σ w (g - 2 v (S - c) + 2 v e).
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
void backward_supertile(const Pass<T> &pass, int index, Slice slice, Scratch<T> &scratch, Worker<T> &w) {
  using Tile = BackwardTile<T, NF, VAR>;
  load_supertile<NF, Tile::kRow>(pass.in, pass.frame, index, slice, w);
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
  w.records.reserve(static_cast<std::size_t>(w.n + 1) * Tile::kRecord);
  for_each_tile<Tile>(pass.in, pass.frame, index, w, [&](const TileList &list, Tile &tile) {
    if (!list.n) return;
    load_tile(pass, list, slice, shift, tile);
    backward_tile(w, pass.grad.depths != nullptr, list, tile);
  });
  for_each_slot(pass.frame, index, w, scratch, kGeometry + NF,
                [&](int j, uint64_t slot) { store_record<T, NF, VAR>(w, j, slot, scratch); });
}

}  // namespace

template <class T>
void backward(const Pass<T> &pass, Slice slice, TileRange range, Scratch<T> &scratch) {
  const Frame<T> &f = pass.frame;
  with_shape<T>(slice, pass.opt.variance, [&](auto width, auto variance) {
    parallel_for(pass.opt.threads, f.tiles_x * f.tiles_y, [&](std::size_t i, int worker) {
      const int tile = f.tile_order[i];
      if (tile < range.begin || tile >= range.end) return;
      backward_supertile<T, width(), variance()>(pass, tile, slice, scratch, scratch.workers[worker]);
    });
  });
}

template void backward(const Pass<float> &, Slice, TileRange, Scratch<float> &);
#ifdef PERCEPTION_LEVEL_baseline
template void backward(const Pass<double> &, Slice, TileRange, Scratch<double> &);
#endif

}  // namespace perception::PERCEPTION_LEVEL
