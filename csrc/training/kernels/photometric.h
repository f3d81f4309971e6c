// (1 - beta) L1 + beta (1 - SSIM) and its gradient in one sweep down a tile of columns.
//
// SSIM = a1 a2 / (b1 b2) with local means mx, my and raw moments under an 11-tap Gaussian window w (zero padding):
//   a1 = 2 mx my + c1    a2 = 2 (E[xy] - mx my) + c2    b1 = mx^2 + my^2 + c1    b2 = E[x^2 + y^2] - mx^2 - my^2 + c2
// Its derivatives P = dS/dmx (through all four terms), Q = dS/dE[x^2], R = dS/dE[xy] are blurred with the same
// window: dS/dx = w * P + 2 x (w * Q) + y (w * R).
//
// Rows enter at the bottom: row r is blurred sideways into ring 1, which completes the moments of row r - 5; their
// derivatives are blurred sideways into ring 2, which completes the gradient of row r - 10. Channels stay
// interleaved: a sideways tap is `channels` elements away. What a pixel gets depends on its position only, never on
// the tile's first row, so any split by rows gives the same bits.
#pragma once
#include "table.h"
#include "vector.h"

namespace perception::training::PERCEPTION_LEVEL {

constexpr double kC1 = 0.01 * 0.01, kC2 = 0.03 * 0.03;  // Wang et al. 2004, dynamic range 1

template <class T>
T target_at(const Photo<T> &photo, int64_t i) {
  return photo.target ? photo.target[i] : T(photo.target8[i]) * T(1.0 / 255.0);
}

template <class T>  // y[0..n) = target elements from `from`
void load_target(const Photo<T> &photo, int64_t from, int n, T *__restrict y) {
  if (photo.target) {
    for (int i = 0; i < n; ++i) y[i] = photo.target[from + i];
  } else {
    const uint8_t *bytes = photo.target8 + from;
    for (int i = 0; i < n; ++i) y[i] = T(bytes[i]) * T(1.0 / 255.0);
  }
}

template <class T>  // one weight per element; false when all are 1
bool load_weight(const Photo<T> &photo, int64_t first_pixel, int n, T *__restrict w) {
  if (!photo.weight) return false;
  for (int p = 0, i = 0; i < n; ++p)
    for (int c = 0; c < photo.channels; ++c, ++i) w[i] = photo.weight[first_pixel + p];
  return true;
}

template <class T>  // out[i] = sum_k window[k] in[i + k step]
void blur_sideways(const T *in, int step, int n, const T *window, T *out) {
  const T w0 = window[0], w1 = window[1], w2 = window[2], w3 = window[3], w4 = window[4], w5 = window[5];
  for (int i = 0; i < n; i += Pack<T>::size) {
    const T *p = in + i;
    auto sum = w5 * PERCEPTION_LOAD(T, p + 5 * step);
    sum += w4 * (PERCEPTION_LOAD(T, p + 4 * step) + PERCEPTION_LOAD(T, p + 6 * step));
    sum += w3 * (PERCEPTION_LOAD(T, p + 3 * step) + PERCEPTION_LOAD(T, p + 7 * step));
    sum += w2 * (PERCEPTION_LOAD(T, p + 2 * step) + PERCEPTION_LOAD(T, p + 8 * step));
    sum += w1 * (PERCEPTION_LOAD(T, p + 1 * step) + PERCEPTION_LOAD(T, p + 9 * step));
    sum += w0 * (PERCEPTION_LOAD(T, p) + PERCEPTION_LOAD(T, p + 10 * step));
    PERCEPTION_STORE(T, out + i) = sum;
  }
}

// ring [kTaps, Maps, kRowCapacity]: slot j holds the row whose number is j modulo kTaps, so instead of moving rows
// the window is rotated. out[i] = sum_j window[j] ring[j][i].
template <class T, int Maps>
void blur_downwards(const T *ring, int n, const T *window, T *out) {
  constexpr int row = Maps * kRowCapacity;
  for (int i = 0; i < n; i += Pack<T>::size) {
    auto sum = window[0] * PERCEPTION_LOAD(T, ring + i);
    for (int j = 1; j < kTaps; ++j) sum += window[j] * PERCEPTION_LOAD(T, ring + j * row + i);
    PERCEPTION_STORE(T, out + i) = sum;
  }
}

inline int ring_slot(int row) { return (row + 2 * kTaps) % kTaps; }

template <class T>
void rotate_window(const T *window, int centre_row, T *rotated) {
  for (int k = 0; k < kTaps; ++k) rotated[ring_slot(centre_row - kRadius + k)] = window[k];
}

template <class T>
void clear(T *values, int64_t n) {
  for (int64_t i = 0; i < n; ++i) values[i] = T(0);
}

// In place: moments [4, kRowCapacity] in, P, Q, R in maps 0 to 2 and SSIM in map 3 out.
template <class T>
void differentiate(T *__restrict moments, int n) {
  T *__restrict m0 = moments, *__restrict m1 = moments + kRowCapacity;
  T *__restrict m2 = moments + 2 * kRowCapacity, *__restrict m3 = moments + 3 * kRowCapacity;
#pragma GCC ivdep
  for (int i = 0; i < n; ++i) {
    const T mx = m0[i], my = m1[i], square = m2[i], cross = m3[i];
    const T product = mx * my, squares = mx * mx + my * my;
    const T a1 = 2 * product + T(kC1), a2 = 2 * (cross - product) + T(kC2);
    const T b1 = squares + T(kC1), b2 = square - squares + T(kC2);
    const T inverse = T(1) / (b1 * b2);
    const T ssim = a1 * a2 * inverse;
    m0[i] = 2 * inverse * (my * (a2 - a1) + mx * ssim * (b1 - b2));
    m1[i] = -ssim * inverse * b1;
    m2[i] = 2 * a1 * inverse;
    m3[i] = ssim;
  }
}

template <class T>
struct Sweep {
  const Photo<T> &photo;
  const Tile &tile;
  T *ring1, *ring2, *inputs, *moments, *blurred, *weights, *row;
  int step, columns;  // elements per pixel, output elements per row

  void enter(int r) const;        // row r sideways into ring 1
  void differentiate_row(int q) const;  // row q of P, Q, R sideways into ring 2
  void finish(int p) const;       // row p of the gradient
};

template <class T>
void Sweep<T>::enter(int r) const {
  T *out = ring1 + ring_slot(r) * kInputMaps * kRowCapacity;
  if (r < 0 || r >= photo.height) return clear(out, kInputMaps * kRowCapacity);
  const int left = tile.col0 - 2 * kRadius, right = tile.col1 + 2 * kRadius;
  const int first = left > 0 ? left : 0, last = right < photo.width ? right : photo.width;
  const int offset = (first - left) * step, n = (last - first) * step;
  const int64_t from = (int64_t(r) * photo.width + first) * step;
  T *__restrict x = inputs + offset, *__restrict y = x + kRowCapacity;
  T *__restrict squares = y + kRowCapacity, *__restrict cross = squares + kRowCapacity;
  load_target(photo, from, n, y);
  const T *__restrict render = photo.render + from;
  for (int i = 0; i < n; ++i) {
    const T a = render[i], b = y[i];
    x[i] = a;
    squares[i] = a * a + b * b;
    cross[i] = a * b;
  }
  for (int m = 0; m < kInputMaps; ++m)
    blur_sideways(inputs + m * kRowCapacity, step, columns + 2 * kRadius * step, photo.window, out + m * kRowCapacity);
}

template <class T>
void Sweep<T>::differentiate_row(int q) const {
  T *out = ring2 + ring_slot(q) * kGradientMaps * kRowCapacity;
  if (q < 0 || q >= photo.height) return clear(out, kGradientMaps * kRowCapacity);
  const int n = columns + 2 * kRadius * step;
  T rotated[kTaps];
  rotate_window(photo.window, q, rotated);
  for (int m = 0; m < kInputMaps; ++m)
    blur_downwards<T, kInputMaps>(ring1 + m * kRowCapacity, n, rotated, moments + m * kRowCapacity);
  differentiate(moments, n);

  // Only pixels of the image have an SSIM; the rest of the halo is zero.
  const int left = tile.col0 - kRadius, right = tile.col1 + kRadius;
  const int before = left < 0 ? -left * step : 0, after = right > photo.width ? (right - photo.width) * step : 0;
  for (int m = 0; m < kInputMaps; ++m) {
    clear(moments + m * kRowCapacity, before);
    clear(moments + m * kRowCapacity + n - after, after);
  }
  const int64_t first_pixel = int64_t(q) * photo.width + (left < 0 ? 0 : left);
  if (load_weight(photo, first_pixel, n - before - after, weights))
    for (int m = 0; m < kInputMaps; ++m) {
      T *__restrict map = moments + m * kRowCapacity + before;
      for (int i = 0; i < n - before - after; ++i) map[i] *= weights[i];
    }
  if (q >= tile.row0 && q < tile.row1)
    tile.ssim[q] = sum_row<T, false>(moments + 3 * kRowCapacity + kRadius * step, columns);
  for (int m = 0; m < kGradientMaps; ++m)
    blur_sideways(moments + m * kRowCapacity, step, columns, photo.window, out + m * kRowCapacity);
}

// gradient = l1_scale w sign(x - y) + ssim_scale (P' + 2 x Q' + y R'); magnitude = w |x - y|.
template <class T, bool Weighted>
void combine(const T *__restrict x, const T *__restrict y, const T *__restrict w, const T *__restrict blurred, int n,
             T l1_scale, T ssim_scale, T *__restrict gradient, T *__restrict magnitude) {
  for (int i = 0; i < n; ++i) {
    const T d = x[i] - y[i], weight = Weighted ? w[i] : T(1);
    const T sign = d > 0 ? T(1) : d < 0 ? T(-1) : T(0);
    T g = l1_scale * weight * sign;
    if (blurred)
      g += ssim_scale * (blurred[i] + 2 * x[i] * blurred[kRowCapacity + i] + y[i] * blurred[2 * kRowCapacity + i]);
    gradient[i] = g;
    magnitude[i] = weight * d * sign;
  }
}

template <class T>
void Sweep<T>::finish(int p) const {
  T rotated[kTaps];
  rotate_window(photo.window, p, rotated);
  for (int m = 0; m < kGradientMaps; ++m)
    blur_downwards<T, kGradientMaps>(ring2 + m * kRowCapacity, columns, rotated, blurred + m * kRowCapacity);
  const int64_t pixel = int64_t(p) * photo.width + tile.col0, from = pixel * step;
  T *y = moments;  // free until the next row
  load_target(photo, from, columns, y);
  const bool weighted = load_weight(photo, pixel, columns, weights);
  (weighted ? combine<T, true> : combine<T, false>)(photo.render + from, y, weights, blurred, columns,
                                                    photo.l1_scale, photo.ssim_scale, photo.gradient + from, row);
  tile.l1[p] = sum_row<T, false>(row, columns);
}

template <class T>
void photometric_tile(const Photo<T> &photo, const Tile &tile, T *scratch) {
  clear(scratch, kPhotometricScratch);
  T *ring2 = scratch + kTaps * kInputMaps * kRowCapacity;
  T *inputs = ring2 + kTaps * kGradientMaps * kRowCapacity;
  T *moments = inputs + kInputMaps * kRowCapacity;
  T *blurred = moments + kInputMaps * kRowCapacity;
  T *weights = blurred + kGradientMaps * kRowCapacity;
  const Sweep<T> sweep{photo,   tile,    scratch, ring2, inputs, moments, blurred, weights, weights + kRowCapacity,
                       photo.channels, (tile.col1 - tile.col0) * photo.channels};
  for (int r = tile.row0 - 2 * kRadius; r < tile.row1 + 2 * kRadius; ++r) {
    sweep.enter(r);
    if (r >= tile.row0) sweep.differentiate_row(r - kRadius);
    if (r >= tile.row0 + 2 * kRadius) sweep.finish(r - 2 * kRadius);
  }
}

template <class T>
double absolute_row(const Photo<T> &photo, int r) {
  const int total = photo.width * photo.channels, most = kTileElements / photo.channels * photo.channels;
  T y[kRowCapacity], w[kRowCapacity], magnitude[kRowCapacity];
  double sum = 0;
  for (int begin = 0; begin < total; begin += most) {
    const int n = total - begin < most ? total - begin : most;
    const int64_t from = int64_t(r) * total + begin;
    load_target(photo, from, n, y);
    const bool weighted = load_weight(photo, from / photo.channels, n, w);
    (weighted ? combine<T, true> : combine<T, false>)(photo.render + from, y, w, nullptr, n, photo.l1_scale, T(0),
                                                      photo.gradient + from, magnitude);
    sum += sum_row<T, false>(magnitude, n);
  }
  return sum;
}

}  // namespace perception::training::PERCEPTION_LEVEL
