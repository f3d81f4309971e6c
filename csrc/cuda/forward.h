// Front-to-back blending: a block a tile, a warp a granule, a thread a pixel.
#pragma once
#include "device.h"

namespace perception {

constexpr int kBatch = 64;  // splats of the tile in shared memory at a time

// Weighted mean of a pixel's features and their second moment about it, one splat at a time: nothing cancels (West
// 1979). With A the accumulated alpha, Σ w f = A mean and Var = Σ w f² - (Σ w f)² = M2 + A (1 - A) mean².
struct FeatureMoments {
  T total, mean[kFeatures], m2[kFeatures];
};

static __device__ inline void add_features(const SHARED(T) * features, T weight, FeatureMoments &f) {
  f.total += weight;
  const T share = fast_ratio(weight, f.total);
  for (int c = 0; c < NF; ++c) {
    const T value = features[c], away = value - f.mean[c];
    f.mean[c] += share * away;
    if (VARIANCE) f.m2[c] += weight * away * (value - f.mean[c]);
  }
}

static __device__ inline void write_pixel(const Scene &scene, const Images &out, Index at, T transmittance,
                                          const T *color, T depth, const FeatureMoments &f) {
  if (out.colors)
    for (int c = 0; c < 3; ++c)
      out.colors[3 * at + c] = color[c] + (scene.background ? transmittance * scene.background[c] : T(0));
  if (out.alphas) out.alphas[at] = 1 - transmittance;
  if (DEPTH && out.depths) out.depths[at] = depth;
  for (int c = 0; c < NF; ++c) {
    out.features[at * scene.dims + c] = f.total * f.mean[c];
    if (VARIANCE) out.variance[at * scene.dims + c] = f.m2[c] + f.total * transmittance * f.mean[c] * f.mean[c];
  }
}

extern "C" __global__ void __launch_bounds__(kThreads)
    forward_kernel(Scene scene, Strip strip, Lists lists, Images out) {
  __shared__ SHARED(T) splats[kBatch][kSplat];
  __shared__ SHARED(T) features[kBatch][kFeatures];
  const Pixel p = pixel_of(scene, strip);
  const Index begin = lists.starts[blockIdx.x], end = lists.starts[blockIdx.x + 1];
  bool open = p.inside;
  T transmittance = 1, color[3] = {0, 0, 0}, depth = 0;
  FeatureMoments f;
  f.total = 0;
  for (int c = 0; c < kFeatures; ++c) f.mean[c] = f.m2[c] = 0;
  for (Index at = begin; at < end; at += kBatch) {
    if (!__syncthreads_or(open)) break;  // also: the last batch has been read
    const int n = end - at < kBatch ? static_cast<int>(end - at) : kBatch;
    for (int i = threadIdx.x; i < n * kSplat; i += kThreads)
      splats[i / kSplat][i % kSplat] = splat_number(strip, lists.ids[at + i / kSplat], i % kSplat);
    for (int i = threadIdx.x; i < n * NF; i += kThreads)
      features[i / kFeatures][i % kFeatures] =
          scene.features[static_cast<Index>(lists.ids[at + i / kFeatures]) * scene.dims + i % kFeatures];
    __syncthreads();
    for (int first = 0; first < n; first += kWarp) {
      if (!__any_sync(kAllLanes, open)) break;
      const int mine = first + p.lane;
      const bool near = mine < n && touches_granule(read_splat(splats[mine]), p);
      for (unsigned left = __ballot_sync(kAllLanes, near); left; left &= left - 1) {
        const int j = first + __ffs(left) - 1;
        const Splat s = read_splat(splats[j]);
        Blend b;
        if (!blend(s, p, transmittance, open, b)) continue;
        transmittance = b.next;
        for (int c = 0; c < 3; ++c) color[c] += b.weight * s.rgb[c];
        depth += b.weight * s.z;
        if (NF) add_features(features[j], b.weight, f);
        if (out.visible) out.visible[lists.ids[at + j]] = 1;
      }
    }
  }
  if (p.inside) write_pixel(scene, out, p.at, transmittance, color, depth, f);
}

}  // namespace perception
