// Stage 1: projects all Gaussians, drops those no pixel can see, keeps the rest in order of their index.
#include <limits>

#include "constants.h"
#include "kernels.h"
#include "simd.h"
#include "spherical_harmonics.h"

namespace perception::PERCEPTION_LEVEL {
namespace {

template <class T>
inline T clamp(T x, T low, T high) {
  return x < low ? low : x > high ? high : x;
}

template <class T>
struct ProjectionBlock {
  alignas(64) T in[11][kBlock];
  alignas(64) T x[kBlock], y[kBlock], z[kBlock], var_x[kBlock], k[kBlock], var_y[kBlock], cov_xx[kBlock],
      cov_xy[kBlock], finite[kBlock];
  alignas(64) T log_opacity[kBlock], a[kBlock], d[kBlock], reach[kBlock], slope[kBlock], radius[kBlock];
  alignas(64) int32_t seen[kBlock], x0[kBlock], y0[kBlock], x1[kBlock], y1[kBlock];  // 64-pixel tiles, where seen
};

template <class T>
void load_block(const Inputs<T> &in, int64_t i0, int n, ProjectionBlock<T> &b) {
  for (int j = 0; j < n; ++j)
    for (int c = 0; c < 3; ++c) b.in[c][j] = in.means[3 * (i0 + j) + c];
  for (int j = 0; j < n; ++j)
    for (int c = 0; c < 4; ++c) b.in[3 + c][j] = in.quats[4 * (i0 + j) + c];
  for (int j = 0; j < n; ++j)
    for (int c = 0; c < 3; ++c) b.in[7 + c][j] = in.scales[3 * (i0 + j) + c];
  for (int j = 0; j < n; ++j) b.in[10][j] = in.opacities[i0 + j];
  for (auto &row : b.in)
    for (int j = n; j < kBlock; ++j) row[j] = 0;
}

template <class T>
void project_block(const Camera<T> &camera, ProjectionBlock<T> &b) {
  const Camera<T> cam = camera;
#pragma GCC ivdep
  for (int j = 0; j < kBlock; ++j) {
    const T m[3] = {b.in[0][j], b.in[1][j], b.in[2][j]}, q[4] = {b.in[3][j], b.in[4][j], b.in[5][j], b.in[6][j]},
            s[3] = {b.in[7][j], b.in[8][j], b.in[9][j]};
    const Projected<T> p = project(cam, m, q, s);
    b.x[j] = p.x, b.y[j] = p.y, b.z[j] = p.z, b.var_x[j] = p.var_x, b.k[j] = p.k, b.var_y[j] = p.var_y;
    b.cov_xx[j] = p.cov_xx, b.cov_xy[j] = p.cov_xy;
    T sum = 0;  // stays 0 unless a parameter is NaN or infinite
    for (int c = 0; c < 11; ++c) sum += b.in[c][j] * T(0);
    b.finite[j] = sum;
  }
}

template <class T>
T radius(T cov_xx, T cov_xy, T cov_yy) {
  const T half = T(0.5) * (cov_xx - cov_yy);
  return 3 * std::sqrt(T(0.5) * (cov_xx + cov_yy) + std::sqrt(half * half + cov_xy * cov_xy));
}

// Which Gaussians can give some pixel centre 1/255, and which tiles these touch.
template <class T>
void bound_block(const Camera<T> &camera, int n, ProjectionBlock<T> &b) {
  const Camera<T> cam = camera;
  for (int j = 0; j < kBlock; ++j) {
    b.seen[j] = j < n && b.z[j] > cam.near_plane && b.in[10][j] >= T(1) / 255;
    b.log_opacity[j] = b.seen[j] ? std::log2(b.in[10][j]) : T(0);
  }
  const T right = cam.width - T(0.5), bottom = cam.height - T(0.5);
#pragma GCC ivdep
  for (int j = 0; j < kBlock; ++j) {
    const T x = b.x[j], y = b.y[j], reach = b.log_opacity[j] - kLogThreshold<T>;
    const T q = clamp(reach, T(0), T(100)) * (2 / kLog2E<T>);
    const T lx = std::sqrt(q * b.cov_xx[j]) * T(1.0001) + T(2e-3), ly = std::sqrt(q * b.var_y[j]) * T(1.0001) + T(2e-3);
    // Written so that NaN (an overflow of the projection) fails.
    const bool inside = (x + lx >= T(0.5)) & (x - lx <= right) & (y + ly >= T(0.5)) & (y - ly <= bottom) &
                        (b.var_x[j] <= std::numeric_limits<T>::max());
    b.seen[j] &= inside;
    auto tile = [inside](T pixel, T last) {
      return static_cast<int32_t>(inside ? clamp(pixel - T(0.5), T(0), last) : T(0)) >> 6;
    };
    b.x0[j] = tile(x - lx, right), b.x1[j] = tile(x + lx, right);
    b.y0[j] = tile(y - ly, bottom), b.y1[j] = tile(y + ly, bottom);
    b.a[j] = T(-0.5) * kLog2E<T> / b.var_x[j], b.d[j] = T(-0.5) * kLog2E<T> / b.var_y[j];
    b.reach[j] = reach + T(2e-3);
    b.slope[j] = b.cov_xy[j] / b.cov_xx[j];
    b.radius[j] = radius(b.cov_xx[j], b.cov_xy[j], b.var_y[j]);
  }
}

template <class T>
void fill_splat(const ProjectionBlock<T> &b, int j, Splat<T> &s) {
  s.x = b.x[j], s.y = b.y[j], s.z = b.z[j];
  s.a = b.a[j], s.k = b.k[j], s.d = b.d[j], s.log_opacity = b.log_opacity[j];
  s.reach = b.reach[j], s.slope = b.slope[j];
  s.x0 = static_cast<uint16_t>(b.x0[j]), s.x1 = static_cast<uint16_t>(b.x1[j]);
  s.y0 = static_cast<uint16_t>(b.y0[j]), s.y1 = static_cast<uint16_t>(b.y1[j]);
}

template <class T>
void set_color(const Inputs<T> &in, const Camera<T> &cam, int64_t i, Splat<T> &s) {
  T rgb[3], v[3];
  if (in.sh_degree < 0) {
    for (int c = 0; c < 3; ++c) rgb[c] = in.colors[3 * i + c];
  } else {
    view_vector(cam, in.means + 3 * i, v);
    sh_color(in.sh_degree, v, in.colors + 3 * i * in.sh_stride, rgb);
  }
  s.r = rgb[0], s.g = rgb[1], s.b = rgb[2];
}

inline uint32_t depth_key(float z) {
  uint32_t k;
  std::memcpy(&k, &z, 4);
  return k;
}
inline uint64_t depth_key(double z) {
  uint64_t k;
  std::memcpy(&k, &z, 8);
  return k;
}

// NaN and infinity times zero are NaN, which no later addition undoes.
template <class T>
bool all_finite(const T *values, int64_t n) {
  using V = Vec<T>;
  const V zero(T(0));
  V acc[2] = {zero, zero};
  int64_t i = 0;
  for (; i + 2 * V::kLanes <= n; i += 2 * V::kLanes)
    for (int k = 0; k < 2; ++k) acc[k] = fma(V::load(values + i + k * V::kLanes), zero, acc[k]);
  T rest = sum(acc[0] + acc[1]);
  for (; i < n; ++i) rest += values[i] * T(0);
  return rest == 0;
}

// Colours and features of Gaussians [i0, i0 + n).
template <class T>
bool attributes_finite(const Inputs<T> &in, int64_t i0, int n) {
  const int64_t width = in.color_width();
  return all_finite(in.colors + width * i0, width * n) &&
         (!in.features || all_finite(in.features + in.dims * i0, static_cast<int64_t>(in.dims) * n));
}

}  // namespace

template <class T>
uint32_t project(const Inputs<T> &in, const Frame<T> &f, int64_t begin, int64_t end, bool check, DepthKey<T> *keys,
                 T *radii, int64_t &bad) {
  ProjectionBlock<T> b;
  uint32_t out = static_cast<uint32_t>(begin);
  for (int64_t i0 = begin; i0 < end; i0 += kBlock) {
    const int n = static_cast<int>(end - i0 < kBlock ? end - i0 : kBlock);
    load_block(in, i0, n, b);
    project_block(f.camera, b);
    bound_block(f.camera, n, b);
    if (check && !attributes_finite(in, i0, n)) {
      bad = i0;
      return 0;
    }
    for (int j = 0; j < n; ++j) {
      if (!(b.finite[j] == 0)) {
        bad = i0 + j;
        return 0;
      }
      if (!b.seen[j]) continue;
      Splat<T> &s = f.splats[out];
      fill_splat(b, j, s);
      s.id = static_cast<int32_t>(i0 + j);
      set_color(in, f.camera, i0 + j, s);
      keys[out++] = depth_key(s.z);
      if (radii) radii[i0 + j] = b.radius[j];
    }
  }
  return out - static_cast<uint32_t>(begin);
}

template uint32_t project(const Inputs<float> &, const Frame<float> &, int64_t, int64_t, bool, uint32_t *, float *,
                          int64_t &);
#ifdef PERCEPTION_LEVEL_baseline
template uint32_t project(const Inputs<double> &, const Frame<double> &, int64_t, int64_t, bool, uint64_t *, double *,
                          int64_t &);
#endif

}  // namespace perception::PERCEPTION_LEVEL
