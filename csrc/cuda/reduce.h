// Sums every Gaussian's records in a fixed order and takes the gradient from the picture plane back to its own
// parameters and the camera.
#pragma once
#include "device.h"

namespace perception {

static __device__ inline void add_records(Reals records, Index begin, Index end, Index step, T *sum) {
  for (int c = 0; c < kRecord; ++c) sum[c] = 0;
  for (Index slot = begin; slot < end; slot += step)
    for (int c = 0; c < kRecord; ++c) sum[c] += records[slot * kRecord + c];
}

// Sum of the records [begin, end), in an order that depends on their number alone.
static __device__ inline void sum_records(Reals records, Index begin, Index end, T *sum) {
  const int lane = threadIdx.x % kWarp;
  const bool wide = end - begin > kWide;
  add_records(records, begin, wide ? begin : end, 1, sum);
  for (unsigned left = __ballot_sync(kAllLanes, wide); left; left &= left - 1) {
    const int owner = __ffs(left) - 1;
    const Index first = __shfl_sync(kAllLanes, begin, owner), last = __shfl_sync(kAllLanes, end, owner);
    T part[kRecord];
    add_records(records, first + lane, last, kWarp, part);
    for (int c = 0; c < kRecord; ++c) {
      for (int step = 1; step < kWarp; step *= 2) part[c] += __shfl_xor_sync(kAllLanes, part[c], step);
      if (lane == owner) sum[c] = part[c];
    }
  }
}

// From a record's moments to cotangents of the projection; rasterizer/reduce.cpp has the formulas.
static __device__ inline ProjectedGrad<T> picture_gradient(const Splat &s, const T *r) {
  const T precision_x = s.a * (-2 / kLog2E<T>), precision_y = s.d * (-2 / kLog2E<T>);  // 1/var_x, 1/var_y
  const T gu = -r[1] * precision_x;
  ProjectedGrad<T> g;
  g.x = gu, g.y = s.k * gu - r[2] * precision_y, g.z = r[11];
  factored_vjp(T(0.5) * r[3] * precision_x * precision_x, -r[4] * precision_x,
               T(0.5) * r[5] * precision_y * precision_y, s.k, 1 / precision_y, g);
  return g;
}

static __device__ inline void add(Results out, Index row, const T *values, int n, bool fresh) {
  if (out)
    for (int c = 0; c < n; ++c) out[row * n + c] = (fresh ? T(0) : out[row * n + c]) + values[c];
}

// Colours, or harmonics and the direction they are seen from (which moves the mean and the camera).
static __device__ inline void color_gradient(const Scene &scene, const Camera<T> &cam, Index i, const Splat &s,
                                             const T *g_rgb, Results out, bool fresh, T *g_mean, T *g_R, T *g_t) {
  if (scene.sh_degree < 0) return add(out, i, g_rgb, 3, fresh);
  T v[3], gv[3], gated[3];
  for (int c = 0; c < 3; ++c) gated[c] = s.rgb[c] > 0 ? g_rgb[c] : T(0);
  view_vector<T>(cam, scene.means + 3 * i, v);
  const Index row = 3 * i * scene.sh_stride;
  T *written = out ? static_cast<T *>(out + row) : nullptr;
  if (out && fresh)
    for (int c = 0; c < 3 * scene.sh_stride; ++c) out[row + c] = 0;
  sh_color_vjp<T>(scene.sh_degree, v, scene.colors + row, gated, written, gv);
  for (int c = 0; c < 3; ++c) {  // v = mean + Rᵀ t
    g_mean[c] += gv[c];
    for (int k = 0; k < 3; ++k) g_R[3 * k + c] += cam.t[k] * gv[c], g_t[k] += cam.R[3 * k + c] * gv[c];
  }
}

// A thread a Gaussian, by depth: its records, then back to its own parameters and the camera. visible [N].
extern "C" __global__ void __launch_bounds__(kThreads)
    reduce_kernel(Scene scene, Strip strip, GLOBAL(const unsigned char) visible, Reals records, Gradients out) {
  const Index rank = static_cast<Index>(blockIdx.x) * kThreads + threadIdx.x;
  const Index i = rank < strip.n ? strip.front_to_back[rank] : 0;
  const bool seen = rank < strip.n && visible[i];
  const Index begin = seen && rank ? strip.ends[rank - 1] : 0, end = seen ? strip.ends[rank] : 0;
  T r[kRecord];
  sum_records(records, begin, end, r);
  if (begin == end) return;
  const Camera<T> cam =
      make_camera<T>(scene.viewmat, scene.K, scene.width, scene.height, scene.near_plane, scene.eps2d);
  const Splat s = strip.splats[i];
  const ProjectedGrad<T> g = picture_gradient(s, r);
  T g_mean[3], g_quat[4], g_scale[3], g_camera[12];  // dL/dR, dL/dt
  project_vjp<T>(cam, scene.means + 3 * i, scene.quats + 4 * i, scene.scales + 3 * i, g, g_mean, g_quat, g_scale,
                 g_camera, g_camera + 9);
  color_gradient(scene, cam, i, s, r + 8, out.colors, out.fresh, g_mean, g_camera, g_camera + 9);
  const T opacity = scene.opacities[i], g_mean2d[2] = {g.x, g.y};
  const T g_opacity = out.stored ? r[0] * (1 - opacity) : r[0] / opacity;
  if (out.stored)
    for (int c = 0; c < 3; ++c) g_scale[c] *= scene.scales[3 * i + c];
  const T size_x = r[6] * s.a * (-2 / kLog2E<T>), size_y = magnitude(s.k) * size_x + r[7] * s.d * (-2 / kLog2E<T>);
  const T absolute[2] = {size_x, size_y};  // see absolute_gradient of rasterizer/reduce.cpp
  const bool fresh = out.fresh;
  add(out.means, i, g_mean, 3, fresh), add(out.quats, i, g_quat, 4, fresh), add(out.scales, i, g_scale, 3, fresh);
  add(out.opacities, i, &g_opacity, 1, fresh), add(out.camera, i, g_camera, 12, fresh);
  add(out.mean2d, i, g_mean2d, 2, fresh), add(out.absgrad, i, absolute, 2, fresh);
  if (out.features)
    for (int c = 0; c < NF; ++c) {
      const Index at = i * scene.dims + c;
      out.features[at] = (out.fresh_features ? T(0) : out.features[at]) + r[kMoments + c];
    }
}

}  // namespace perception
