// Gradient records: what one splat gathers over one 64x64 tile, in memory that is held for a range of tiles at a time.
#pragma once
#include "../common/parallel.h"
#include "scratch.h"

namespace perception {

// [0] Σ h, [1] Σ h u, [2] Σ h dy, [3] Σ h u², [4] Σ h u dy, [5] Σ h dy², [6] Σ |h u|, [7] Σ |h dy|, [8..10] Σ w g of
// red, green and blue, [11] Σ w g of depth, then from kGeometry on dL/df for every feature channel. Sums over the pixels;
// backward.cpp has the symbols.
constexpr int kGeometry = 16;

// Tiles [begin, end), in row-major order.
struct TileRange {
  int begin, end;
};

// How many tiles of a splat's box come before tile `tile` in row-major order.
template <class T>
inline __attribute__((always_inline)) uint64_t box_tiles_before(const Splat<T> &s, int tiles_x, int tile) {
  if (tile == 0) return 0;
  auto within = [](int value, int limit) { return value < 0 ? 0 : value > limit ? limit : value; };
  const int width = s.x1 - s.x0 + 1, height = s.y1 - s.y0 + 1, row = tile / tiles_x - s.y0;
  const int in_row = row >= 0 && row < height ? within(tile % tiles_x - s.x0, width) : 0;
  return static_cast<uint64_t>(within(row, height)) * width + in_row;
}

// Slots: splat i owns as many records as its box has tiles in the range. Returns how many there are.
template <class T>
uint64_t assign_slots(const Options &opt, const Frame<T> &f, TileRange range, Scratch<T> &scratch) {
  uint64_t *slots = scratch.slots.reserve(f.count + 1);
  scratch.first_tile = range.begin;
  const Pieces pieces(f.count);
  std::vector<uint64_t> before(pieces.count + 1);
  auto owned = [&](int64_t i) {
    const Splat<T> &s = f.splats[i];
    return box_tiles_before(s, f.tiles_x, range.end) - box_tiles_before(s, f.tiles_x, range.begin);
  };
  parallel_for(opt.threads, pieces.count, [&](std::size_t piece, int) {
    uint64_t total = 0;
    for (int64_t i = pieces.begin(piece); i < pieces.end(piece); ++i) slots[i] = total, total += owned(i);
    before[piece + 1] = total;
  });
  for (int64_t piece = 0; piece < pieces.count; ++piece) before[piece + 1] += before[piece];
  parallel_pieces(opt.threads, pieces, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) slots[i] += before[begin / pieces.size];
  });
  return slots[f.count] = before[pieces.count];
}

// The longest range from `begin` on whose splats need no more than `limit` records; at least one tile.
template <class T>
TileRange next_range(const Frame<T> &f, int begin, uint64_t limit) {
  int end = begin + 1;
  while (end < f.tiles_x * f.tiles_y && f.offsets[end + 1] - f.offsets[begin] <= limit) ++end;
  return {begin, end};
}

// Makes the sums the records, one a splat.
template <class T>
void take_sums(const Frame<T> &f, Scratch<T> &scratch) {
  for (uint32_t i = 0; i <= f.count; ++i) scratch.slots[i] = i;
  std::swap(scratch.records, scratch.sums);
  std::swap(scratch.touched, scratch.sum_touched);
}

}  // namespace perception
