// One Gaussian through one pinhole camera, and the vector-Jacobian product. Scalar and branch-free, shared by every
// device; the CPU kernels loop over structure-of-array blocks so that the compiler vectorises it.
//
// camera frame: p = R m + t; mean: x = fx p0/p2 + cx. Covariance (EWA splatting, 3DGS eq. 5): J R Q S S Qᵀ Rᵀ Jᵀ +
// eps2d I, with p0/p2 and p1/p2 in J clamped to 1.3 times the field of view (the gradient through a clamped value is
// zero). J is a good approximation near the mean only: a large Gaussian far beside the field of view and close to the
// camera's plane would lie before the whole image as haze. Those outside the guard band (Kerbl et al. 2023, section 6) are
// not drawn.
#pragma once
#include <cmath>

#ifdef __CUDACC__
#define PERCEPTION_HD __host__ __device__ __forceinline__
#else
#define PERCEPTION_HD inline __attribute__((always_inline))
#endif

namespace perception {

// Width of the guard band: a mean outside the clamped field of view and this many times as far from the optical axis as
// from the camera's plane is not drawn.
template <class T>
constexpr T kGuardBand = T(5);

template <class T>
struct Camera {
  T R[9], t[3];  // camera_from_world, row-major
  T fx, fy, cx, cy;
  T limit_x0, limit_x1, limit_y0, limit_y1;  // bounds of p0/p2 and p1/p2 inside J
  T near_plane;
  T eps2d;  // px², added to the diagonal of the 2D covariance: what a pixel averages over
  int width, height;
};

template <class T>
PERCEPTION_HD Camera<T> make_camera(const T *viewmat, const T *K, int width, int height, T near_plane, T eps2d) {
  Camera<T> c;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.R[3 * i + j] = viewmat[4 * i + j];
    c.t[i] = viewmat[4 * i + 3];
  }
  c.fx = K[0], c.fy = K[4], c.cx = K[2], c.cy = K[5];
  const T margin_x = T(0.3) * T(0.5) * width / c.fx, margin_y = T(0.3) * T(0.5) * height / c.fy;
  c.limit_x0 = -c.cx / c.fx - margin_x, c.limit_x1 = (width - c.cx) / c.fx + margin_x;
  c.limit_y0 = -c.cy / c.fy - margin_y, c.limit_y1 = (height - c.cy) / c.fy + margin_y;
  c.near_plane = near_plane, c.eps2d = eps2d, c.width = width, c.height = height;
  return c;
}

// Unit quaternion, safe from overflow and underflow. The zero quaternion gives zeros, i.e. the identity rotation.
// inv_norm: 1/|q|, at most 1e12.
template <class T>
struct UnitQuaternion {
  T w, x, y, z, inv_norm;
  PERCEPTION_HD UnitQuaternion(T qw, T qx, T qy, T qz) {
    T m = std::fabs(qw), b = std::fabs(qx), c = std::fabs(qy), d = std::fabs(qz);
    m = m > b ? m : b, c = c > d ? c : d, m = m > c ? m : c;
    const T scale = m < T(1e-18) ? T(0x1p100) : m > T(1e18) ? T(0x1p-100) : T(1);
    qw *= scale, qx *= scale, qy *= scale, qz *= scale;
    const T n2 = qw * qw + qx * qx + qy * qy + qz * qz;
    const T inv = n2 > T(0) ? T(1) / std::sqrt(n2) : T(0);
    w = qw * inv, x = qx * inv, y = qy * inv, z = qz * inv;
    const T full = inv * scale;
    inv_norm = full < T(1e12) ? full : T(1e12);
  }
  PERCEPTION_HD void rotation(T *Q) const {
    Q[0] = 1 - 2 * (y * y + z * z), Q[1] = 2 * (x * y - w * z), Q[2] = 2 * (x * z + w * y);
    Q[3] = 2 * (x * y + w * z), Q[4] = 1 - 2 * (x * x + z * z), Q[5] = 2 * (y * z - w * x);
    Q[6] = 2 * (x * z - w * y), Q[7] = 2 * (y * z + w * x), Q[8] = 1 - 2 * (x * x + y * y);
  }
};

// What the blending needs of a 2D covariance [[a, b], [b, c]], in the factored form
//   dᵀ cov⁻¹ d = (dx + k dy)² / var_x + dy² / c,   k = -b/c,   var_x = det / c  (the variance of x given y),
// whose terms never cancel, however thin the ellipse.
template <class T>
struct Projected {
  T x, y, z;          // px, px, depth (0 outside the guard band)
  T var_x, k, var_y;  // px², -, px²   (var_y = c)
  T cov_xx, cov_xy;   // px²
};

template <class T>
PERCEPTION_HD Projected<T> project(const Camera<T> &cam, const T *m, const T *q, const T *s) {
  const T *R = cam.R;
  const T p0 = R[0] * m[0] + R[1] * m[1] + R[2] * m[2] + cam.t[0];
  const T p1 = R[3] * m[0] + R[4] * m[1] + R[5] * m[2] + cam.t[1];
  const T p2 = R[6] * m[0] + R[7] * m[1] + R[8] * m[2] + cam.t[2];
  const T iz = T(1) / p2, ux = p0 * iz, uy = p1 * iz;
  T tx = ux > cam.limit_x0 ? ux : cam.limit_x0, ty = uy > cam.limit_y0 ? uy : cam.limit_y0;
  tx = tx < cam.limit_x1 ? tx : cam.limit_x1, ty = ty < cam.limit_y1 ? ty : cam.limit_y1;
  T Q[9], u[3], w[3];
  UnitQuaternion<T>(q[0], q[1], q[2], q[3]).rotation(Q);
  const T sx = cam.fx * iz, sy = cam.fy * iz;
  for (int j = 0; j < 3; ++j) u[j] = w[j] = 0;
  for (int i = 0; i < 3; ++i) {
    const T e = sx * (R[i] - tx * R[6 + i]), f = sy * (R[3 + i] - ty * R[6 + i]);
    for (int j = 0; j < 3; ++j) u[j] += e * Q[3 * i + j], w[j] += f * Q[3 * i + j];
  }
  for (int j = 0; j < 3; ++j) u[j] *= s[j], w[j] *= s[j];
  const T a = u[0] * u[0] + u[1] * u[1] + u[2] * u[2], c = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
  const T vc = c + cam.eps2d, r = T(1) / vc;
  // det/c with the determinant as the sum of squared 2x2 minors of [u; w] plus the blur's terms: nothing cancels.
  const T scale = T(1) / std::sqrt(vc);
  const T n0 = (u[1] * w[2] - u[2] * w[1]) * scale, n1 = (u[2] * w[0] - u[0] * w[2]) * scale,
          n2 = (u[0] * w[1] - u[1] * w[0]) * scale;
  Projected<T> o;
  const bool outside = ((tx != ux) | (ty != uy)) & (ux * ux + uy * uy > kGuardBand<T> * kGuardBand<T>);
  o.x = cam.fx * ux + cam.cx, o.y = cam.fy * uy + cam.cy, o.z = outside ? T(0) : p2;
  o.cov_xx = a + cam.eps2d;
  o.cov_xy = u[0] * w[0] + u[1] * w[1] + u[2] * w[2];
  o.var_y = vc;
  o.var_x = n0 * n0 + n1 * n1 + n2 * n2 + cam.eps2d * (a * r) + cam.eps2d * (c * r) + cam.eps2d * cam.eps2d * r;
  o.k = -o.cov_xy * r;
  return o;
}

// Cotangents of a projection; cov_xy is one variable although it stands twice in the matrix.
template <class T>
struct ProjectedGrad {
  T x, y, z, cov_xx, cov_xy, cov_yy;
};

// From cotangents of the factored form to those of the covariance.
template <class T>
PERCEPTION_HD void factored_vjp(T g_var_x, T g_k, T g_var_y, T k, T var_y, ProjectedGrad<T> &out) {
  const T r = T(1) / var_y;
  out.cov_xx = g_var_x;
  out.cov_xy = 2 * k * g_var_x - g_k * r;
  out.cov_yy = k * k * g_var_x - g_k * k * r + g_var_y;
}

// gR [9] and gt [3] are this Gaussian's contribution to the camera; everything is written, not added.
template <class T>
PERCEPTION_HD void project_vjp(const Camera<T> &cam, const T *m, const T *q, const T *s, const ProjectedGrad<T> &g,
                               T *gm, T *gq, T *gs, T *gR, T *gt) {
  const T *R = cam.R;
  const T p0 = R[0] * m[0] + R[1] * m[1] + R[2] * m[2] + cam.t[0];
  const T p1 = R[3] * m[0] + R[4] * m[1] + R[5] * m[2] + cam.t[1];
  const T p2 = R[6] * m[0] + R[7] * m[1] + R[8] * m[2] + cam.t[2];
  const T iz = T(1) / p2, ux = p0 * iz, uy = p1 * iz;
  T tx = ux > cam.limit_x0 ? ux : cam.limit_x0, ty = uy > cam.limit_y0 ? uy : cam.limit_y0;
  tx = tx < cam.limit_x1 ? tx : cam.limit_x1, ty = ty < cam.limit_y1 ? ty : cam.limit_y1;
  const UnitQuaternion<T> h(q[0], q[1], q[2], q[3]);
  T Q[9], e[3], f[3], ge[3], gf[3], gQ[9];
  h.rotation(Q);
  const T sx = cam.fx * iz, sy = cam.fy * iz;
  for (int i = 0; i < 3; ++i)
    e[i] = sx * (R[i] - tx * R[6 + i]), f[i] = sy * (R[3 + i] - ty * R[6 + i]), ge[i] = gf[i] = 0;
  for (int j = 0; j < 3; ++j) {
    const T eq = e[0] * Q[j] + e[1] * Q[3 + j] + e[2] * Q[6 + j], fq = f[0] * Q[j] + f[1] * Q[3 + j] + f[2] * Q[6 + j];
    const T u = s[j] * eq, w = s[j] * fq;
    const T gu = 2 * g.cov_xx * u + g.cov_xy * w, gw = g.cov_xy * u + 2 * g.cov_yy * w;
    gs[j] = gu * eq + gw * fq;
    const T geq = gu * s[j], gfq = gw * s[j];
    for (int i = 0; i < 3; ++i) {
      gQ[3 * i + j] = e[i] * geq + f[i] * gfq;
      ge[i] += Q[3 * i + j] * geq, gf[i] += Q[3 * i + j] * gfq;
    }
  }
  // e = fx iz (R0 - tx R2), f = fy iz (R1 - ty R2)
  T giz = 0, gtx = 0, gty = 0;
  for (int i = 0; i < 3; ++i) {
    gR[i] = sx * ge[i], gR[3 + i] = sy * gf[i];
    gR[6 + i] = -tx * gR[i] - ty * gR[3 + i];
    giz += cam.fx * ge[i] * (R[i] - tx * R[6 + i]) + cam.fy * gf[i] * (R[3 + i] - ty * R[6 + i]);
    gtx -= gR[i] * R[6 + i], gty -= gR[3 + i] * R[6 + i];
  }
  const T gux = cam.fx * g.x + (tx == ux ? gtx : T(0)), guy = cam.fy * g.y + (ty == uy ? gty : T(0));
  giz += gux * p0 + guy * p1;
  gt[0] = gux * iz, gt[1] = guy * iz, gt[2] = g.z - giz * iz * iz;
  for (int i = 0; i < 3; ++i) {
    gm[i] = R[i] * gt[0] + R[3 + i] * gt[1] + R[6 + i] * gt[2];
    for (int j = 0; j < 3; ++j) gR[3 * i + j] += gt[i] * m[j];
  }
  const T d21 = gQ[7] - gQ[5], d02 = gQ[2] - gQ[6], d10 = gQ[3] - gQ[1];
  const T s01 = gQ[1] + gQ[3], s02 = gQ[2] + gQ[6], s12 = gQ[5] + gQ[7];
  const T gw = 2 * (h.x * d21 + h.y * d02 + h.z * d10);
  const T gx = 2 * (h.w * d21 + h.y * s01 + h.z * s02 - 2 * h.x * (gQ[4] + gQ[8]));
  const T gy = 2 * (h.w * d02 + h.x * s01 + h.z * s12 - 2 * h.y * (gQ[0] + gQ[8]));
  const T gz = 2 * (h.w * d10 + h.x * s02 + h.y * s12 - 2 * h.z * (gQ[0] + gQ[4]));
  const T radial = h.w * gw + h.x * gx + h.y * gy + h.z * gz;
  gq[0] = (gw - h.w * radial) * h.inv_norm, gq[1] = (gx - h.x * radial) * h.inv_norm;
  gq[2] = (gy - h.y * radial) * h.inv_norm, gq[3] = (gz - h.z * radial) * h.inv_norm;
}

}  // namespace perception
