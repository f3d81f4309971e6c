// Real spherical harmonics up to degree 3, in the order and with the signs of the 3DGS reference (Condon-Shortley
// phase included). rgb = max(0, 0.5 + Σ_k basis_k(d) c_k), d the unit direction from the camera to the Gaussian.
#pragma once
#include "projection_math.h"

namespace perception {

constexpr int kMaxShCoefficients = 16;

template <class T>
PERCEPTION_HD void sh_basis(int degree, T x, T y, T z, T *b) {
  b[0] = T(0.28209479177387814);
  if (degree < 1) return;
  const T c1 = T(0.4886025119029199);
  b[1] = -c1 * y, b[2] = c1 * z, b[3] = -c1 * x;
  if (degree < 2) return;
  const T xx = x * x, yy = y * y, zz = z * z;
  b[4] = T(1.0925484305920792) * x * y, b[5] = T(-1.0925484305920792) * y * z;
  b[6] = T(0.31539156525252005) * (2 * zz - xx - yy);
  b[7] = T(-1.0925484305920792) * x * z, b[8] = T(0.5462742152960396) * (xx - yy);
  if (degree < 3) return;
  b[9] = T(-0.5900435899266435) * y * (3 * xx - yy), b[10] = T(2.890611442640554) * x * y * z;
  b[11] = T(-0.4570457994644658) * y * (4 * zz - xx - yy);
  b[12] = T(0.3731763325901154) * z * (2 * zz - 3 * xx - 3 * yy);
  b[13] = T(-0.4570457994644658) * x * (4 * zz - xx - yy), b[14] = T(1.445305721320277) * z * (xx - yy);
  b[15] = T(-0.5900435899266435) * x * (xx - 3 * yy);
}

// Gradient of Σ_k w_k basis_k with respect to (x, y, z), the polynomials taken as functions on all of space.
template <class T>
PERCEPTION_HD void sh_basis_vjp(int degree, T x, T y, T z, const T *w, T *g) {
  g[0] = g[1] = g[2] = 0;
  if (degree < 1) return;
  const T c1 = T(0.4886025119029199);
  g[0] -= c1 * w[3], g[1] -= c1 * w[1], g[2] += c1 * w[2];
  if (degree < 2) return;
  const T a = T(1.0925484305920792), b = T(0.31539156525252005), c = T(1.0925484305920792);  // c = 2 * 0.5463
  g[0] += a * (y * w[4] - z * w[7]) - 2 * b * x * w[6] + c * x * w[8];
  g[1] += a * (x * w[4] - z * w[5]) - 2 * b * y * w[6] - c * y * w[8];
  g[2] += a * (-y * w[5] - x * w[7]) + 4 * b * z * w[6];
  if (degree < 3) return;
  const T xx = x * x, yy = y * y, zz = z * z;
  const T k9 = T(-0.5900435899266435) * w[9], k10 = T(2.890611442640554) * w[10], k11 = T(-0.4570457994644658) * w[11],
          k12 = T(0.3731763325901154) * w[12], k13 = T(-0.4570457994644658) * w[13], k14 = T(1.445305721320277) * w[14],
          k15 = T(-0.5900435899266435) * w[15];
  g[0] += 6 * k9 * x * y + k10 * y * z - 2 * k11 * x * y - 6 * k12 * x * z + k13 * (4 * zz - 3 * xx - yy) +
          2 * k14 * x * z + 3 * k15 * (xx - yy);
  g[1] += 3 * k9 * (xx - yy) + k10 * x * z + k11 * (4 * zz - xx - 3 * yy) - 6 * k12 * y * z - 2 * k13 * x * y -
          2 * k14 * y * z - 6 * k15 * x * y;
  g[2] += k10 * x * y + 8 * k11 * y * z + k12 * (6 * zz - 3 * xx - 3 * yy) + 8 * k13 * x * z + k14 * (xx - yy);
}

// The basis with every value three times, as the coefficients of red, green and blue stand.
template <int DEGREE, class T>
PERCEPTION_HD void spread_basis(const T *b, T *spread) {
  constexpr int n = (DEGREE + 1) * (DEGREE + 1);
  for (int k = 0; k < n; ++k)
    for (int c = 0; c < 3; ++c) spread[3 * k + c] = b[k];
}

template <int DEGREE, class T>
PERCEPTION_HD void sh_color_of(const T *v, const T *coefficients, T *rgb) {
  T b[kMaxShCoefficients];
  const T n2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], r = n2 > T(0) ? T(1) / std::sqrt(n2) : T(0);
  sh_basis(DEGREE, v[0] * r, v[1] * r, v[2] * r, b);
  for (int c = 0; c < 3; ++c) {
    T value = T(0.5);
    for (int k = 0; k < (DEGREE + 1) * (DEGREE + 1); ++k) value += b[k] * coefficients[3 * k + c];
    rgb[c] = value > T(0) ? value : T(0);
  }
}

template <int DEGREE, class T>
PERCEPTION_HD void sh_color_vjp_of(const T *v, const T *coefficients, const T *g_rgb, T *g_coefficients, T *gv) {
  constexpr int n = (DEGREE + 1) * (DEGREE + 1);
  T b[kMaxShCoefficients], w[kMaxShCoefficients], spread[3 * n], repeated[3 * n], products[3 * n], g[3];
  const T n2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], r = n2 > T(0) ? T(1) / std::sqrt(n2) : T(0);
  const T x = v[0] * r, y = v[1] * r, z = v[2] * r;
  sh_basis(DEGREE, x, y, z, b);
  spread_basis<DEGREE>(b, spread);
  for (int k = 0; k < n; ++k)
    for (int c = 0; c < 3; ++c) repeated[3 * k + c] = g_rgb[c];
  for (int j = 0; j < 3 * n; ++j) products[j] = coefficients[j] * repeated[j];
  if (g_coefficients)
    for (int j = 0; j < 3 * n; ++j) g_coefficients[j] += spread[j] * repeated[j];
  for (int k = 0; k < n; ++k) w[k] = products[3 * k] + products[3 * k + 1] + products[3 * k + 2];
  sh_basis_vjp(DEGREE, x, y, z, w, g);
  const T along = g[0] * x + g[1] * y + g[2] * z;
  gv[0] = (g[0] - x * along) * r, gv[1] = (g[1] - y * along) * r, gv[2] = (g[2] - z * along) * r;
}

// Vector from the camera's centre -Rᵀt to the Gaussian.
template <class T>
PERCEPTION_HD void view_vector(const Camera<T> &cam, const T *mean, T *v) {
  for (int i = 0; i < 3; ++i) v[i] = mean[i] + cam.R[i] * cam.t[0] + cam.R[3 + i] * cam.t[1] + cam.R[6 + i] * cam.t[2];
}

// v: vector from the camera to the Gaussian. coefficients [(degree + 1)², 3].
template <class T>
PERCEPTION_HD void sh_color(int degree, const T *v, const T *coefficients, T *rgb) {
  degree == 0   ? sh_color_of<0>(v, coefficients, rgb)
  : degree == 1 ? sh_color_of<1>(v, coefficients, rgb)
  : degree == 2 ? sh_color_of<2>(v, coefficients, rgb)
                : sh_color_of<3>(v, coefficients, rgb);
}

// Adds to g_coefficients (null: not wanted) and writes gv. g_rgb must be zero where the colour was clamped.
template <class T>
PERCEPTION_HD void sh_color_vjp(int degree, const T *v, const T *coefficients, const T *g_rgb, T *g_coefficients,
                                T *gv) {
  degree == 0   ? sh_color_vjp_of<0>(v, coefficients, g_rgb, g_coefficients, gv)
  : degree == 1 ? sh_color_vjp_of<1>(v, coefficients, g_rgb, g_coefficients, gv)
  : degree == 2 ? sh_color_vjp_of<2>(v, coefficients, g_rgb, g_coefficients, gv)
                : sh_color_vjp_of<3>(v, coefficients, g_rgb, g_coefficients, gv);
}

}  // namespace perception
