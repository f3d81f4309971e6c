// The backward pass over the pixels: a lane a pixel for the weights, then a lane a Gaussian for the sums. The formulas
// and symbols (alpha, w, T, T', T_final, cg, R, k, h, S, g, v, c, e) are those of rasterizer/backward.cpp.
#pragma once
#include "device.h"

namespace perception {

constexpr int kGroup = 8;                           // splats of the tile worked on at a time
constexpr int kParts = kWarp / kGroup;              // lanes that share a splat's sums
constexpr int kPixels = kWarp / kParts;             // pixels that each of them adds up
constexpr int kPitch = kWarp + 1;                   // so that lanes of all splats and parts read from different banks
constexpr int kChannels = 4 + NF * (1 + VARIANCE);  // red, green, blue, depth, e, e²
constexpr int kSums = 8 + kChannels;  // of h, h u, h dy, h u², h u dy, h dy², |h u|, |h dy|, then w times each channel
static_assert(kSums <= 2 * kPitch, "a splat's sums must fit where its weights stood");

struct WarpMemory {
  SHARED(T) cotangent[kChannels][kWarp];  // a row of pixels a channel
  SHARED(T) values[2 * kGroup * kPitch];  // of each splat at each pixel w, then h; later the sums [kGroup][kSums]
  SHARED(unsigned) touched;               // bit j: splat j adds to some pixel of the granule
};

static __device__ inline int weight_at(int splat, int pixel) { return splat * kPitch + pixel; }
static __device__ inline int moment_at(int splat, int pixel) { return (kGroup + splat) * kPitch + pixel; }

// Writes the pixel's cotangents to its column and returns R - k T_final before the first splat, where R is over all.
// shift: c.
static __device__ inline T load_cotangents(const Scene &scene, const Images &images, const Cotangents &grad,
                                           const Pixel &p, const SHARED(T) * shift, WarpMemory &memory) {
  for (int c = 0; c < kChannels; ++c) memory.cotangent[c][p.lane] = 0;
  if (!p.inside) return 0;
  const T alpha = images.alphas[p.at], final = 1 - alpha;
  T behind = 0, constant = grad.alphas ? grad.alphas[p.at] : T(0);
  if (grad.colors)
    for (int c = 0; c < 3; ++c) {
      const T g = grad.colors[3 * p.at + c], background = scene.background ? scene.background[c] : T(0);
      memory.cotangent[c][p.lane] = g;
      behind += g * (images.colors[3 * p.at + c] - final * background);
      constant -= g * background;
    }
  if (DEPTH && grad.depths) {
    memory.cotangent[3][p.lane] = grad.depths[p.at];
    behind += grad.depths[p.at] * images.depths[p.at];
  }
  for (int c = 0; c < NF; ++c) {
    const Index at = p.at * scene.dims + c;
    const T s = shift[c], sum = images.features[at], e = sum - s * alpha;
    T g = grad.features ? grad.features[at] : T(0);
    behind += g * e, constant += g * s;
    if (VARIANCE) {
      const T v = grad.variance ? grad.variance[at] : T(0), twice = 2 * v * (sum - s);
      const T square = images.variance[at] + e * e - final * s * (s * alpha + 2 * e);  // Σ w e²
      g -= twice;
      behind += v * square - twice * e;
      constant += v * s * (s - 2 * sum);
      memory.cotangent[4 + NF + c][p.lane] = v;
    }
    memory.cotangent[4 + c][p.lane] = g;
  }
  return behind - constant * final;
}

// cg of a splat at this lane's pixel.
static __device__ inline T weigh(const Splat &s, const SHARED(T) * features, const WarpMemory &memory, int lane) {
  T cg = 0;
  for (int c = 0; c < 3; ++c) cg += memory.cotangent[c][lane] * s.rgb[c];
  if (DEPTH) cg += memory.cotangent[3][lane] * s.z;
  for (int c = 0; c < NF; ++c) {
    const T e = features[c];
    T g = memory.cotangent[4 + c][lane];
    if (VARIANCE) g += memory.cotangent[4 + NF + c][lane] * e;
    cg += g * e;
  }
  return cg;
}

// The sums of splat `lane % kGroup` over the granule (kSums, with u = dx + k dy), in a fixed order; all lanes of the
// splat return them.
static __device__ inline void sum_pixels(const Splat &s, bool touched, const Pixel &p, const WarpMemory &memory,
                                         T *sums) {
  const int j = p.lane % kGroup, first = p.lane / kGroup * kPixels;
  for (int c = 0; c < kSums; ++c) sums[c] = 0;
  if (touched)
    for (int i = first; i < first + kPixels; ++i) {
      const T h = memory.values[moment_at(j, i)], w = memory.values[weight_at(j, i)];
      const T dy = s.y - (p.granule_y + i / kGranuleWidth);
      const T u = fma(s.k, dy, s.x - (p.granule_x + i % kGranuleWidth)), hu = h * u, hy = h * dy;
      sums[0] += h, sums[1] += hu, sums[2] += hy, sums[3] += hu * u, sums[4] += hu * dy, sums[5] += hy * dy;
      sums[6] += magnitude(hu), sums[7] += magnitude(hy);
      for (int c = 0; c < kChannels; ++c) sums[8 + c] += w * memory.cotangent[c][i];
    }
  for (int c = 0; c < kSums; ++c)
    for (int step = kGroup; step < kWarp; step *= 2) sums[c] += __shfl_xor_sync(kAllLanes, sums[c], step);
}

// Number c of splat j's record, summed over the warps in their order; false if no warp saw the splat.
static __device__ inline bool sum_warps(const WarpMemory *warps, int j, int c, const SHARED(T) * features, T &value) {
  T squares = 0;
  bool any = false;
  value = 0;
  for (int i = 0; i < kWarps; ++i) {
    if (!(warps[i].touched >> j & 1)) continue;
    const SHARED(T) *sums = warps[i].values + j * kSums;
    value += sums[c];
    if (VARIANCE && c >= kMoments) squares += sums[c + NF];
    any = true;
  }
  if (VARIANCE && c >= kMoments) value += 2 * features[c - kMoments] * squares;  // de²/df = 2 e
  return any;
}

// records [slots, kRecord], zero on entry: a splat's sums over one tile, of h, h u, h dy, h u², h u dy, h dy², |h u|,
// |h dy|, w g_rgb, w g_z and w times the gradient with respect to each feature.
extern "C" __global__ void __launch_bounds__(kThreads)
    backward_kernel(Scene scene, Strip strip, Lists lists, Images images, Cotangents grad, Results records) {
  __shared__ WarpMemory warps[kWarps];
  __shared__ SHARED(T) splats[kGroup][kSplat];
  __shared__ SHARED(T) features[kGroup][kFeatures];  // less the shift
  __shared__ SHARED(T) shift[kFeatures];
  const Pixel p = pixel_of(scene, strip);
  const Index begin = lists.starts[blockIdx.x], end = lists.starts[blockIdx.x + 1];
  if (begin == end) return;
  if (threadIdx.x < NF)
    shift[threadIdx.x] = scene.features[static_cast<Index>(lists.ids[begin]) * scene.dims + threadIdx.x];
  __syncthreads();
  WarpMemory &memory = warps[p.warp];
  T behind = load_cotangents(scene, images, grad, p, shift, memory), transmittance = 1;
  bool open = p.inside;
  for (Index at = begin; at < end; at += kGroup) {
    if (!__syncthreads_or(open)) break;  // also: the last group's sums have been read
    const int n = end - at < kGroup ? static_cast<int>(end - at) : kGroup;
    for (int i = threadIdx.x; i < n * kSplat; i += kThreads)
      splats[i / kSplat][i % kSplat] = splat_number(strip, lists.ids[at + i / kSplat], i % kSplat);
    for (int i = threadIdx.x; i < n * NF; i += kThreads)
      features[i / kFeatures][i % kFeatures] =
          scene.features[static_cast<Index>(lists.ids[at + i / kFeatures]) * scene.dims + i % kFeatures] -
          shift[i % kFeatures];
    __syncthreads();
    const bool near = __any_sync(kAllLanes, open) && p.lane < n && touches_granule(read_splat(splats[p.lane]), p);
    unsigned touched = 0;
    for (unsigned left = __ballot_sync(kAllLanes, near); left; left &= left - 1) {
      const int j = __ffs(left) - 1;
      const Splat s = read_splat(splats[j]);
      Blend b;
      const bool adds = blend(s, p, transmittance, open, b);
      T weight = 0, h = 0;
      if (adds) {
        const T cg = weigh(s, features[j], memory, p.lane);
        weight = b.weight, transmittance = b.next;
        behind -= weight * cg;
        h = b.raw > kMaxAlpha<T> ? T(0) : weight * (cg - fast_ratio(behind, b.next));  // a clamped alpha does not move
      }
      memory.values[weight_at(j, p.lane)] = weight, memory.values[moment_at(j, p.lane)] = h;
      if (__any_sync(kAllLanes, adds)) touched |= 1u << j;
    }
    if (touched) {
      const int j = p.lane % kGroup;
      const bool mine = touched >> j & 1;
      T sums[kSums];
      __syncwarp();
      sum_pixels(mine ? read_splat(splats[j]) : Splat{}, mine, p, memory, sums);
      __syncwarp();
      if (mine && p.lane < kGroup)
        for (int c = 0; c < kSums; ++c) memory.values[j * kSums + c] = sums[c];
    }
    if (p.lane == 0) memory.touched = touched;
    __syncthreads();
    for (int i = threadIdx.x; i < n * kRecord; i += kThreads) {
      T value;
      if (sum_warps(warps, i / kRecord, i % kRecord, features[i / kRecord], value))
        records[lists.slots[at + i / kRecord] * kRecord + i % kRecord] = value;
    }
  }
}

}  // namespace perception
