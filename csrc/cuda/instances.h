// The instance loss: mean features of masks, how far these are apart, and the gradient with respect to the features.
// losses.py has the formulas; the structs are filled in by rasterizer/cuda/training.py.
#pragma once
#include "device.h"

namespace perception {

using Indices = GLOBAL(const Index);  // one name, since GLOBAL is a pointer of the first name only
using Sums = GLOBAL(double);
constexpr int kPieces = 32;  // of the image; a thread block sums one piece of one mask
constexpr int kAtOnce = 8;   // channels summed at once

// features [pixels,dims]; slots [pixels], each pixel's mask or -1; counts, first [masks]: pixels, and one of them.
// parts [masks,kPieces,dims,2]: sums of differences to the first pixel and of their squares, so that features far from
// zero do not cancel. means [masks,dims], scatter [masks]: sums of squared distances to the mean. pull, push, spread:
// of `spread` alone.
struct Masks {
  Reals features;
  GLOBAL(const int) slots;
  Indices counts, first;
  Sums parts, means, scatter, pull, push;
  Results spread;
  int pixels, masks, dims;
};

// A block a piece of a mask.
extern "C" __global__ void __launch_bounds__(kThreads) prototype_parts_kernel(Masks of) {
  __shared__ SHARED(double) sums[2 * kAtOnce][kThreads];
  const int mask = blockIdx.x / kPieces, piece = blockIdx.x % kPieces;
  const Reals reference = of.features + of.first[mask] * of.dims;
  for (int c0 = 0; c0 < of.dims; c0 += kAtOnce) {
    const int width = lower(kAtOnce, of.dims - c0);
    double sum[2 * kAtOnce] = {};
    for (Index p = Index(piece) * kThreads + threadIdx.x; p < of.pixels; p += Index(kPieces) * kThreads) {
      if (of.slots[p] != mask) continue;
      for (int c = 0; c < kAtOnce; ++c) {  // of a fixed number, so that the sums are in registers
        const double away = c < width ? of.features[p * of.dims + c0 + c] - reference[c0 + c] : T(0);
        sum[2 * c] += away, sum[2 * c + 1] += away * away;
      }
    }
    for (int c = 0; c < 2 * kAtOnce; ++c) sums[c][threadIdx.x] = sum[c];
    add_threads(sums, 2 * width);
    if (threadIdx.x == 0)
      for (int c = 0; c < 2 * width; ++c) of.parts[(Index(blockIdx.x) * of.dims + c0) * 2 + c] = sums[c][0];
    __syncthreads();  // the sums have been read
  }
}

// A thread a mask: its mean and scatter from its pieces, in order.
extern "C" __global__ void __launch_bounds__(kThreads) prototype_kernel(Masks of) {
  const int mask = blockIdx.x * kThreads + threadIdx.x;
  if (mask >= of.masks) return;
  double scatter = 0;
  for (int c = 0; c < of.dims; ++c) {
    double sum = 0, square = 0;
    for (int piece = 0; piece < kPieces; ++piece) {
      const Index at = ((Index(mask) * kPieces + piece) * of.dims + c) * 2;
      sum += of.parts[at], square += of.parts[at + 1];
    }
    const double mean = sum / of.counts[mask], left = square - sum * mean;
    of.means[Index(mask) * of.dims + c] = of.features[of.first[mask] * of.dims + c] + mean;
    scatter += left > 0 ? left : 0;
  }
  of.scatter[mask] = scatter;
}

// A thread a number: spread = pull (F - mean) + push, 0 without a mask.
extern "C" __global__ void __launch_bounds__(kThreads) spread_kernel(Masks of) {
  const Index at = Index(blockIdx.x) * kThreads + threadIdx.x;
  const Index pixel = at / of.dims, channel = at % of.dims;
  if (pixel >= of.pixels) return;
  const int mask = of.slots[pixel];
  const Index row = Index(mask) * of.dims + channel;
  of.spread[at] = mask < 0 ? T(0) : T(of.pull[mask]) * (of.features[at] - T(of.means[row])) + T(of.push[row]);
}

// points [count,dims]. value: mean of relu(margin - squared distance) over the pairs; gradient [count,dims].
struct Pairs {
  Sums points, gradient, value;
  int count, dims;
  double margin;
};

// One block; a thread every kThreads-th point and its pairs.
extern "C" __global__ void __launch_bounds__(kThreads) separation_kernel(Pairs of) {
  __shared__ SHARED(double) sums[1][kThreads];
  const double pairs = 0.5 * of.count * (of.count - 1.0);
  double total = 0;
  for (Index i = threadIdx.x; i < of.count; i += kThreads) {
    for (int c = 0; c < of.dims; ++c) of.gradient[i * of.dims + c] = 0;
    for (Index j = 0; j < of.count; ++j) {
      double square = 0;
      for (int c = 0; c < of.dims; ++c) {
        const double away = of.points[i * of.dims + c] - of.points[j * of.dims + c];
        square += away * away;
      }
      const double near = of.margin - square;
      if (i == j || !(near > 0)) continue;
      total += near;
      for (int c = 0; c < of.dims; ++c)
        of.gradient[i * of.dims + c] -= 2 / pairs * (of.points[i * of.dims + c] - of.points[j * of.dims + c]);
    }
  }
  sums[0][threadIdx.x] = total;
  add_threads(sums, 1);
  if (threadIdx.x == 0) of.value[0] = 0.5 * sums[0][0] / pairs;
}

}  // namespace perception
