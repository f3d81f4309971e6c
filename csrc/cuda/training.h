// Adam, and (1 - beta) L1 + beta (1 - SSIM) with its gradient: what would be hundreds of small operations a step.
// training/kernels/photometric.h derives the gradient. The structs are filled in by rasterizer/cuda/training.py.
#pragma once
#include "device.h"
#include "prepare.h"

namespace perception {

// A tensor of `rows` rows of `width` numbers. shares: of `rate`, one a column, or null for 1. visible: null for all rows.
// root: 1 / sqrt(1 - beta2^step); the rate is divided by 1 - beta1^step. skipped: rows that are not finite, added up.
struct AdamRows {
  Results param, first, second;
  Reals grad, shares;
  GLOBAL(const unsigned char) visible;
  GLOBAL(int) skipped;
  int rows, width;
  T rate, beta1, beta2, eps, root;
};

// A thread a number. Rows that are not visible, or whose gradient is not finite, stay as they are.
extern "C" __global__ void __launch_bounds__(kThreads) adam_kernel(AdamRows a) {
  const Index at = static_cast<Index>(blockIdx.x) * kThreads + threadIdx.x;
  const Index row = at / a.width, begin = row * a.width;
  if (row >= a.rows || (a.visible && !a.visible[row])) return;
  if (!(finite_sum(a.grad + begin, a.width) == 0)) {
    if (at == begin) atomicAdd(a.skipped + 0, 1);
    return;
  }
  const T g = a.grad[at], first = a.beta1 * a.first[at] + (1 - a.beta1) * g;
  const T second = a.beta2 * a.second[at] + (1 - a.beta2) * g * g;
  a.first[at] = first, a.second[at] = second;
  a.param[at] -= a.rate * (a.shares ? a.shares[at - begin] : T(1)) * first / (sqrt(second) * a.root + a.eps);
}

constexpr int kRadius = 5, kPatch = kTile + 2 * kRadius;
constexpr double kC1 = 0.01 * 0.01, kC2 = 0.03 * 0.03;  // Wang et al. 2004, dynamic range 1

// Images [H,W,channels]. target, or bytes for 255 times it. weight [H,W], null for 1 everywhere; total: its sum times
// channels. slopes [3,H,W,channels]: of the loss with respect to the local means of x, x² + y² and x y.
// sums [blocks,3]: weighted |x - y|, SSIM and 1 - SSIM. window: SSIM's taps.
struct Photo {
  Reals render, target;
  GLOBAL(const unsigned char) bytes;
  Reals weight;
  GLOBAL(const double) total;
  Results slopes, gradient;
  GLOBAL(double) sums;
  int width, height, channels, tiles_x;
  T beta, window[2 * kRadius + 1];
};

// The block's tile, and this thread's pixel in it.
struct Spot {
  int x0, y0, column, row;
  bool inside;
  Index pixel;
};

static __device__ inline Spot spot_of(const Photo &photo) {
  Spot s;
  s.x0 = blockIdx.x % photo.tiles_x * kTile, s.y0 = blockIdx.x / photo.tiles_x * kTile;
  s.column = threadIdx.x % kTile, s.row = threadIdx.x / kTile;
  const int x = s.x0 + s.column, y = s.y0 + s.row;
  s.inside = x < photo.width && y < photo.height;
  s.pixel = static_cast<Index>(y) * photo.width + x;
  return s;
}

static __device__ inline T target_at(const Photo &photo, Index i) {
  return photo.bytes ? photo.bytes[i] / T(255) : photo.target[i];
}

// Weight of a pixel in the mean.
static __device__ inline T share_at(const Photo &photo, Index pixel) {
  return (photo.weight ? photo.weight[pixel] : T(1)) / T(photo.total[0]);
}

// Index in the image of element i of the tile's patch, in one channel; -1 outside, where images are zero.
static __device__ inline Index patch_index(const Photo &photo, const Spot &s, int i, int channel) {
  const int x = s.x0 - kRadius + i % kPatch, y = s.y0 - kRadius + i / kPatch;
  if (x < 0 || y < 0 || x >= photo.width || y >= photo.height) return -1;
  return (static_cast<Index>(y) * photo.width + x) * photo.channels + channel;
}

// A thread a pixel: moments under the window, first sideways, then down; from them the sums and the slopes.
extern "C" __global__ void __launch_bounds__(kThreads) ssim_kernel(Photo photo) {
  __shared__ SHARED(T) xs[kPatch * kPatch];
  __shared__ SHARED(T) ys[kPatch * kPatch];
  __shared__ SHARED(T) rows[4][kPatch * kTile];
  __shared__ SHARED(double) parts[3][kThreads];
  const Spot s = spot_of(photo);
  const Index plane = static_cast<Index>(photo.width) * photo.height * photo.channels;
  double l1 = 0, alike = 0, unlike = 0;
  for (int channel = 0; channel < photo.channels; ++channel) {
    for (int i = threadIdx.x; i < kPatch * kPatch; i += kThreads) {
      const Index at = patch_index(photo, s, i, channel);
      xs[i] = at < 0 ? T(0) : photo.render[at];
      ys[i] = at < 0 ? T(0) : target_at(photo, at);
    }
    __syncthreads();
    for (int i = threadIdx.x; i < kPatch * kTile; i += kThreads) {
      T mx = 0, my = 0, square = 0, product = 0;
      for (int k = 0; k <= 2 * kRadius; ++k) {
        const int at = i / kTile * kPatch + i % kTile + k;
        const T w = photo.window[k], x = xs[at], y = ys[at];
        mx += w * x, my += w * y, square += w * (x * x + y * y), product += w * x * y;
      }
      rows[0][i] = mx, rows[1][i] = my, rows[2][i] = square, rows[3][i] = product;
    }
    __syncthreads();
    if (!s.inside) continue;
    T m[4] = {0, 0, 0, 0};
    for (int k = 0; k <= 2 * kRadius; ++k)
      for (int j = 0; j < 4; ++j) m[j] += photo.window[k] * rows[j][(s.row + k) * kTile + s.column];
    const Index at = s.pixel * photo.channels + channel;
    const T share = share_at(photo, s.pixel), mx = m[0], my = m[1], away = photo.render[at] - target_at(photo, at);
    const T a1 = 2 * mx * my + T(kC1), a2 = 2 * (m[3] - mx * my) + T(kC2);
    const T b1 = mx * mx + my * my + T(kC1), b2 = m[2] + T(kC1) + T(kC2) - b1;
    const T below = 1 / (b1 * b2), ssim = a1 * a2 * below;
    photo.slopes[at] = share * 2 * (my * (a2 - a1) * below - mx * ssim * (1 / b1 - 1 / b2));
    photo.slopes[plane + at] = -share * ssim / b2;
    photo.slopes[2 * plane + at] = 2 * share * a1 * below;
    l1 += share * (away < 0 ? -away : away), alike += share * ssim, unlike += share * (1 - ssim);
  }
  parts[0][threadIdx.x] = l1, parts[1][threadIdx.x] = alike, parts[2][threadIdx.x] = unlike;
  add_threads(parts, 3);
  if (threadIdx.x == 0)
    for (int j = 0; j < 3; ++j) photo.sums[3 * static_cast<Index>(blockIdx.x) + j] = parts[j][0];
}

// A thread a pixel: the slopes under the window give the gradient of SSIM.
extern "C" __global__ void __launch_bounds__(kThreads) photometric_kernel(Photo photo) {
  __shared__ SHARED(T) slopes[3][kPatch * kPatch];
  __shared__ SHARED(T) rows[3][kPatch * kTile];
  const Spot s = spot_of(photo);
  const Index plane = static_cast<Index>(photo.width) * photo.height * photo.channels;
  for (int channel = 0; channel < photo.channels; ++channel) {
    for (int i = threadIdx.x; i < kPatch * kPatch; i += kThreads) {
      const Index at = patch_index(photo, s, i, channel);
      for (int j = 0; j < 3; ++j) slopes[j][i] = at < 0 ? T(0) : photo.slopes[j * plane + at];
    }
    __syncthreads();
    for (int i = threadIdx.x; i < kPatch * kTile; i += kThreads)
      for (int j = 0; j < 3; ++j) {
        T sum = 0;
        for (int k = 0; k <= 2 * kRadius; ++k)
          sum += photo.window[k] * slopes[j][i / kTile * kPatch + i % kTile + k];
        rows[j][i] = sum;
      }
    __syncthreads();
    if (!s.inside) continue;
    T m[3] = {0, 0, 0};
    for (int k = 0; k <= 2 * kRadius; ++k)
      for (int j = 0; j < 3; ++j) m[j] += photo.window[k] * rows[j][(s.row + k) * kTile + s.column];
    const Index at = s.pixel * photo.channels + channel;
    const T x = photo.render[at], y = target_at(photo, at), sign = T(x > y) - T(x < y);
    photo.gradient[at] =
        (1 - photo.beta) * sign * share_at(photo, s.pixel) - photo.beta * (m[0] + 2 * x * m[1] + y * m[2]);
  }
}

}  // namespace perception
