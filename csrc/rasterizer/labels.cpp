// Every pixel's label of largest weight, for several labellings of the Gaussians at once. A label's weight in a pixel
// is the sum of the weights of its Gaussians there, so one pass serves any number of labels.
#include "blend_list.h"
#include "matrix.h"

namespace perception::PERCEPTION_LEVEL {
namespace {

constexpr int kPixels = 16 * 16;  // of a tile, granule by granule

// Where the splats of a 64x64 tile add their weights. Arrays in the worker's memory, refilled for every 16x16 tile but
// for `own`.
struct Slots {
  int32_t *own;    // [L, n] label of every splat
  int32_t *of_splat;  // [L, n] slot of every splat in the tile's list, -1 without a label
  int32_t *slot;   // [most] slot of every label, -1 for none yet
  int32_t *name;   // [slots] label of every slot
  int begin[kMaxLabellings + 1];  // first slot of every labelling
};

template <class T>
Slots load_labels(const Labels &labels, int64_t n, Worker<T> &w) {
  const std::size_t size = static_cast<std::size_t>(labels.count) * w.n, most = labels.most;
  int32_t *memory = w.labels.reserve(2 * size + (labels.count + 1) * most + 1);
  const Slots slots{memory, memory + size, memory + 2 * size, memory + 2 * size + most, {}};
  for (int l = 0; l < labels.count; ++l)
    for (int j = 0; j < w.n; ++j) slots.own[l * w.n + j] = labels.of[l * n + w.splats[j].id];
  return slots;
}

// Numbers the labels of the tile's list in the order in which they appear.
template <class T>
void number_labels(const Labels &labels, const Worker<T> &w, const TileList &list, Slots &slots) {
  int used = 0;
  for (int l = 0; l < labels.count; ++l) {
    slots.begin[l] = used;
    std::memset(slots.slot, -1, labels.most * sizeof(int32_t));
    for (int i = 0; i < list.n; ++i) {
      const int32_t label = slots.own[l * w.n + list.splats[i]];
      if (label >= 0 && slots.slot[label] < 0) slots.slot[label] = used, slots.name[used++] = label;
      slots.of_splat[l * w.n + list.splats[i]] = label < 0 ? -1 : slots.slot[label];
    }
  }
  slots.begin[labels.count] = used;
}

// open: granules with a pixel in the image. sums: [slots, 16, 16].
template <class T>
void sum_weights(const Labels &labels, Worker<T> &w, const TileList &list, uint32_t open, const Slots &slots,
                 ColorTile<T, true> &tile, T *sums) {
  blend_tile(w, false, list, open, tile, [&](int g, int count) {
    for (int k = 0; k < count; ++k) {
      const auto weights = load_channels<16>(tile.weights[k], 16);
      for (int l = 0; l < labels.count; ++l) {
        const int32_t slot = slots.of_splat[l * w.n + tile.lists[g][k]];
        if (slot < 0) continue;
        T *sum = sums + slot * kPixels + 16 * g;
        store_channels(load_channels<16>(sum, 16) + weights, sum, 16);
      }
    }
  });
}

// (x, y): of the tile in the image. Of equal weights the smaller label wins.
template <class T>
void write_labels(const Inputs<T> &in, const Labels &labels, int x, int y, const Slots &slots, const T *sums) {
  for (int l = 0; l < labels.count; ++l) {
    T best[kPixels];
    int32_t label[kPixels];
    for (int p = 0; p < kPixels; ++p) best[p] = T(labels.least), label[p] = -1;
    for (int s = slots.begin[l]; s < slots.begin[l + 1]; ++s) {
      const T *sum = sums + static_cast<std::size_t>(s) * kPixels;
      const int32_t name = slots.name[s];
      for (int p = 0; p < kPixels; ++p) {
        const bool wins = sum[p] > best[p] || (sum[p] == best[p] && name < label[p]);
        best[p] = wins ? sum[p] : best[p], label[p] = wins ? name : label[p];
      }
    }
    for (int row = 0; row < 16 && y + row < in.height; ++row)
      for (int i = 0; i < 16 && x + i < in.width; ++i)
        labels.images[(static_cast<int64_t>(l) * in.height + y + row) * in.width + x + i] =
            label[((row >> 2) * 4 + (i >> 2)) * 16 + (row & 3) * 4 + (i & 3)];
  }
}

template <class T>
void label_supertile(const Inputs<T> &in, const Frame<T> &f, int index, const Labels &labels, Worker<T> &w,
                     uint8_t *visible) {
  using Tile = ColorTile<T, true>;
  load_supertile<0, 0>(in, f, index, Slice{0, 0, false}, w);
  Slots slots = load_labels(labels, in.n, w);
  for_each_tile<Tile>(in, f, index, w, [&](const TileList &list, Tile &tile) {
    number_labels(labels, w, list, slots);
    const std::size_t size = static_cast<std::size_t>(slots.begin[labels.count]) * kPixels;
    T *sums = w.records.reserve(size + 1);
    std::memset(sums, 0, size * sizeof(T));
    const uint32_t open = start_tile(in, list, tile);
    sum_weights(labels, w, list, open, slots, tile, sums);
    write_labels(in, labels, list.x0 + list.x, list.y0 + list.y, slots, sums);
  });
  for (int j = 0; j < w.n; ++j)
    if (w.touched[j]) __atomic_store_n(&visible[w.splats[j].id], 1, __ATOMIC_RELAXED);
}

}  // namespace

template <class T>
void label_pixels(const Inputs<T> &in, const Options &opt, const Frame<T> &f, const Labels &labels, Scratch<T> &scratch,
                  uint8_t *visible) {
  parallel_for(opt.threads, f.tiles_x * f.tiles_y, [&](std::size_t i, int worker) {
    label_supertile(in, f, f.tile_order[i], labels, scratch.workers[worker], visible);
  });
}

#define INSTANTIATE(T)                                                                                       \
  template void label_pixels(const Inputs<T> &, const Options &, const Frame<T> &, const Labels &, Scratch<T> &, \
                             uint8_t *);
INSTANTIATE(float)
#ifdef PERCEPTION_LEVEL_baseline
INSTANTIATE(double)
#endif

}  // namespace perception::PERCEPTION_LEVEL
