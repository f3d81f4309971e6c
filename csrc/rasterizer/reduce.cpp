// Stage 6: sums every splat's records in a fixed order and takes the gradient from the picture plane back to the
// Gaussian's own parameters and the camera.
#include <cmath>

#include "constants.h"
#include "kernels.h"
#include "records.h"
#include "spherical_harmonics.h"

namespace perception::PERCEPTION_LEVEL {
namespace {

// Sum of splat i's records; false when no tile touched it.
template <class T>
bool sum_records(const Scratch<T> &scratch, uint32_t i, int size, T *sum) {
  bool found = false;
  for (uint64_t slot = scratch.slots[i]; slot < scratch.slots[i + 1]; ++slot) {
    if (!scratch.touched[slot]) continue;
    const T *record = scratch.records.data() + slot * size;
    for (int c = 0; c < size; ++c) sum[c] = found ? sum[c] + record[c] : record[c];
    found = true;
  }
  return found;
}

// n Gaussians, a column each, and what project_vjp takes and gives.
template <class T>
struct GradientBlock {
  alignas(64) T in[10][kBlock];      // mean [3], quaternion [4], scales [3]
  alignas(64) T picture[6][kBlock];  // dL/d(x, y, z, cov_xx, cov_xy, cov_yy)
  T absolute[2][kBlock];             // Σ |dL/d(x, y)|, see absolute_gradient
  alignas(64) T out[10][kBlock];     // dL/d(in)
  alignas(64) T camera[12][kBlock];  // dL/dR [9], dL/dt [3]
  uint32_t splat[kBlock];            // index into Frame::splats
  int n = 0;
};

template <class T>
void vjp_block(const Camera<T> &camera, GradientBlock<T> &b) {
  const Camera<T> cam = camera;
#pragma GCC ivdep
  for (int j = 0; j < kBlock; ++j) {
    const T m[3] = {b.in[0][j], b.in[1][j], b.in[2][j]}, q[4] = {b.in[3][j], b.in[4][j], b.in[5][j], b.in[6][j]},
            s[3] = {b.in[7][j], b.in[8][j], b.in[9][j]};
    const ProjectedGrad<T> g = {b.picture[0][j], b.picture[1][j], b.picture[2][j],
                                b.picture[3][j], b.picture[4][j], b.picture[5][j]};
    T gm[3], gq[4], gs[3], gR[9], gt[3];
    project_vjp(cam, m, q, s, g, gm, gq, gs, gR, gt);
    for (int c = 0; c < 3; ++c) b.out[c][j] = gm[c], b.out[7 + c][j] = gs[c], b.camera[9 + c][j] = gt[c];
    for (int c = 0; c < 4; ++c) b.out[3 + c][j] = gq[c];
    for (int c = 0; c < 9; ++c) b.camera[c][j] = gR[c];
  }
}

template <class T>
void load_gaussian(const Inputs<T> &in, int64_t i, int j, GradientBlock<T> &b) {
  for (int c = 0; c < 3; ++c) b.in[c][j] = in.means[3 * i + c], b.in[7 + c][j] = in.scales[3 * i + c];
  for (int c = 0; c < 4; ++c) b.in[3 + c][j] = in.quats[4 * i + c];
}

// Padding lanes repeat the first Gaussian with zero cotangents, so that they add exact zeros.
template <class T>
void pad_block(GradientBlock<T> &b) {
  for (int j = b.n; j < kBlock; ++j) {
    for (auto &row : b.in) row[j] = row[0];
    for (auto &row : b.picture) row[j] = 0;
  }
}

// From the record's moments r to cotangents of the projection. With h = dL/d ln alpha, u = dx + k dy, and
// ln alpha = ln opacity - (u² / var_x + dy² / var_y) / 2 (see Projected), sums over the pixels:
//   dL/dx     = -Σ h u / var_x           dL/dy     = k dL/dx - Σ h dy / var_y     dL/dk = -Σ h u dy / var_x
//   dL/dvar_x = Σ h u² / (2 var_x²)      dL/dvar_y = Σ h dy² / (2 var_y²)
template <class T>
ProjectedGrad<T> picture_gradient(const Splat<T> &s, const T *r) {
  const T precision_x = s.a * (-2 / kLog2E<T>), precision_y = s.d * (-2 / kLog2E<T>);  // 1/var_x, 1/var_y
  const T gu = -r[1] * precision_x;  // dL/dx
  ProjectedGrad<T> g;
  g.x = gu, g.y = s.k * gu - r[2] * precision_y, g.z = r[11];
  factored_vjp(T(0.5) * r[3] * precision_x * precision_x, -r[4] * precision_x,
               T(0.5) * r[5] * precision_y * precision_y, s.k, 1 / precision_y, g);
  return g;
}

// Σ over the pixels of the size of what each adds to dL/d(x, y): those that pull in opposite ways do not cancel (AbsGS,
// Ye et al. 2024). The two terms of dL/dy are taken by their sizes too, and so are slices of the feature channels.
template <class T>
void absolute_gradient(const Splat<T> &s, const T *r, T &x, T &y) {
  x = r[6] * s.a * (-2 / kLog2E<T>), y = std::abs(s.k) * x + r[7] * s.d * (-2 / kLog2E<T>);
}

template <class T>
inline void put(T &to, T value, bool write) {
  to = write ? value : to + value;
}

// Colours, or SH coefficients and the direction they are seen from (which moves the mean and the camera).
template <class T>
void color_gradient(const Inputs<T> &in, const Camera<T> &cam, const Splat<T> &s, const T *g_rgb,
                    const Gradients<T> &out, bool write, T *g_mean, T *g_R, T *g_t) {
  const int64_t i = s.id;
  if (out.colors && write) std::memset(out.colors + i * in.color_width(), 0, in.color_width() * sizeof(T));
  if (in.sh_degree < 0) {
    if (out.colors)
      for (int c = 0; c < 3; ++c) out.colors[3 * i + c] += g_rgb[c];
    return;
  }
  T v[3], gv[3];
  const T gated[3] = {s.r > 0 ? g_rgb[0] : 0, s.g > 0 ? g_rgb[1] : 0, s.b > 0 ? g_rgb[2] : 0};
  view_vector(cam, in.means + 3 * i, v);
  sh_color_vjp(in.sh_degree, v, in.colors + 3 * i * in.sh_stride, gated,
               out.colors ? out.colors + 3 * i * in.sh_stride : nullptr, gv);
  for (int c = 0; c < 3; ++c) {  // v = mean + Rᵀ t
    g_mean[c] += gv[c];
    for (int k = 0; k < 3; ++k) g_R[3 * k + c] += cam.t[k] * gv[c], g_t[k] += cam.R[3 * k + c] * gv[c];
  }
}

template <class T>
void flush_block(const Pass<T> &pass, const T (*colors)[3], const Gradients<T> &out, bool write, GradientBlock<T> &b,
                 double *camera_sum) {
  if (!b.n) return;
  const Inputs<T> &in = pass.in;
  const Frame<T> &f = pass.frame;
  pad_block(b);
  vjp_block(f.camera, b);
  for (int j = 0; j < b.n; ++j) {
    const Splat<T> &s = f.splats[b.splat[j]];
    const int64_t i = s.id;
    T g_mean[3] = {b.out[0][j], b.out[1][j], b.out[2][j]}, g_R[9], g_t[3];
    for (int c = 0; c < 9; ++c) g_R[c] = b.camera[c][j];
    for (int c = 0; c < 3; ++c) g_t[c] = b.camera[9 + c][j];
    color_gradient(in, f.camera, s, colors[j], out, write, g_mean, g_R, g_t);
    if (out.means)
      for (int c = 0; c < 3; ++c) put(out.means[3 * i + c], g_mean[c], write);
    if (out.quats)
      for (int c = 0; c < 4; ++c) put(out.quats[4 * i + c], b.out[3 + c][j], write);
    if (out.scales)
      for (int c = 0; c < 3; ++c)
        put(out.scales[3 * i + c], out.stored ? b.out[7 + c][j] * b.in[7 + c][j] : b.out[7 + c][j], write);
    const int64_t row = 2 * (in.n * pass.camera + i);
    for (int c = 0; c < 2; ++c) {
      if (out.mean2d) put(out.mean2d[row + c], b.picture[c][j], write);
      if (out.absgrad) put(out.absgrad[row + c], b.absolute[c][j], write);
    }
    if (!out.viewmats) continue;
    for (int c = 0; c < 9; ++c) camera_sum[c] += g_R[c];
    for (int c = 0; c < 3; ++c) camera_sum[9 + c] += g_t[c];
  }
  b.n = 0;
}

}  // namespace

// Adds the records of a range to one sum a splat.
template <class T>
void add_records(const Options &opt, const Frame<T> &f, int size, Scratch<T> &scratch) {
  const std::size_t blocks = (f.count + kBlock - 1) / kBlock;
  parallel_for(opt.threads, blocks, [&](std::size_t block, int) {
    const uint32_t end = static_cast<uint32_t>(std::min<std::size_t>(f.count, (block + 1) * kBlock));
    T sum[kGeometry + 16];
    for (uint32_t i = static_cast<uint32_t>(block * kBlock); i < end; ++i) {
      if (!sum_records(scratch, i, size, sum)) continue;
      T *to = scratch.sums.data() + static_cast<std::size_t>(i) * size;
      for (int c = 0; c < size; ++c) to[c] = scratch.sum_touched[i] ? to[c] + sum[c] : sum[c];
      scratch.sum_touched[i] = 1;
    }
  });
}

// Blocks of consecutive splats, each by one worker; the camera's gradient is summed over the blocks in order.
template <class T>
void reduce(const Pass<T> &pass, Slice slice, Scratch<T> &scratch, const Gradients<T> &out) {
  const Inputs<T> &in = pass.in;
  const Frame<T> &f = pass.frame;
  const int size = record_size<T>(slice);
  const bool write = out.stored && slice.begin == 0;  // the other slices add to the first
  const std::size_t blocks = (f.count + kBlock - 1) / kBlock;
  double *camera_sums = scratch.camera_sums.reserve(12 * (blocks + 1));
  parallel_for(pass.opt.threads, blocks, [&](std::size_t block, int) {
    GradientBlock<T> b;
    T colors[kBlock][3], sum[kGeometry + 16];
    double *camera_sum = camera_sums + 12 * block;
    for (int c = 0; c < 12; ++c) camera_sum[c] = 0;
    const uint32_t end = static_cast<uint32_t>(std::min<std::size_t>(f.count, (block + 1) * kBlock));
    for (uint32_t i = static_cast<uint32_t>(block * kBlock); i < end; ++i) {
      if (!sum_records(scratch, i, size, sum)) continue;
      const Splat<T> &s = f.splats[i];
      if (out.features)
        for (int c = 0; c < slice.count; ++c)
          put(out.features[static_cast<int64_t>(s.id) * in.dims + slice.begin + c],
              sum[(slice.alone ? 0 : kGeometry) + c], out.stored);
      if (slice.alone) continue;
      const ProjectedGrad<T> g = picture_gradient(s, sum);
      const T picture[6] = {g.x, g.y, g.z, g.cov_xx, g.cov_xy, g.cov_yy};
      for (int c = 0; c < 6; ++c) b.picture[c][b.n] = picture[c];
      absolute_gradient(s, sum, b.absolute[0][b.n], b.absolute[1][b.n]);
      for (int c = 0; c < 3; ++c) colors[b.n][c] = sum[8 + c];
      load_gaussian(in, s.id, b.n, b);
      if (out.opacities)  // sum[0] = o dL/do, and d o / d logit = o (1 - o)
        put(out.opacities[s.id], out.stored ? sum[0] * (1 - in.opacities[s.id]) : sum[0] / in.opacities[s.id], write);
      b.splat[b.n++] = i;
    }
    flush_block(pass, colors, out, write, b, camera_sum);
  });
  if (!out.viewmats) return;
  double total[12] = {};
  for (std::size_t block = 0; block < blocks; ++block)
    for (int c = 0; c < 12; ++c) total[c] += camera_sums[12 * block + c];
  T *viewmat = out.viewmats + 16 * pass.camera;
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) viewmat[4 * r + c] += static_cast<T>(total[3 * r + c]);
    viewmat[4 * r + 3] += static_cast<T>(total[9 + r]);
  }
}

#define INSTANTIATE(T)                                                                  \
  template void add_records(const Options &, const Frame<T> &, int size, Scratch<T> &); \
  template void reduce(const Pass<T> &, Slice, Scratch<T> &, const Gradients<T> &);
INSTANTIATE(float)
#ifdef PERCEPTION_LEVEL_baseline
INSTANTIATE(double)
#endif

}  // namespace perception::PERCEPTION_LEVEL
