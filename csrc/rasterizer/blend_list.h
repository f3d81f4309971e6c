// Granule by granule: a granule's state stays in registers while its list of splats runs by.
#pragma once
#include "kernels.h"
#include "supertile.h"

namespace perception::PERCEPTION_LEVEL {
namespace {

// A 16x16 tile, its state a lane a pixel. Chunks of its list are worked on at a time.
template <class T, bool FEATURES>
struct ColorTile {
  static constexpr int kChunk = FEATURES ? 128 : 256;
  alignas(64) T px[16][16], py[16][16], transmittance[16][16];
  alignas(64) T colors[16][4][16];  // red, green, blue, depth
  uint32_t counts[16];
  uint32_t lists[16][kChunk + 32];
  alignas(64) T weights[FEATURES ? kChunk + 8 : 1][16];
};

// Nothing blended yet. Returns the granules with a pixel in the image.
template <class T, bool FEATURES>
uint32_t start_tile(const Inputs<T> &in, const TileList &list, ColorTile<T, FEATURES> &tile) {
  std::memset(tile.colors, 0, sizeof tile.colors);
  uint32_t open = 0;
  for (int g = 0; g < 16; ++g) {
    const uint32_t inside = pixels_inside(list.x0 + list.x, list.y0 + list.y, g, in.width, in.height);
    open |= static_cast<uint32_t>(inside != 0) << g;
    granule_pixels(list.x, list.y, g, inside, tile.px[g], tile.py[g]);
    for (T &t : tile.transmittance[g]) t = 1;
  }
  return open;
}

// Runs some of a granule's pixels over a list of splats. False when none of them is open any more.
template <bool DEPTH, class T, bool FEATURES>
[[gnu::noinline]] bool blend_list(Worker<T> &w, int n, int g, int lane, ColorTile<T, FEATURES> &tile) {
  using P = Pack<T>;
  const Splat<T> *splats = w.splats.data();
  uint16_t *touched = w.touched.data();
  const uint32_t *list = tile.lists[g];
  P px = P::load(tile.px[g] + lane);
  const P py = P::load(tile.py[g] + lane);
  P t = P::load(tile.transmittance[g] + lane);
  P red = P::load(tile.colors[g][0] + lane), green = P::load(tile.colors[g][1] + lane),
    blue = P::load(tile.colors[g][2] + lane), depth;
  if constexpr (DEPTH) depth = P::load(tile.colors[g][3] + lane);
  int i = 0, pairs = 0;
  bool open = true;
  while (i < n) {
    const uint32_t at = list[i++];
    const Splat<T> &s = splats[at];
    bool stopped = false;
    const Blend<T> b = blend(s, px, py, t, stopped);
    t = b.next;
    red = fma(b.weight, P(s.r), red), green = fma(b.weight, P(s.g), green), blue = fma(b.weight, P(s.b), blue);
    if constexpr (DEPTH) depth = fma(b.weight, P(s.z), depth);
    if constexpr (FEATURES) b.weight.store(tile.weights[i - 1] + lane);
    const uint32_t mask = bits(b.on);
    touched[at] |= static_cast<uint16_t>(mask);
    pairs += __builtin_popcount(mask);
    if (__builtin_expect(stopped, 0)) {
      px.store(tile.px[g] + lane);
      open = any(px < P(kFar<T>));
      if (!open) break;
    }
  }
  w.evaluated += static_cast<uint64_t>(i) * P::kLanes, w.contributing += pairs;
  t.store(tile.transmittance[g] + lane);
  red.store(tile.colors[g][0] + lane), green.store(tile.colors[g][1] + lane), blue.store(tile.colors[g][2] + lane);
  if constexpr (DEPTH) depth.store(tile.colors[g][3] + lane);
  if constexpr (FEATURES)
    for (; i < n; ++i) P(T(0)).store(tile.weights[i] + lane);
  return open;
}

// Appends splats [begin, end) of the tile's list to the lists of the granules that they touch.
template <class T, bool FEATURES>
void list_granules(const Worker<T> &w, const TileList &list, int begin, int end, ColorTile<T, FEATURES> &tile) {
  std::memset(tile.counts, 0, sizeof tile.counts);
  for (int i = begin; i < end; i += 16) {
    uint16_t masks[16] = {};
    for (int j = 0; j < 16 && i + j < end; ++j) {
      const Splat<T> &s = w.splats[list.splats[i + j]];
      masks[j] = static_cast<uint16_t>(boxes_touched<T, 1>(s, s.x - list.x, s.y - list.y));
    }
    append_to_lists(masks, list.splats + i, tile.lists[0], sizeof tile.lists[0] / sizeof(uint32_t), tile.counts);
  }
}

// Blends a tile's list chunk by chunk; body(g, count) when tile.lists[g] holds granule g's `count` splats of the chunk
// and, with FEATURES, tile.weights their weights. open: granules with a pixel in the image.
template <class T, bool FEATURES, class Body>
inline void blend_tile(Worker<T> &w, bool depth, const TileList &list, uint32_t open, ColorTile<T, FEATURES> &tile,
                       Body &&body) {
  constexpr int kChunk = ColorTile<T, FEATURES>::kChunk;
  for (int begin = 0; begin < list.n && open; begin += kChunk) {
    list_granules(w, list, begin, std::min(list.n, begin + kChunk), tile);
    for (uint32_t rest = open; rest; rest &= rest - 1) {
      const int g = __builtin_ctz(rest), count = static_cast<int>(tile.counts[g]);
      if (!count) continue;
      bool still_open = false;
      for (int lane = 0; lane < 16; lane += Pack<T>::kLanes)
        still_open |= depth ? blend_list<true>(w, count, g, lane, tile) : blend_list<false>(w, count, g, lane, tile);
      body(g, count);
      if (!still_open) open &= ~(1u << g);
    }
  }
}

}  // namespace
}  // namespace perception::PERCEPTION_LEVEL
