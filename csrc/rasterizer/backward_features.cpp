// The backward pass where only the gradients of the features are wanted: the weights once more, and no chain through
// opacity and geometry. With S, V, v and e = f - c as in backward.cpp,
//   dL/df = Σ over the pixels of w (g - 2 v (S - c)) + 2 e Σ w v.
#include "blend_list.h"
#include "matrix.h"

namespace perception::PERCEPTION_LEVEL {
namespace {

template <class T, int NF, bool VAR>
struct FeatureTile : ColorTile<T, true> {
  static constexpr int kRow = kFeatureRow<T, NF, VAR>;
  alignas(64) T by_pixel[16][16][kRow];  // g - 2 v (S - c), then v
};

// Feature channels of one pixel (COUNT of them, a constant NF but in the last slice).
template <class T, int NF, bool VAR, class Count>
inline void load_pixel(int64_t at, Count count, const T *shift, const Outputs<T> &out, const Cotangents<T> &grad,
                       T *row) {
  using C = Channels<T, NF>;
  C g = {};
  if (grad.features) g = load_channels<NF>(grad.features + at, count);
  if constexpr (VAR)
    if (grad.variance) {
      const C v = load_channels<NF>(grad.variance + at, count);
      g -= 2 * v * (load_channels<NF>(out.features + at, count) - load_channels<NF>(shift, NF));
      store_channels(v, row + NF, NF);
    }
  store_channels(g, row, NF);
}

// (x, y): the 16x16 tile in the image.
template <class T, int NF, bool VAR>
void load_cotangents(const Inputs<T> &in, int camera, int x, int y, Slice slice, const T *shift, const Outputs<T> &out,
                     const Cotangents<T> &grad, FeatureTile<T, NF, VAR> &tile) {
  std::memset(tile.by_pixel, 0, sizeof tile.by_pixel);
  for (int row = 0; row < 16 && y + row < in.height; ++row)
    for (int i = 0; i < 16 && x + i < in.width; ++i) {
      const int64_t pixel = (static_cast<int64_t>(camera) * in.height + y + row) * in.width + x + i;
      const int64_t at = pixel * in.dims + slice.begin;
      T *to = tile.by_pixel[(row >> 2) * 4 + (i >> 2)][(row & 3) * 4 + (i & 3)];
      if (slice.count == NF)
        load_pixel<T, NF, VAR>(at, std::integral_constant<int, NF>(), shift, out, grad, to);
      else
        load_pixel<T, NF, VAR>(at, slice.count, shift, out, grad, to);
    }
}

// Adds to the splats' records, of kRow numbers, Σ over the tile's pixels of the weight times the pixel's row.
template <class T, int NF, bool VAR>
void add_tile(Worker<T> &w, int x, int y, const uint32_t *list, int n, uint32_t open, FeatureTile<T, NF, VAR> &tile) {
  constexpr int kRow = FeatureTile<T, NF, VAR>::kRow;
  blend_tile(w, false, x, y, list, n, open, static_cast<ColorTile<T, true> &>(tile), [&](int g, int count) {
    uint32_t *splats = tile.lists[g];
    for (int k = 0; k < 8; ++k) splats[count + k] = w.n;  // a spare record
    multiply_rows<16, kRow, true>(
        count, [&](int k) { return tile.weights[k]; }, tile.by_pixel[g][0],
        [&](int k) { return w.records.data() + static_cast<std::size_t>(splats[k]) * kRow; });
  });
}

template <class T, int NF, bool VAR>
void features_supertile(const Inputs<T> &in, int camera, const Frame<T> &f, int index, Slice slice, Scratch<T> &scratch,
                        Worker<T> &w, const Outputs<T> &out, const Cotangents<T> &grad) {
  using Tile = FeatureTile<T, NF, VAR>;
  load_supertile<VAR ? NF : 0, NF>(in, f, index, slice, w);
  if (!w.n) return;
  T shift[NF] = {};
  if constexpr (VAR) std::memcpy(shift, w.features.data(), sizeof shift);
  const std::size_t size = static_cast<std::size_t>(w.n + 1) * Tile::kRow;
  std::memset(w.records.reserve(size), 0, size * sizeof(T));
  for_each_tile<Tile>(in, f, index, w, [&](int x0, int y0, int x, int y, const uint32_t *list, int n, Tile &tile) {
    if (!n) return;
    load_cotangents(in, camera, x0 + x, y0 + y, slice, shift, out, grad, tile);
    const uint32_t open = start_tile(in, x0, y0, x, y, static_cast<ColorTile<T, true> &>(tile));
    add_tile(w, x, y, list, n, open, tile);
  });
  for_each_slot(f, index, w, scratch, NF, [&](int j, uint64_t slot) {
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
void backward_features(const Inputs<T> &in, int camera, const Options &opt, const Frame<T> &f, Slice slice,
                       TileRange range, Scratch<T> &scratch, const Outputs<T> &out, const Cotangents<T> &grad) {
  with_shape<T>(slice, opt.variance, [&](auto width, auto variance) {
    if constexpr (width() > 0)
      parallel_for(opt.threads, f.tiles_x * f.tiles_y, [&](std::size_t i, int worker) {
        const int tile = f.tile_order[i];
        if (tile < range.begin || tile >= range.end) return;
        features_supertile<T, width(), variance()>(in, camera, f, tile, slice, scratch, scratch.workers[worker], out,
                                                   grad);
      });
  });
}

#define INSTANTIATE(T)                                                                                         \
  template void backward_features(const Inputs<T> &, int, const Options &, const Frame<T> &, Slice, TileRange, \
                                  Scratch<T> &, const Outputs<T> &, const Cotangents<T> &);
INSTANTIATE(float)
#ifdef PERCEPTION_LEVEL_baseline
INSTANTIATE(double)
#endif

}  // namespace perception::PERCEPTION_LEVEL
