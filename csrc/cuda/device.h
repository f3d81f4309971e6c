// What the kernels share: the arrays they take, a splat, a pixel and how the two meet.
//
// One source for two compilers: NVRTC on the user's machine, and the system's compiler for the tests, which run the
// thread blocks on the CPU (emulate.h). Macros fix the shape: REAL (float or double), NF (feature channels of this
// slice, 0 to 8), VARIANCE and DEPTH (0 or 1). The structs are filled in by perception/rasterizer/device.py.
#pragma once
#ifndef __CUDACC__
#include "emulate.h"
#else
#define SHARED(Type) Type    // the emulator tracks who reads and writes the elements
#define GLOBAL(Type) Type *  // and checks that they lie within the arrays given
#endif
#include "constants.h"
#include "projection_math.h"
#include "spherical_harmonics.h"

namespace perception {

using T = REAL;
using Index = long long;
using Reals = GLOBAL(const T);
using Results = GLOBAL(T);

constexpr int kWarp = 32, kThreads = 256, kWarps = kThreads / kWarp;
constexpr int kTile = 16;                             // pixels; a thread block works on one tile
constexpr int kGranuleWidth = 8, kGranuleHeight = 4;  // pixels; a warp works on one granule
constexpr int kMoments = 12;                          // numbers of a gradient record before its feature channels
constexpr int kRecord = kMoments + NF;
constexpr int kFeatures = NF ? NF : 1;  // an array's least length
constexpr int kWide = kWarp;            // with more tiles a Gaussian is worked on by a whole warp, not by one thread
constexpr unsigned kAllLanes = 0xffffffffu;

// A Gaussian as one camera sees it. Exponent in base 2: log2(alpha) = log_opacity + a (dx + k dy)² + d dy².
struct Splat {
  T x, y;  // px
  T a, k, d, log_opacity;
  T rgb[3], z;
  T reach;  // log_opacity - log2(1/255) + slack: how far the exponent may fall
  T slope;  // dy/dx of the line on which the exponent is largest for a given dx
};
constexpr int kSplat = sizeof(Splat) / sizeof(T);

struct Box {
  int x0, y0, x1, y1;  // tiles, inclusive; x1 < x0: none
};

// The Gaussians (rasterizer.h has the shapes) and one camera. features: this slice's first channel, in rows of `dims`.
struct Scene {
  Reals means, quats, scales, opacities, colors, features, viewmat, K, background;
  int n, sh_degree, sh_stride, dims, width, height;
  T near_plane, eps2d;
};

// Written by project_kernel. depths is infinite and radii zero on entry; first_bad: N on entry, then the lowest index
// of a Gaussian with a parameter that is not finite, or -1 if the camera has one.
struct Projection {
  GLOBAL(Splat) splats;
  GLOBAL(Box) boxes;
  Results depths, radii;
  GLOBAL(int) first_bad;
};

// Tile rows [first_row, end_row) of the image. Memory that grows with the number of (Gaussian, tile) pairs is held for
// one strip at a time.
struct Strip {
  GLOBAL(const Splat) splats;
  GLOBAL(const Box) boxes;
  GLOBAL(const int) front_to_back;  // [N] Gaussians by depth
  GLOBAL(const Index) ends;  // [N] end of their slots, in that order; a Gaussian has a slot for every tile it touches
  int n, first_row, end_row, tiles_x;
};

// The splats of tile t of the strip, front to back: ids[starts[t]] to ids[starts[t + 1] - 1], and their slots.
struct Lists {
  GLOBAL(const int) ids;
  GLOBAL(const Index) slots;
  GLOBAL(const Index) starts;
};

// Of one camera, channels last. colors, alphas, depths and visible are null but for the first slice.
struct Images {
  Results colors, alphas, depths, features, variance;
  GLOBAL(unsigned char) visible;  // [N]
};

// dL/d(image); null means zero.
struct Cotangents {
  Reals colors, alphas, depths, features, variance;
};

// dL/d(input), added to what is there; null where not wanted. camera: [N,12] each Gaussian's dL/dR, dL/dt.
// stored: with respect to the logarithms of the scales and the logits of the opacities. fresh, fresh_features: what is
// there is replaced, for the Gaussians with records; in the features, and in all else.
struct Gradients {
  Results means, quats, scales, opacities, colors, features, camera, mean2d, absgrad;
  int stored, fresh, fresh_features;
};

static __device__ inline T lower(T a, T b) { return a < b ? a : b; }
static __device__ inline T higher(T a, T b) { return a > b ? a : b; }
static __device__ inline T clamped(T x, T low, T high) { return lower(higher(x, low), high); }
static __device__ inline T magnitude(T x) { return higher(x, -x); }
static __device__ inline int lower(int a, int b) { return a < b ? a : b; }
static __device__ inline int higher(int a, int b) { return a > b ? a : b; }

// The two functions that cost most take the hardware's approximations (two units in the last place) in float.
static __device__ inline double fast_exp2(double x) { return exp2(x); }
static __device__ inline double fast_ratio(double x, double y) { return x / y; }
#ifdef __CUDACC__
static __device__ inline float fast_exp2(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
static __device__ inline float fast_ratio(float x, float y) { return __fdividef(x, y); }
#else
inline float fast_exp2(float x) { return exp2(x); }
inline float fast_ratio(float x, float y) { return x / y; }
#endif

// Number c of a Gaussian's splat.
static __device__ inline T splat_number(const Strip &strip, int id, int c) {
  return reinterpret_cast<const T *>(&strip.splats[id])[c];
}

static __device__ inline Splat read_splat(const SHARED(T) * v) {
  return {v[0], v[1], v[2], v[3], v[4], v[5], {v[6], v[7], v[8]}, v[9], v[10], v[11]};
}

// May the splat's exponent reach the threshold at a pixel centre of the box whose first centre is (x, y)? The largest
// exponent over a box lies at the mean or on one of the two edges that face it. Every multiply-add is written out, so
// that each kernel comes to the same answer.
static __device__ inline bool touches(const Splat &s, T x, T y, T extent_x, T extent_y) {
  const T x0 = x - s.x, y0 = y - s.y, x1 = x0 + extent_x, y1 = y0 + extent_y;
  const T near_x = lower(x1, higher(x0, T(0))), near_y = lower(y1, higher(y0, T(0)));
  const T best_y = lower(y1, higher(y0, near_x * s.slope)), best_x = lower(x1, higher(x0, near_y * -s.k));
  const T u1 = fma(s.k, best_y, near_x), u2 = fma(s.k, near_y, best_x);
  const T e1 = fma(s.a * u1, u1, s.d * best_y * best_y), e2 = fma(s.a * u2, u2, s.d * near_y * near_y);
  return higher(e1, e2) >= -s.reach;
}

// Adds the columns of the first `rows` rows to column 0, which thread 0 may read then.
template <int ROWS>
static __device__ inline void add_threads(SHARED(double) (&sums)[ROWS][kThreads], int rows) {
  for (int half = kThreads / 2; half; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half)
      for (int j = 0; j < rows; ++j) sums[j][threadIdx.x] = sums[j][threadIdx.x] + sums[j][threadIdx.x + half];
  }
}

// The pixel of this thread, in the tile of this block.
struct Pixel {
  int lane, warp;
  bool inside;
  T x, y;                  // centre
  T granule_x, granule_y;  // first centre of the warp's granule
  Index at;                // in the image
};

static __device__ inline Pixel pixel_of(const Scene &scene, const Strip &strip) {
  Pixel p;
  p.lane = threadIdx.x % kWarp, p.warp = threadIdx.x / kWarp;
  const int tile_x = blockIdx.x % strip.tiles_x, tile_y = strip.first_row + blockIdx.x / strip.tiles_x;
  const int x0 = tile_x * kTile + p.warp % 2 * kGranuleWidth, y0 = tile_y * kTile + p.warp / 2 * kGranuleHeight;
  const int x = x0 + p.lane % kGranuleWidth, y = y0 + p.lane / kGranuleWidth;
  p.inside = x < scene.width && y < scene.height;
  p.x = x + T(0.5), p.y = y + T(0.5), p.granule_x = x0 + T(0.5), p.granule_y = y0 + T(0.5);
  p.at = static_cast<Index>(y) * scene.width + x;
  return p;
}

static __device__ inline bool touches_granule(const Splat &s, const Pixel &p) {
  return touches(s, p.granule_x, p.granule_y, kGranuleWidth - 1, kGranuleHeight - 1);
}

// One splat at one pixel: what both passes must compute alike, so again with every multiply-add written out.
struct Blend {
  T u, dy;   // px
  T raw;     // alpha before the clamp
  T weight;  // alpha times the transmittance
  T next;    // transmittance behind
};

// False where the splat adds nothing. A pixel that would fall under the least transmittance closes before.
static __device__ inline bool blend(const Splat &s, const Pixel &p, T transmittance, bool &open, Blend &b) {
  b.dy = s.y - p.y, b.u = fma(s.k, b.dy, s.x - p.x);
  const T e = fma(s.a * b.u, b.u, fma(s.d * b.dy, b.dy, s.log_opacity));
  if (!(open && e >= kLogThreshold<T>)) return false;
  b.raw = fast_exp2(e);
  const T alpha = lower(b.raw, kMaxAlpha<T>);
  b.weight = alpha * transmittance, b.next = fma(-alpha, transmittance, transmittance);
  open = b.next >= kMinTransmittance<T>;
  return open;
}

}  // namespace perception
