// The inner loops, one set per instruction set and precision. Plain data only: nothing here may emit code that the
// linker could merge between translation units compiled for different processors.
#pragma once
#include <cstdint>

#include "../../common/levels.h"

namespace perception::training {

constexpr int kRadius = 5;  // SSIM window: 11 taps
constexpr int kTaps = 2 * kRadius + 1;
constexpr int kBlock = 4;  // rows a tile advances by
constexpr int kRing = kTaps + kBlock - 1;
constexpr int kRowCapacity = 1104;   // elements of a tile row; not a multiple of 4 KiB, which would thrash the L1
constexpr int kTileElements = 1088;  // of these, usable for a tile with its halo of 2 * kRadius pixels a side
constexpr int kMaxChannels = 16;
constexpr int kInputMaps = 4;     // x, y, x^2 + y^2, x y
constexpr int kGradientMaps = 3;  // d SSIM / d mean, d second moment, d cross moment

template <class T>
struct Photo {  // all images are [height, width, channels], C order
  const T *render;
  const T *target;  // one of target (same unit as render) and target8 (unit 1/255) is null
  const uint8_t *target8;
  const T *weight;  // [height, width] or null for 1 everywhere
  T *gradient;      // out
  int height, width, channels;
  T window[kTaps];         // normalised Gaussian
  T l1_scale, ssim_scale;  // factors of sum |x - y| and of sum SSIM in the loss
};

struct Tile {  // rows [row0, row1) and columns [col0, col1) of the gradient
  int row0, row1, col0, col1;
  double *l1, *ssim;  // out, [height]: sums over this tile's columns, one per row
};

template <class T>
struct AdamRows {
  T *param, *first, *second;  // [rows, width]
  const T *grad;              // [rows, width]
  const uint8_t *visible;     // [rows] or null for all
  const T *rate;              // [width], bias correction of the first moment included
  int64_t width;
  T beta1, beta2, eps;
  T second_scale;  // 1 / sqrt(1 - beta2^t)
  bool uniform;    // all of rate are equal
};

template <class T>
struct Kernels {
  // scratch: photometric_scratch elements, zeroed by the caller once.
  void (*photometric_tile)(const Photo<T> &, const Tile &, T *scratch);
  // One row of |x - y|: writes its gradient, returns sum w |x - y|.
  double (*absolute_row)(const Photo<T> &, int row);
  // sums [slots, 2, width] += f - ref and (f - ref)^2 over pixels [begin, end) with slot >= 0.
  void (*accumulate)(const T *features, const int32_t *slots, const T *reference, int64_t begin, int64_t end,
                     int64_t width, double *sums);
  // out = pull[slot] (f - mean[slot]) + push[slot], 0 where slot < 0.
  void (*spread)(const T *features, const int32_t *slots, const double *mean, const double *pull, const double *push,
                 int64_t begin, int64_t end, int64_t width, T *out);
  void (*exponentials)(const T *values, int64_t n, T *out);
  void (*logistics)(const T *values, int64_t n, T *out);
  double (*sum)(const T *values, int64_t n);
  double (*sum_squares)(const T *values, int64_t n);
  // Returns the number of rows skipped for a gradient that is not finite.
  int64_t (*adam)(const AdamRows<T> &, int64_t begin, int64_t end);
};

template <class T>
const Kernels<T> &kernels(Level);

constexpr int64_t kPhotometricScratch =
    int64_t(kRowCapacity) * (kRing * (kInputMaps + kGradientMaps) + (1 + kBlock) * kInputMaps + 3);

}  // namespace perception::training
