// The features' share of the work as small matrix products, a row of channels a register or more.
#pragma once
#include "simd.h"

namespace perception::PERCEPTION_LEVEL {

// Width of a row of n numbers in whole registers.
template <class T>
constexpr int padded(int n) {
  return (n + Vec<T>::kLanes - 1) / Vec<T>::kLanes * Vec<T>::kLanes;
}

// A feature row is e = f - shift and, with the variance, e² after it. The shift is a granule's own (its first splat's
// value), so that neither sum cancels however large the features are against their spread.
template <class T, int NF, bool VAR>
constexpr int kFeatureRow = padded<T>(NF * (VAR ? 2 : 1));

// The N channels of a pixel or a splat, computed on together: GCC's vector type, of as many registers as it takes. The
// same in loops over arrays stays scalar, as the compiler must assume that their memory overlaps.
template <class T, int N>
struct ChannelsOf {
  typedef T type __attribute__((vector_size(N * sizeof(T))));
};
template <class T, int N>
using Channels = typename ChannelsOf<T, N>::type;

// Channels [0, count), count a constant N or fewer; the others are zero, or are left out.
template <int N, class T, class Count>
inline __attribute__((always_inline)) Channels<T, N> load_channels(const T *from, Count count) {
  Channels<T, N> c = {};
  std::memcpy(&c, from, count * sizeof(T));
  return c;
}
template <class C, class T, class Count>
inline __attribute__((always_inline)) void store_channels(const C &c, T *to, Count count) {
  std::memcpy(to, &c, count * sizeof(T));
}

// [ROWS, COLUMNS] to [COLUMNS, ROWS], both multiples of 4.
template <int ROWS, int COLUMNS, class T>
void transpose(const T *from, T *to) {
  typedef T Four __attribute__((vector_size(4 * sizeof(T)), aligned(sizeof(T)), may_alias));
  auto in = [from](int row, int column) { return reinterpret_cast<const Four *>(from + row * COLUMNS + column); };
  auto out = [to](int row, int column) { return reinterpret_cast<Four *>(to + row * ROWS + column); };
  for (int r = 0; r < ROWS; r += 4)
    for (int c = 0; c < COLUMNS; c += 4) {
      const Four a0 = *in(r, c), a1 = *in(r + 1, c), a2 = *in(r + 2, c), a3 = *in(r + 3, c);
      const Four b0 = __builtin_shufflevector(a0, a1, 0, 4, 1, 5), b1 = __builtin_shufflevector(a0, a1, 2, 6, 3, 7);
      const Four b2 = __builtin_shufflevector(a2, a3, 0, 4, 1, 5), b3 = __builtin_shufflevector(a2, a3, 2, 6, 3, 7);
      *out(c, r) = __builtin_shufflevector(b0, b2, 0, 1, 4, 5),
              *out(c + 1, r) = __builtin_shufflevector(b0, b2, 2, 3, 6, 7);
      *out(c + 2, r) = __builtin_shufflevector(b1, b3, 0, 1, 4, 5),
                  *out(c + 3, r) = __builtin_shufflevector(b1, b3, 2, 3, 6, 7);
    }
}

// Rows worked on together: their accumulators fill half of the register file.
template <class T, int WIDTH>
constexpr int kRows = [] {
  constexpr int registers = Vec<T>::kLanes * sizeof(T) == 64 ? 16 : 8, rows = registers / (WIDTH / Vec<T>::kLanes);
  return rows < 1 ? 1 : rows > 16 ? 16 : rows;
}();

// sums[i] += Σ_k weights[k][i] rows[k] for the 16 pixels i; rows of WIDTH numbers, n of them.
template <int WIDTH, class T>
void add_weighted_rows(const T *weights, const T *rows, int n, T *sums) {
  using V = Vec<T>;
  constexpr int kVectors = WIDTH / V::kLanes, kBlock = kRows<T, WIDTH>;
  for (int i0 = 0; i0 < 16; i0 += kBlock) {
    V acc[kBlock][kVectors];
    for (int i = 0; i < kBlock; ++i)
      for (int v = 0; v < kVectors; ++v) acc[i][v] = V::load(sums + (i0 + i) * WIDTH + v * V::kLanes);
    for (int k = 0; k < n; ++k) {
      V row[kVectors];
      for (int v = 0; v < kVectors; ++v) row[v] = V::load(rows + static_cast<std::size_t>(k) * WIDTH + v * V::kLanes);
      for (int i = 0; i < kBlock; ++i) {
        const V w(weights[16 * k + i0 + i]);
        for (int v = 0; v < kVectors; ++v) acc[i][v] = fma(w, row[v], acc[i][v]);
      }
    }
    for (int i = 0; i < kBlock; ++i)
      for (int v = 0; v < kVectors; ++v) acc[i][v].store(sums + (i0 + i) * WIDTH + v * V::kLanes);
  }
}

// out(k) = Σ_i left(k)[i] right[i] (or added to it) for i < INNER, rows of WIDTH numbers. n is rounded up to at most 8
// (more pointers than that leave the integer registers): left and out must take the rows that follow.
template <int INNER, int WIDTH, bool ADD, class T, class Left, class Out>
void multiply_rows(int n, Left &&left, const T *right, Out &&out) {
  using V = Vec<T>;
  constexpr int kVectors = WIDTH / V::kLanes, kBlock = kRows<T, WIDTH> < 8 ? kRows<T, WIDTH> : 8;
  for (int k0 = 0; k0 < n; k0 += kBlock) {
    const T *from[kBlock];
    for (int k = 0; k < kBlock; ++k) from[k] = left(k0 + k);
    V acc[kBlock][kVectors];
    for (auto &row : acc)
      for (V &v : row) v = V(T(0));
    for (int i = 0; i < INNER; ++i) {
      V row[kVectors];
      for (int v = 0; v < kVectors; ++v) row[v] = V::load(right + i * WIDTH + v * V::kLanes);
      for (int k = 0; k < kBlock; ++k) {
        const V a(from[k][i]);
        for (int v = 0; v < kVectors; ++v) acc[k][v] = fma(a, row[v], acc[k][v]);
      }
    }
    for (int k = 0; k < kBlock; ++k) {
      T *to = out(k0 + k);
      for (int v = 0; v < kVectors; ++v) {
        if constexpr (ADD) acc[k][v] = acc[k][v] + V::load(to + v * V::kLanes);
        acc[k][v].store(to + v * V::kLanes);
      }
    }
  }
}

}  // namespace perception::PERCEPTION_LEVEL
