// The backward pass where only the gradients of the features are wanted: the weights once more, and no chain through
// opacity and geometry. For one feature channel f of a splat, with the weight w of the splat at a pixel, and there the
// rendered sum S = Σ w f and the gradients g = dL/dS and v = dL/dV, V = Σ w f² - S² (sums over the pixel's splats),
//   dL/df = Σ over the pixels of w (g + 2 v (f - S)) = Σ w (g - 2 v (S - c)) + 2 e Σ w v,   e = f - c,
// with any constant c (here the features of the tile's first splat): large common offsets then do not cancel.
#include "blend_list.h"
#include "matrix.h"

namespace perception::PERCEPTION_LEVEL {
namespace {

template <class T, int NF, bool VAR>
struct FeatureTile : ColorTile<T, true> {
  static constexpr int kRow = kFeatureRow<T, NF, VAR>;
  alignas(64) T by_pixel[16][16][kRow];  // g - 2 v (S - c), then v
};

// Row of one pixel whose feature channels (`count` of them, a constant NF but in the last slice) begin at `at`.
// shift: c.
template <class T, int NF, bool VAR, class Count>
inline void load_pixel(const Pass<T> &pass, int64_t at, Count count, const T *shift, T *row) {
  const Cotangents<T> &grad = pass.grad;
  using C = Channels<T, NF>;
  C g = {};
  if (grad.features) g = load_channels<NF>(grad.features + at, count);
  if constexpr (VAR)
    if (grad.variance) {
      const C v = load_channels<NF>(grad.variance + at, count);
      g -= 2 * v * (load_channels<NF>(pass.out.features + at, count) - load_channels<NF>(shift, NF));
      store_channels(v, row + NF, NF);
    }
  store_channels(g, row, NF);
}

// (x, y): the 16x16 tile in the image.
template <class T, int NF, bool VAR>
void load_cotangents(const Pass<T> &pass, int x, int y, Slice slice, const T *shift, FeatureTile<T, NF, VAR> &tile) {
  const Inputs<T> &in = pass.in;
  std::memset(tile.by_pixel, 0, sizeof tile.by_pixel);
  for (int row = 0; row < 16 && y + row < in.height; ++row)
    for (int i = 0; i < 16 && x + i < in.width; ++i) {
      const int64_t pixel = (static_cast<int64_t>(pass.camera) * in.height + y + row) * in.width + x + i;
      const int64_t at = pixel * in.dims + slice.begin;
      T *to = tile.by_pixel[(row >> 2) * 4 + (i >> 2)][(row & 3) * 4 + (i & 3)];
      if (slice.count == NF)
        load_pixel<T, NF, VAR>(pass, at, std::integral_constant<int, NF>(), shift, to);
      else
        load_pixel<T, NF, VAR>(pass, at, slice.count, shift, to);
    }
}

// Adds to the splats' records, of kRow numbers, Σ over the tile's pixels of the weight times the pixel's row.
template <class T, int NF, bool VAR>
void add_tile(Worker<T> &w, const TileList &list, uint32_t open, FeatureTile<T, NF, VAR> &tile) {
  constexpr int kRow = FeatureTile<T, NF, VAR>::kRow;
  blend_tile(w, false, list, open, static_cast<ColorTile<T, true> &>(tile), [&](int g, int count) {
    uint32_t *splats = tile.lists[g];
    for (int k = 0; k < 8; ++k) splats[count + k] = w.n;  // a spare record
    multiply_rows<16, kRow, true>(
        count, [&](int k) { return tile.weights[k]; }, tile.by_pixel[g][0],
        [&](int k) { return w.records.data() + static_cast<std::size_t>(splats[k]) * kRow; });
  });
}

template <class T, int NF, bool VAR>
void features_supertile(const Pass<T> &pass, int index, Slice slice, Scratch<T> &scratch, Worker<T> &w) {
  using Tile = FeatureTile<T, NF, VAR>;
  load_supertile<VAR ? NF : 0, NF>(pass.in, pass.frame, index, slice, w);
  if (!w.n) return;
  T shift[NF] = {};
  if constexpr (VAR) std::memcpy(shift, w.features.data(), sizeof shift);
  const std::size_t size = static_cast<std::size_t>(w.n + 1) * Tile::kRow;
  std::memset(w.records.reserve(size), 0, size * sizeof(T));
  for_each_tile<Tile>(pass.in, pass.frame, index, w, [&](const TileList &list, Tile &tile) {
    if (!list.n) return;
    load_cotangents(pass, list.x0 + list.x, list.y0 + list.y, slice, shift, tile);
    const uint32_t open = start_tile(pass.in, list, static_cast<ColorTile<T, true> &>(tile));
    add_tile(w, list, open, tile);
  });
  for_each_slot(pass.frame, index, w, scratch, NF, [&](int j, uint64_t slot) {
    const T *from = w.records.data() + static_cast<std::size_t>(j) * Tile::kRow;
    auto gradient = load_channels<NF>(from, NF);
    if constexpr (VAR) {
      const T *features = w.features.data() + static_cast<std::size_t>(j) * NF;
      gradient += 2 * (load_channels<NF>(features, NF) - load_channels<NF>(shift, NF)) * load_channels<NF>(from + NF, NF);
    }
    store_channels(gradient, scratch.records.data() + slot * NF, NF);
  });
}

}  // namespace

template <class T>
void backward_features(const Pass<T> &pass, Slice slice, TileRange range, Scratch<T> &scratch) {
  const Frame<T> &f = pass.frame;
  with_shape<T>(slice, pass.opt.variance, [&](auto width, auto variance) {
    if constexpr (width() > 0)
      parallel_for(pass.opt.threads, f.tiles_x * f.tiles_y, [&](std::size_t i, int worker) {
        const int tile = f.tile_order[i];
        if (tile < range.begin || tile >= range.end) return;
        features_supertile<T, width(), variance()>(pass, tile, slice, scratch, scratch.workers[worker]);
      });
  });
}

template void backward_features(const Pass<float> &, Slice, TileRange, Scratch<float> &);
#ifdef PERCEPTION_LEVEL_baseline
template void backward_features(const Pass<double> &, Slice, TileRange, Scratch<double> &);
#endif

}  // namespace perception::PERCEPTION_LEVEL
