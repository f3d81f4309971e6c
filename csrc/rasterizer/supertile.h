// Gathers the splats of one 64x64-pixel tile into contiguous memory, positions relative to the tile, features padded
// to the kernel's width, and distributes them over its 16 tiles of 16x16.
#pragma once
#include "granule.h"

namespace perception::PERCEPTION_LEVEL {

// The slice of feature channels one pass blends.
struct Slice {
  int begin, count;
};

template <class T>
void load_features(const T *row, int count, int width, T *out) {
  for (int c = 0; c < count; ++c) out[c] = row[c];
  for (int c = count; c < width; ++c) out[c] = 0;
}

// width: the kernel's feature width, stride: of worker.features.
template <class T>
void load_supertile(const Inputs<T> &in, const Frame<T> &f, int tile, Slice slice, int width, int stride, Worker<T> &w) {
  const T x = T(tile % f.tiles_x * 64), y = T(tile / f.tiles_x * 64);
  const uint32_t *list = f.list.data() + f.offsets[tile];
  const int n = static_cast<int>(f.offsets[tile + 1] - f.offsets[tile]);
  w.splats.reserve(n + 1), w.source.reserve(n + 16), w.features.reserve(static_cast<std::size_t>(n + 1) * stride);
  w.stride = n + 48;
  w.lists.reserve(16 * static_cast<std::size_t>(w.stride));
  std::memset(w.counts, 0, sizeof w.counts);
  alignas(64) uint32_t ids[16];
  uint16_t masks[16];
  int kept = 0, pending = 0;
  for (int i = 0; i < n; ++i) {
    if (i + 24 < n) __builtin_prefetch(&f.splats[list[i + 24]]);
    const Splat<T> &s = f.splats[list[i]];
    const uint32_t mask = boxes_touched<T, 0>(s, s.x - x, s.y - y);
    if (!mask) continue;
    Splat<T> &to = w.splats[kept];
    to = s;
    to.x -= x, to.y -= y;
    if (width) load_features(in.features + static_cast<int64_t>(s.id) * in.dims + slice.begin, slice.count, width,
                             w.features.data() + static_cast<std::size_t>(kept) * stride);
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

}  // namespace perception::PERCEPTION_LEVEL
