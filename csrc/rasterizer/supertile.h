// Gathers the splats of one 64x64-pixel tile into contiguous memory, positions relative to the tile, features padded
// to the kernel's width, and distributes them over its 16 tiles of 16x16.
#pragma once
#include "granule.h"
#include "kernels.h"
#include "records.h"

namespace perception::PERCEPTION_LEVEL {

// A row of count <= NF channels; the whole width as a copy of constant size.
template <int NF, class T>
inline void copy_channels(T *to, const T *from, int count) {
  if (count == NF)
    std::memcpy(to, from, NF * sizeof(T));
  else
    std::memcpy(to, from, count * sizeof(T));
}

// A 16x16 tile, at (x, y) of the 64x64 tile at (x0, y0) of the image, and its splats from front to back.
struct TileList {
  int x0, y0, x, y;
  const uint32_t *splats;  // indices into Worker::splats
  int n;
};

// NF: the kernel's feature width, STRIDE: of worker.features.
template <int NF, int STRIDE, class T>
void load_supertile(const Inputs<T> &in, const Frame<T> &f, int tile, Slice slice, Worker<T> &w) {
  const T x = T(tile % f.tiles_x * 64), y = T(tile / f.tiles_x * 64);
  const uint32_t *list = f.list.data() + f.offsets[tile];
  const int n = static_cast<int>(f.offsets[tile + 1] - f.offsets[tile]);
  w.splats.reserve(n + 1), w.source.reserve(n + 16), w.features.reserve(static_cast<std::size_t>(n + 1) * STRIDE);
  w.stride = n + 48;
  w.lists.reserve(16 * static_cast<std::size_t>(w.stride));
  std::memset(w.counts, 0, sizeof w.counts);
  alignas(64) uint32_t ids[16];
  uint16_t masks[16];
  constexpr int kAhead = 16;  // splats that are prefetched before they are used
  int kept = 0, pending = 0;
  for (int i = 0; i < n; ++i) {
    if (i + 2 * kAhead < n) __builtin_prefetch(&f.splats[list[i + 2 * kAhead]]);
    if (NF > 0 && i + kAhead < n) {  // its splat has arrived by now
      const T *row = in.features + static_cast<int64_t>(f.splats[list[i + kAhead]].id) * in.dims + slice.begin;
      __builtin_prefetch(row), __builtin_prefetch(row + slice.count - 1);
    }
    const Splat<T> &s = f.splats[list[i]];
    const uint32_t mask = boxes_touched<T, 0>(s, s.x - x, s.y - y);
    if (!mask) continue;
    Splat<T> &to = w.splats[kept];
    to = s;
    to.x -= x, to.y -= y;
    if constexpr (NF > 0) {
      T row[NF] = {};
      copy_channels<NF>(row, in.features + static_cast<int64_t>(s.id) * in.dims + slice.begin, slice.count);
      std::memcpy(w.features.data() + static_cast<std::size_t>(kept) * STRIDE, row, sizeof row);
    }
    w.source[kept] = list[i];
    masks[pending] = static_cast<uint16_t>(mask), ids[pending] = kept++;
    if (++pending == 16) append_to_lists(masks, ids, w.lists.data(), w.stride, w.counts), pending = 0;
  }
  if (pending) {
    for (; pending < 16; ++pending) masks[pending] = 0, ids[pending] = 0;
    append_to_lists(masks, ids, w.lists.data(), w.stride, w.counts);
  }
  w.n = kept;
}

// Marks no splat as touched; then body(list, tile) for the 16x16 tiles of 64x64 tile `index` that lie in the image.
// tile: in the worker's memory.
template <class Tile, class T, class Body>
inline void for_each_tile(const Inputs<T> &in, const Frame<T> &f, int index, Worker<T> &w, Body &&body) {
  std::memset(w.touched.reserve(w.n + 1), 0, w.n * sizeof(uint16_t));
  Tile &tile = *reinterpret_cast<Tile *>(w.tile.reserve(sizeof(Tile) / sizeof(T) + 1));
  const int x0 = index % f.tiles_x * 64, y0 = index / f.tiles_x * 64;
  for (int q = 0; q < 16; ++q) {
    const int x = (q & 3) * 16, y = (q >> 2) * 16;
    if (x0 + x >= in.width || y0 + y >= in.height) continue;
    const uint32_t *splats = w.lists.data() + q * static_cast<std::size_t>(w.stride);
    body(TileList{x0, y0, x, y, splats, static_cast<int>(w.counts[q])}, tile);
  }
}

// write(j, slot) for the splats of 64x64 tile `index` that were touched, and marks their slots: one a splat and tile it
// touches, of `size` numbers. Slots lie far apart in memory: each is prefetched some splats before it is written.
template <class T, class Write>
void for_each_slot(const Frame<T> &f, int index, const Worker<T> &w, Scratch<T> &scratch, int size, Write &&write) {
  constexpr int kAhead = 8;
  const int tx = index % f.tiles_x, ty = index / f.tiles_x;
  uint64_t slots[kAhead];
  for (int j = 0; j < w.n + kAhead; ++j) {
    uint64_t &slot = slots[j % kAhead];
    if (j >= kAhead && w.touched[j - kAhead]) {
      write(j - kAhead, slot);
      scratch.touched[slot] = 1;
    }
    if (j + kAhead < w.n) __builtin_prefetch(&scratch.slots[w.source[j + kAhead]]);
    if (j >= w.n || !w.touched[j]) continue;
    const Splat<T> &s = w.splats[j];
    const uint64_t offset = static_cast<uint64_t>(ty - s.y0) * (s.x1 - s.x0 + 1) + (tx - s.x0);
    slot = scratch.slots[w.source[j]] + offset - box_tiles_before(s, f.tiles_x, scratch.first_tile);
    const T *record = scratch.records.data() + slot * size;
    __builtin_prefetch(record, 1), __builtin_prefetch(record + size - 1, 1),
        __builtin_prefetch(&scratch.touched[slot], 1);
  }
}

}  // namespace perception::PERCEPTION_LEVEL
