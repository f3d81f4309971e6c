// The geometry shared by both passes: a 64x64-pixel tile has 16 tiles of 16x16, each of these 16 granules of 4x4
// pixels, so one test of 16 boxes serves every level and gives a 16-bit mask.
#pragma once
#include <cstring>

#include "constants.h"
#include "rasterizer.h"
#include "simd.h"

namespace perception::PERCEPTION_LEVEL {

// First pixel centres of the 16 boxes of a parent whose boxes are `step` pixels wide; pixel centres of a granule.
template <class T>
struct Grid {
  alignas(64) T box_x[2][16], box_y[2][16];  // [0]: 16x16 tiles of a 64x64 tile, [1]: granules of a 16x16 tile
  constexpr Grid() : box_x(), box_y() {
    for (int i = 0; i < 16; ++i)
      for (int level = 0; level < 2; ++level) {
        const int step = level == 0 ? 16 : 4;
        box_x[level][i] = T((i & 3) * step + 0.5), box_y[level][i] = T((i >> 2) * step + 0.5);
      }
  }
};
template <class T>
inline constexpr Grid<T> kGrid;

// Bit i: the splat's exponent may reach the threshold somewhere in box i. (x, y): the mean relative to the parent.
// The largest exponent over a box lies at the mean or on one of the two edges that face it.
template <class T, int LEVEL>
inline uint32_t boxes_touched(const Splat<T> &s, T x, T y) {
  using V = Vec<T>;
  constexpr T kExtent = LEVEL == 0 ? 15 : 3;  // from the first to the last pixel centre
  const V zero(T(0)), extent(kExtent), mx(x), my(y), a(s.a), d(s.d), k(s.k), minus_k(-s.k), slope(s.slope),
      limit(-s.reach);
  uint32_t mask = 0;
  for (int p = 0; p < kParts<T>; ++p) {
    const V x0 = V::load(kGrid<T>.box_x[LEVEL] + p * V::kLanes) - mx,
            y0 = V::load(kGrid<T>.box_y[LEVEL] + p * V::kLanes) - my;
    const V x1 = x0 + extent, y1 = y0 + extent;
    const V near_x = min(x1, max(x0, zero)), near_y = min(y1, max(y0, zero));
    const V best_y = min(y1, max(y0, near_x * slope)), best_x = min(x1, max(x0, near_y * minus_k));
    const V u1 = fma(k, best_y, near_x), u2 = fma(k, near_y, best_x);
    const V e1 = fma(a * u1, u1, d * best_y * best_y), e2 = fma(a * u2, u2, d * near_y * near_y);
    mask |= bits(max(e1, e2) >= limit) << (p * V::kLanes);
  }
  return mask;
}

// A pixel that takes no more (opaque, or outside the image) stands this far to the right, out of every splat's reach.
template <class T>
constexpr T kFar = T(1e18);

// One splat over some pixels: everything the two passes must compute alike.
template <class T>
struct Blend {
  Pack<T> u, dy;   // px
  Pack<T> raw;     // alpha before the clamp
  Pack<T> weight;  // alpha T, 0 where the splat does not contribute
  Pack<T> next;    // transmittance behind
  PackMask<T> on;  // where it contributes
};

// Pixels that would fall under the least transmittance stop before: px moves to kFar, `stopped` becomes true.
template <class T>
inline Blend<T> blend(const Splat<T> &s, Pack<T> &px, Pack<T> py, Pack<T> transmittance, bool &stopped) {
  using P = Pack<T>;
  const P dx = P(s.x) - px, dy = P(s.y) - py, u = fma(P(s.k), dy, dx);
  const P e = fma(P(s.a) * u, u, fma(P(s.d) * dy, dy, P(s.log_opacity))), raw = exp2_nonpositive(e);
  PackMask<T> on = e >= P(kLogThreshold<T>);
  P weight = keep(on, min(raw, P(kMaxAlpha<T>)) * transmittance);
  P next = transmittance - weight;
  const PackMask<T> stop = next < P(kMinTransmittance<T>);
  if (__builtin_expect(any(stop), 0)) {
    stopped = true;
    px = select(stop, P(kFar<T>), px);
    weight = select(stop, P(T(0)), weight);
    next = select(stop, transmittance, next);
    on = and_not(on, stop);
  }
  return {u, dy, raw, weight, next, on};
}

// Bit i: pixel i of granule g of the 16x16 tile at (x, y) lies in the image.
inline uint32_t pixels_inside(int x, int y, int g, int width, int height) {
  if (x + 16 <= width && y + 16 <= height) return 0xffff;
  uint32_t m = 0;
  for (int i = 0; i < 16; ++i)
    m |= static_cast<uint32_t>(x + (g & 3) * 4 + (i & 3) < width && y + (g >> 2) * 4 + (i >> 2) < height) << i;
  return m;
}

// Pixel centres of granule g of the 16x16 tile at (tile_x, tile_y) of its 64x64 tile; those not in `inside` are far.
template <class T>
inline void granule_pixels(int tile_x, int tile_y, int g, uint32_t inside, T *px, T *py) {
  const T x = T(tile_x) + kGrid<T>.box_x[1][g], y = T(tile_y) + kGrid<T>.box_y[1][g];
  for (int i = 0; i < 16; ++i) px[i] = inside >> i & 1 ? x + T(i & 3) : kFar<T>, py[i] = y + T(i >> 2);
}

// Row `row` of a 16x16 tile (16 pixels) to and from the four granules it crosses; granule(g) is the channel of one.
template <class T, class Granule>
inline void row_to_granules(const T *values, int row, Granule &&granule) {
  for (int q = 0; q < 4; ++q) std::memcpy(granule((row >> 2) * 4 + q) + (row & 3) * 4, values + 4 * q, 4 * sizeof(T));
}
template <class T, class Granule>
inline void row_from_granules(Granule &&granule, int row, T *values) {
  for (int q = 0; q < 4; ++q) std::memcpy(values + 4 * q, granule((row >> 2) * 4 + q) + (row & 3) * 4, 4 * sizeof(T));
}

}  // namespace perception::PERCEPTION_LEVEL
