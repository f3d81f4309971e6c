// Working memory of one call, reused by later calls.
#pragma once
#include <cstring>
#include <type_traits>
#include <vector>

#include "rasterizer.h"

namespace perception {

template <class T>
using DepthKey = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;

template <class T>
struct Worker {
  Buffer<Splat<T>> splats;  // of the current 64x64 tile, front to back
  Buffer<T> features;       // [n, width]
  Buffer<uint32_t> source;  // [n] index into Frame::splats
  Buffer<uint32_t> lists;   // [16, stride] per 16x16 tile, indices into splats
  int stride = 0;
  uint32_t counts[16];
  int n = 0;
  Buffer<uint16_t> touched;                  // [n] pixels of some granule, 0 for none
  Buffer<T> records;                         // [n, record]
  Buffer<int32_t> labels;                    // of the splats, and the sums they go to
  Buffer<T> tile;                            // per-pixel state
  uint64_t evaluated = 0, contributing = 0;  // pairs of the forward pass
};

template <class T>
struct Scratch {
  Buffer<DepthKey<T>> keys[2];
  Buffer<uint32_t> order[2];
  Buffer<uint32_t> histograms;
  Buffer<uint64_t> slots;   // first gradient record of every splat
  int first_tile = 0;       // the tiles at hand begin here
  Buffer<uint8_t> touched;  // per record
  Buffer<T> records;
  Buffer<uint8_t> sum_touched;  // the same summed over several parts of the picture, one a splat
  Buffer<T> sums;
  Buffer<double> camera_sums;
  std::vector<Worker<T>> workers;
};

}  // namespace perception
