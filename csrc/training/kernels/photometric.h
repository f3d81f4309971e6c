// (1 - beta) L1 + beta (1 - SSIM) and its gradient in one sweep down a tile of columns.
//
// SSIM = a1 a2 / (b1 b2) with local means mx, my and raw moments under an 11-tap Gaussian window w (zero padding):
//   a1 = 2 mx my + c1    a2 = 2 (E[xy] - mx my) + c2    b1 = mx^2 + my^2 + c1    b2 = E[x^2 + y^2] - mx^2 - my^2 + c2
// Its derivatives P = dS/dmx (through all four terms), Q = dS/dE[x^2], R = dS/dE[xy] are blurred with the same
// window: dS/dx = w * P + 2 x (w * Q) + y (w * R).
//
// Rows enter at the bottom, kBlock at a time: rows up to r, blurred sideways into ring 1, complete the moments of rows
// up to r - 5; their derivatives, blurred sideways into ring 2, complete the gradient of rows up to r - 10. A block
// shares its loads downwards, which otherwise bound the speed. Channels stay interleaved: a sideways tap is `channels`
// elements away. Every sum has one order, whatever the tile's first row, so any split by rows gives the same bits.
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

// Ring slot of a row; rows start at -2 kRadius.
inline int ring_slot(int row) { return (row + 2 * kRing) % kRing; }

// The kBlock rows from `row`: out[o out_stride + i] = sum_k window[k] ring(row + o - kRadius + k)[i], with ring
// [kRing, Maps, kRowCapacity].
template <class T, int Maps>
void blur_downwards(const T *ring, int row, int n, const T *window, T *out, int out_stride) {
  const T *rows[kRing];
  for (int r = 0; r < kRing; ++r) rows[r] = ring + ring_slot(row - kRadius + r) * Maps * kRowCapacity;
  for (int i = 0; i < n; i += Pack<T>::size) {
    typename Pack<T>::type sums[kBlock] = {};
#pragma GCC unroll 16
    for (int r = 0; r < kRing; ++r) {
      const typename Pack<T>::type value = PERCEPTION_LOAD(T, rows[r] + i);
#pragma GCC unroll 4
      for (int o = 0; o < kBlock; ++o) {
        const int k = r - o;
        if (k >= 0 && k < kTaps) sums[o] += window[k <= kRadius ? k : kTaps - 1 - k] * value;
      }
    }
    for (int o = 0; o < kBlock; ++o) PERCEPTION_STORE(T, out + o * out_stride + i) = sums[o];
  }
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
  T *ring1, *ring2, *inputs, *blurred, *weights, *row;
  int step, columns;  // elements per pixel, output elements per row

  void enter(int r) const;                // row r sideways into ring 1
  void differentiate_rows(int q0) const;  // rows q0 to q0 + kBlock of P, Q, R sideways into ring 2
  void differentiate_row(int q, T *moments) const;
  void finish_rows(int p0) const;  // rows p0 to p0 + kBlock of the gradient
  void finish(int p, const T *blurred) const;
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
void Sweep<T>::differentiate_rows(int q0) const {
  const int n = columns + 2 * kRadius * step;
  for (int m = 0; m < kInputMaps; ++m)
    blur_downwards<T, kInputMaps>(ring1 + m * kRowCapacity, q0, n, photo.window, blurred + m * kRowCapacity,
                                  kInputMaps * kRowCapacity);
  for (int o = 0; o < kBlock; ++o)
    if (q0 + o >= tile.row0 - kRadius && q0 + o < tile.row1 + kRadius)
      differentiate_row(q0 + o, blurred + o * kInputMaps * kRowCapacity);
}

template <class T>
void Sweep<T>::differentiate_row(int q, T *moments) const {
  T *out = ring2 + ring_slot(q) * kGradientMaps * kRowCapacity;
  if (q < 0 || q >= photo.height) return clear(out, kGradientMaps * kRowCapacity);
  const int n = columns + 2 * kRadius * step;
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
void Sweep<T>::finish_rows(int p0) const {
  for (int m = 0; m < kGradientMaps; ++m)
    blur_downwards<T, kGradientMaps>(ring2 + m * kRowCapacity, p0, columns, photo.window, blurred + m * kRowCapacity,
                                     kGradientMaps * kRowCapacity);
  for (int o = 0; o < kBlock; ++o)
    if (p0 + o >= tile.row0 && p0 + o < tile.row1) finish(p0 + o, blurred + o * kGradientMaps * kRowCapacity);
}

template <class T>
void Sweep<T>::finish(int p, const T *blurred) const {
  const int64_t pixel = int64_t(p) * photo.width + tile.col0, from = pixel * step;
  T *y = row + kRowCapacity;
  load_target(photo, from, columns, y);
  const bool weighted = load_weight(photo, pixel, columns, weights);
  (weighted ? combine<T, true> : combine<T, false>)(photo.render + from, y, weights, blurred, columns, photo.l1_scale,
                                                    photo.ssim_scale, photo.gradient + from, row);
  tile.l1[p] = sum_row<T, false>(row, columns);
}

template <class T>
void photometric_tile(const Photo<T> &photo, const Tile &tile, T *scratch) {
  clear(scratch, kPhotometricScratch);
  T *ring2 = scratch + kRing * kInputMaps * kRowCapacity;
  T *inputs = ring2 + kRing * kGradientMaps * kRowCapacity;
  T *blurred = inputs + kInputMaps * kRowCapacity;
  T *weights = blurred + kBlock * kInputMaps * kRowCapacity;
  const Sweep<T> sweep{photo,          tile,
                       scratch,        ring2,
                       inputs,         blurred,
                       weights,        weights + kRowCapacity,
                       photo.channels, (tile.col1 - tile.col0) * photo.channels};
  for (int r = tile.row0 - 2 * kRadius; r < tile.row1 + 2 * kRadius + kBlock - 1; r += kBlock) {
    for (int o = 0; o < kBlock; ++o) sweep.enter(r + o);
    if (r + kBlock > tile.row0) sweep.differentiate_rows(r - kRadius);
    if (r + kBlock > tile.row0 + 2 * kRadius) sweep.finish_rows(r - 2 * kRadius);
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
