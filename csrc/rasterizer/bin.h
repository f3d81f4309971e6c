// Stage 3: the list of splats of every 64x64-pixel tile, by bounding box, in depth order.
#pragma once
#include <algorithm>
#include <atomic>
#include <stdexcept>
#include <string>

#include "../common/parallel.h"
#include "scratch.h"

namespace perception {

// How many tiles the splats' boxes touch in all; refuses more than the lists may hold.
template <class T>
uint64_t count_listed(const Options &opt, const Frame<T> &f) {
  std::atomic<uint64_t> total{0};
  parallel_pieces(opt.threads, Pieces(f.count), [&](int64_t begin, int64_t end) {
    uint64_t listed = 0;
    for (int64_t i = begin; i < end; ++i) {
      const Splat<T> &s = f.splats[i];
      listed += static_cast<uint64_t>(s.x1 - s.x0 + 1) * (s.y1 - s.y0 + 1);
    }
    total += listed;
  });
  if (total > kMaxListed)
    throw std::length_error(std::to_string(f.count) + " Gaussians in view touch " + std::to_string(total) +
                            " tiles of 64 x 64 pixels, expected at most " + std::to_string(kMaxListed) +
                            "; render fewer or smaller Gaussians, or a smaller image");
  return total;
}

template <class T>
void bin_splats(const Options &opt, Frame<T> &f, Scratch<T> &scratch) {
  const int tiles = f.tiles_x * f.tiles_y;
  uint32_t *list = f.list.reserve(count_listed(opt, f));
  const uint32_t n = f.count;
  const int parts = static_cast<int>(n / 16384 + 1 < static_cast<uint32_t>(opt.threads) ? n / 16384 + 1 : opt.threads);
  const uint32_t *order = scratch.order[0].data();
  uint32_t *histograms = scratch.histograms.reserve(static_cast<std::size_t>(parts) * tiles);
  auto begin = [&](std::size_t part) { return static_cast<uint32_t>(static_cast<uint64_t>(n) * part / parts); };
  auto each_tile = [&](std::size_t part, auto &&visit) {
    for (uint32_t i = begin(part); i < begin(part + 1); ++i) {
      if (i + 16 < begin(part + 1)) __builtin_prefetch(&f.splats[order[i + 16]].id);
      const Splat<T> &s = f.splats[order[i]];
      for (int y = s.y0; y <= s.y1; ++y)
        for (int x = s.x0; x <= s.x1; ++x) visit(y * f.tiles_x + x, order[i]);
    }
  };
  parallel_for(parts, parts, [&](std::size_t part, int) {
    uint32_t *h = histograms + part * tiles;
    std::memset(h, 0, tiles * sizeof *h);
    each_tile(part, [h](int tile, uint32_t) { ++h[tile]; });
  });
  uint32_t *offsets = f.offsets.reserve(tiles + 1), *tile_order = f.tile_order.reserve(tiles);
  uint64_t total = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    offsets[tile] = static_cast<uint32_t>(total);
    for (int part = 0; part < parts; ++part) {
      uint32_t &h = histograms[static_cast<std::size_t>(part) * tiles + tile], count = h;
      h = static_cast<uint32_t>(total), total += count;
    }
    tile_order[tile] = tile;
  }
  offsets[tiles] = static_cast<uint32_t>(total);
  parallel_for(parts, parts, [&](std::size_t part, int) {
    uint32_t *h = histograms + part * tiles;
    each_tile(part, [h, list](int tile, uint32_t splat) { list[h[tile]++] = splat; });
  });
  std::sort(tile_order, tile_order + tiles, [offsets](uint32_t a, uint32_t b) {
    const uint32_t na = offsets[a + 1] - offsets[a], nb = offsets[b + 1] - offsets[b];
    return na != nb ? na > nb : a < b;
  });
}

}  // namespace perception
