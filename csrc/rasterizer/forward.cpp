// Stage 4: front-to-back blending. With the opacity alpha_i of splat i at a pixel, the transmittance in front of it
// T_i = Π_{j<i} (1 - alpha_j), its weight w_i = alpha_i T_i and its value x_i in a channel, the image holds
//   Σ w_i x_i + T_final background,   A = Σ w_i = 1 - T_final,   Var = Σ w_i f_i² - (Σ w_i f_i)²  (features f).
// Granule by granule, so that a granule's state stays in registers while its list of splats runs by; feature channels
// follow as a product of the kept weights with the splats' feature rows.
#include "blend_list.h"
#include "matrix.h"

namespace perception::PERCEPTION_LEVEL {
namespace {

template <class T, int NF, bool VAR>
struct ForwardTile : ColorTile<T, (NF > 0)> {
  static constexpr int kRow = kFeatureRow<T, NF, VAR>;
  alignas(64) T features[16][NF ? 16 : 1][kRow ? kRow : 1];  // Σ w e, then Σ w e²: a row a pixel
  T shift[16][NF ? NF : 1];                                  // of a granule, e = f - shift: its first splat's features
  alignas(64) T rows[NF ? ColorTile<T, (NF > 0)>::kChunk : 1][kRow ? kRow : 1];  // e, then e²: a row a splat
};

// Adds granule g's list to its pixels' feature sums.
template <class T, int NF, bool VAR>
inline void blend_features(const T *features, int n, int g, ForwardTile<T, NF, VAR> &tile) {
  const uint32_t *list = tile.lists[g];
  const auto shift = load_channels<NF>(tile.shift[g], NF);
  for (int k = 0; k < n; ++k) {
    T *row = tile.rows[k];
    const auto e = load_channels<NF>(features + static_cast<std::size_t>(list[k]) * NF, NF) - shift;
    store_channels(e, row, NF);
    if constexpr (VAR) store_channels(e * e, row + NF, NF);
    for (int c = NF * (VAR ? 2 : 1); c < kFeatureRow<T, NF, VAR>; ++c) row[c] = 0;
  }
  add_weighted_rows<kFeatureRow<T, NF, VAR>>(tile.weights[0], tile.rows[0], n, tile.features[g][0]);
}

// open: granules with a pixel in the image.
template <class T, int NF, bool VAR>
void forward_tile(Worker<T> &w, bool depth, const TileList &list, uint32_t open, ForwardTile<T, NF, VAR> &tile) {
  uint32_t fresh = 0xffff;  // granules that have no shift yet
  auto &colors = static_cast<ColorTile<T, (NF > 0)> &>(tile);
  blend_tile(w, depth, list, open, colors, [&]([[maybe_unused]] int g, [[maybe_unused]] int count) {
    if constexpr (NF > 0) {
      if (fresh >> g & 1)
        std::memcpy(tile.shift[g], w.features.data() + static_cast<std::size_t>(tile.lists[g][0]) * NF, NF * sizeof(T));
      fresh &= ~(1u << g);
      blend_features(w.features.data(), count, g, tile);
    }
  });
}

// Feature sums and variances of one pixel from those of e = f - shift, [Σ w e, Σ w e²] in `sums`; t: T_final. With the
// mean m = Σ w f / A and the second moment about it, M2 = Σ w (f - m)², Var = M2 + A (1 - A) m²: no term is negative.
template <class T, int NF, bool VAR, class Count>
inline void write_features(const T *sums, const T *shift, T t, Count count, T *features, T *variance) {
  const T a = 1 - t;
  const auto s = load_channels<NF>(shift, NF), sum = load_channels<NF>(sums, NF);
  store_channels(s * a + sum, features, count);
  if constexpr (VAR) {
    if (!variance) return;
    const auto offset = sum * (a > 0 ? 1 / a : T(0)), mean = s + offset;
    const auto m2 = load_channels<NF>(sums + NF, NF) - sum * offset;
    store_channels((m2 > 0 ? m2 : Channels<T, NF>{}) + a * t * mean * mean, variance, count);
  }
}

// Row `row` of a tile, `columns` of it inside the image (a constant 16 but at the right edge).
template <class T, int NF, bool VAR, class Columns, class Count>
inline void write_row(const Inputs<T> &in, const T *background, int64_t pixel, int row, Columns columns, Slice slice,
                      Count count, const ForwardTile<T, NF, VAR> &tile, const Outputs<T> &out) {
  T t[16], color[4][16];
  row_from_granules([&](int g) { return tile.transmittance[g]; }, row, t);
  if (slice.begin == 0) {
    for (int c = 0; c < 4; ++c) row_from_granules([&](int g) { return tile.colors[g][c]; }, row, color[c]);
    for (int i = 0; i < columns; ++i) {
      for (int c = 0; c < 3; ++c) out.colors[3 * (pixel + i) + c] = color[c][i] + t[i] * background[c];
      out.alphas[pixel + i] = 1 - t[i];
    }
    if (out.depths)
      for (int i = 0; i < columns; ++i) out.depths[pixel + i] = color[3][i];
  }
  if constexpr (NF > 0)
    for (int i = 0; i < columns; ++i) {
      const int g = (row >> 2) * 4 + (i >> 2);
      const int64_t at = (pixel + i) * in.dims + slice.begin;
      write_features<T, NF, VAR>(tile.features[g][(row & 3) * 4 + (i & 3)], tile.shift[g], t[i], count,
                                 out.features + at, out.variance ? out.variance + at : nullptr);
    }
}

// (x, y): of the tile in the image.
template <class T, int NF, bool VAR>
void write_tile(const Pass<T> &pass, int x, int y, Slice slice, const ForwardTile<T, NF, VAR> &tile) {
  const Inputs<T> &in = pass.in;
  T background[3] = {};
  if (in.background) std::memcpy(background, in.background + 3 * pass.camera, sizeof background);
  for (int row = 0; row < 16 && y + row < in.height; ++row) {
    const int64_t pixel = (static_cast<int64_t>(pass.camera) * in.height + y + row) * in.width + x;
    if (x + 16 <= in.width && slice.count == NF)
      write_row(in, background, pixel, row, std::integral_constant<int, 16>(), slice, std::integral_constant<int, NF>(),
                tile, pass.out);
    else
      write_row(in, background, pixel, row, std::min(16, in.width - x), slice, slice.count, tile, pass.out);
  }
}

template <class T, int NF, bool VAR>
void forward_supertile(const Pass<T> &pass, int index, Slice slice, Worker<T> &w) {
  using Tile = ForwardTile<T, NF, VAR>;
  load_supertile<NF, NF>(pass.in, pass.frame, index, slice, w);
  for_each_tile<Tile>(pass.in, pass.frame, index, w, [&](const TileList &list, Tile &tile) {
    std::memset(tile.shift, 0, sizeof tile.shift);
    if constexpr (NF > 0) std::memset(tile.features, 0, sizeof tile.features);
    const uint32_t open = start_tile(pass.in, list, tile);
    forward_tile(w, pass.opt.depth, list, open, tile);
    write_tile(pass, list.x0 + list.x, list.y0 + list.y, slice, tile);
  });
  uint8_t *visible = pass.out.visible + pass.in.n * pass.camera;
  for (int j = 0; j < w.n; ++j)
    if (w.touched[j]) __atomic_store_n(&visible[w.splats[j].id], 1, __ATOMIC_RELAXED);
}

}  // namespace

template <class T>
void forward(const Pass<T> &pass, Slice slice, Scratch<T> &scratch) {
  const Frame<T> &f = pass.frame;
  with_shape<T>(slice, pass.opt.variance, [&](auto width, auto variance) {
    parallel_for(pass.opt.threads, f.tiles_x * f.tiles_y, [&](std::size_t i, int worker) {
      forward_supertile<T, width(), variance()>(pass, f.tile_order[i], slice, scratch.workers[worker]);
    });
  });
}

template void forward(const Pass<float> &, Slice, Scratch<float> &);
#ifdef PERCEPTION_LEVEL_baseline
template void forward(const Pass<double> &, Slice, Scratch<double> &);
#endif

}  // namespace perception::PERCEPTION_LEVEL
