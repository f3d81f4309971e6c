// Not part of rendering: counts the contributing (splat, pixel) pairs, the unit in which speed is reported.
#pragma once
#include "supertile.h"

namespace perception::PERCEPTION_LEVEL {

template <class T>
uint64_t count_tile(const Inputs<T> &in, const Worker<T> &w, int x0, int y0, int q) {
  using V = Vec<T>;
  const Grid<T> &grid = kGrid<T>;
  const int x = (q & 3) * 16, y = (q >> 2) * 16;
  const uint32_t *list = w.lists.data() + q * static_cast<std::size_t>(w.stride);
  uint64_t pairs = 0;
  for (int g = 0; g < 16; ++g) {
    const uint32_t inside = pixels_inside(x0 + x, y0 + y, g, in.width, in.height);
    for (int p = 0; p < kParts<T>; ++p) {
      T px[V::kLanes], py[V::kLanes];
      for (int i = 0; i < V::kLanes; ++i) {
        const int lane = p * V::kLanes + i;
        px[i] = T(x) + grid.box_x[1][g] + T(lane & 3), py[i] = T(y) + grid.box_y[1][g] + T(lane >> 2);
      }
      Mask<T> live = mask_from_bits<T>(inside >> (p * V::kLanes));
      V t(T(1));
      for (uint32_t i = 0; i < w.counts[q] && any(live); ++i) {
        const Blend<T> b = blend(w.splats[list[i]], V::load(px), V::load(py), t, live);
        t = b.next;
        pairs += __builtin_popcount(bits(b.mask));
      }
    }
  }
  return pairs;
}

template <class T>
uint64_t count_pairs(const Inputs<T> &in, const Frame<T> &f, Scratch<T> &scratch) {
  uint64_t pairs = 0;
  Worker<T> &w = scratch.workers[0];
  for (int tile = 0; tile < f.tiles_x * f.tiles_y; ++tile) {
    load_supertile<0, 0>(in, f, tile, Slice{0, 0}, w);
    const int x0 = tile % f.tiles_x * 64, y0 = tile / f.tiles_x * 64;
    for (int q = 0; q < 16; ++q) pairs += count_tile(in, w, x0, y0, q);
  }
  return pairs;
}

}  // namespace perception::PERCEPTION_LEVEL
