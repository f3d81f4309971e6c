// Gaussians to splats, and the list of the tiles that each of them touches.
#pragma once
#include "device.h"

namespace perception {

// 0 if all are finite, else NaN.
template <class Values>
static __device__ inline T finite_sum(Values values, Index n) {
  T sum = 0;
  for (Index i = 0; i < n; ++i) sum += values[i] * T(0);
  return sum;
}

// The tiles whose pixel centres an ellipse of alpha >= 1/255 may reach; false if none.
static __device__ inline bool splat_box(const Scene &scene, const Splat &s, const Projected<T> &p, Box &box) {
  const T q = clamped(s.log_opacity - kLogThreshold<T>, T(0), T(100)) * (2 / kLog2E<T>);
  const T lx = sqrt(q * p.cov_xx) * T(1.0001) + T(2e-3), ly = sqrt(q * p.var_y) * T(1.0001) + T(2e-3);
  const T right = scene.width - T(0.5), bottom = scene.height - T(0.5);
  // Written so that NaN (an overflow of the projection) fails.
  if (!(s.x + lx >= T(0.5) && s.x - lx <= right && s.y + ly >= T(0.5) && s.y - ly <= bottom)) return false;
  box.x0 = static_cast<int>(clamped(s.x - lx - T(0.5), T(0), right)) / kTile;
  box.x1 = static_cast<int>(clamped(s.x + lx - T(0.5), T(0), right)) / kTile;
  box.y0 = static_cast<int>(clamped(s.y - ly - T(0.5), T(0), bottom)) / kTile;
  box.y1 = static_cast<int>(clamped(s.y + ly - T(0.5), T(0), bottom)) / kTile;
  return true;
}

static __device__ inline void set_color(const Scene &scene, const Camera<T> &cam, Index i, T *rgb) {
  if (scene.sh_degree < 0) {
    for (int c = 0; c < 3; ++c) rgb[c] = scene.colors[3 * i + c];
  } else {
    T v[3];
    view_vector<T>(cam, scene.means + 3 * i, v);
    sh_color<T>(scene.sh_degree, v, scene.colors + 3 * i * scene.sh_stride, rgb);
  }
}

// A thread a Gaussian. scene.features: all `dims` channels.
extern "C" __global__ void __launch_bounds__(kThreads) project_kernel(Scene scene, Projection out) {
  const Index i = static_cast<Index>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= scene.n) return;
  out.boxes[i] = {0, 0, -1, -1};
  const Reals m = scene.means + 3 * i, q = scene.quats + 4 * i, scales = scene.scales + 3 * i;
  const T opacity = scene.opacities[i];
  const int color_width = scene.sh_degree < 0 ? 3 : 3 * scene.sh_stride;
  const T sum = finite_sum(m, 3) + finite_sum(q, 4) + finite_sum(scales, 3) + finite_sum(&opacity, 1) +
                finite_sum(scene.colors + i * color_width, color_width) +
                finite_sum(scene.features + i * scene.dims, scene.dims);
  if (!(sum == 0)) {
    atomicMin(out.first_bad, static_cast<int>(i));
    return;
  }
  if (i == 0 && !(finite_sum(scene.viewmat, 16) + finite_sum(scene.K, 9) +
                      finite_sum(scene.background, scene.background ? 3 : 0) ==
                  0))
    atomicMin(out.first_bad, -1);
  const Camera<T> cam =
      make_camera<T>(scene.viewmat, scene.K, scene.width, scene.height, scene.near_plane, scene.eps2d);
  const Projected<T> p = project<T>(cam, m, q, scales);
  if (!(p.z > cam.near_plane && opacity >= T(1) / 255 && p.var_x - p.var_x == 0)) return;
  Splat s;
  s.x = p.x, s.y = p.y, s.z = p.z;
  s.a = T(-0.5) * kLog2E<T> / p.var_x, s.k = p.k, s.d = T(-0.5) * kLog2E<T> / p.var_y;
  s.log_opacity = log2(opacity);
  s.reach = s.log_opacity - kLogThreshold<T> + T(2e-3);
  s.slope = p.cov_xy / p.cov_xx;
  Box box;
  if (!splat_box(scene, s, p, box)) return;
  set_color(scene, cam, i, s.rgb);
  const T half = T(0.5) * (p.cov_xx - p.var_y);
  out.radii[i] = 3 * sqrt(T(0.5) * (p.cov_xx + p.var_y) + sqrt(half * half + p.cov_xy * p.cov_xy));
  out.splats[i] = s, out.boxes[i] = box, out.depths[i] = s.z;
}

// A splat's tiles within the strip, in row-major order.
struct TileBox {
  int x0, y0, width, count;
};

static __device__ inline TileBox tiles_of(const Strip &strip, int id) {
  const Box b = strip.boxes[id];
  const int y0 = higher(b.y0, strip.first_row), height = higher(lower(b.y1, strip.end_row - 1) - y0 + 1, 0);
  return {b.x0, y0, b.x1 - b.x0 + 1, (b.x1 - b.x0 + 1) * height};
}

// The number of tile k of the box within the strip, or -1 if the splat does not touch it.
static __device__ inline int touched_tile(const Strip &strip, const Splat &s, const TileBox &box, int k) {
  const int x = box.x0 + k % box.width, y = box.y0 + k / box.width;
  if (!touches(s, x * kTile + T(0.5), y * kTile + T(0.5), kTile - 1, kTile - 1)) return -1;
  return (y - strip.first_row) * strip.tiles_x + x;
}

// Visits the tiles that Gaussian `id` (-1: none) touches, the whole warp those of Gaussians with many. Returns how many
// there are; where `tiles` is given they are written from `slot` on.
static __device__ inline int list_tiles(const Strip &strip, int id, Index slot, GLOBAL(int) tiles, GLOBAL(int) ids) {
  const int lane = threadIdx.x % kWarp;
  const TileBox own = id < 0 ? TileBox{0, 0, 0, 0} : tiles_of(strip, id);
  int found = 0;
  if (own.count > 0 && own.count <= kWide) {
    const Splat s = strip.splats[id];
    for (int k = 0; k < own.count; ++k) {
      const int tile = touched_tile(strip, s, own, k);
      if (tile < 0) continue;
      if (tiles) tiles[slot + found] = tile, ids[slot + found] = id;
      ++found;
    }
  }
  for (unsigned wide = __ballot_sync(kAllLanes, own.count > kWide); wide; wide &= wide - 1) {
    const int owner = __ffs(wide) - 1, other = __shfl_sync(kAllLanes, id, owner);
    const Index begin = __shfl_sync(kAllLanes, slot, owner);
    const TileBox box = tiles_of(strip, other);
    const Splat s = strip.splats[other];
    int before = 0;
    for (int first = 0; first < box.count; first += kWarp) {
      const int k = first + lane, tile = k < box.count ? touched_tile(strip, s, box, k) : -1;
      const unsigned hits = __ballot_sync(kAllLanes, tile >= 0);
      const Index at = begin + before + __popc(hits & ((1u << lane) - 1));
      if (tiles && tile >= 0) tiles[at] = tile, ids[at] = other;
      before += __popc(hits);
    }
    if (lane == owner) found = before;
  }
  return found;
}

// A thread a Gaussian, by depth: how many tiles of the strip it touches.
extern "C" __global__ void __launch_bounds__(kThreads) count_kernel(Strip strip, GLOBAL(int) counts) {
  const Index rank = static_cast<Index>(blockIdx.x) * kThreads + threadIdx.x;
  const int found = list_tiles(strip, rank < strip.n ? strip.front_to_back[rank] : -1, 0, nullptr, nullptr);
  if (rank < strip.n) counts[rank] = found;
}

// Which tiles these are, and whose.
extern "C" __global__ void __launch_bounds__(kThreads) emit_kernel(Strip strip, GLOBAL(int) tiles, GLOBAL(int) ids) {
  const Index rank = static_cast<Index>(blockIdx.x) * kThreads + threadIdx.x;
  const bool some = rank < strip.n;
  list_tiles(strip, some ? strip.front_to_back[rank] : -1, some && rank ? strip.ends[rank - 1] : 0, tiles, ids);
}

}  // namespace perception
