// Compiled once per instruction set, see CMakeLists.txt.
#include "stereo.h"

namespace perception::stereo::PERCEPTION_LEVEL {
namespace {

template <class T>
inline __attribute__((always_inline)) T least_of(T a, T b) {
  return b < a ? b : a;
}
template <class T>
inline __attribute__((always_inline)) T most_of(T a, T b) {
  return b > a ? b : a;
}

struct Span {
  int begin, end;
};

// The columns of a row that the homography takes into the other image, in front of its camera. origin, slope: the
// homogeneous coordinates at column 0 and their change per column.
Span inside(const Image &other, const double *origin, const double *slope, int width) {
  const double right = other.width - 1, bottom = other.height - 1;
  const double limits[5][2] = {{origin[2] - 1e-6, slope[2]},
                               {origin[0], slope[0]},
                               {origin[1], slope[1]},
                               {right * origin[2] - origin[0], right * slope[2] - slope[0]},
                               {bottom * origin[2] - origin[1], bottom * slope[2] - slope[1]}};
  double first = 0, last = width - 1;
  for (const auto &[at, per] : limits) {  // at + per * x >= 0
    if (per > 0) first = most_of(first, __builtin_ceil(-at / per));
    if (per < 0) last = least_of(last, __builtin_floor(at / -per));
    if (per == 0 && !(at >= 0)) last = -1;
  }
  return first <= last ? Span{static_cast<int>(first), static_cast<int>(last) + 1} : Span{width, 0};
}

// Grey values - 128 of the other image under row y, 0 outside. They are rounded to 1/4, so that sums of 49 squares are
// exact in float and running sums do not drift.
Span warp(const Neighbour &other, const double *H, int y, int width, float *__restrict out) {
  double origin[3], slope[3];
  for (int i = 0; i < 3; ++i) origin[i] = H[3 * i + 1] * y + H[3 * i + 2], slope[i] = H[3 * i];
  const Span span = inside(other, origin, slope, width);
  for (int x = 0; x < width; ++x) out[x] = 0;
  const float u0 = origin[0], v0 = origin[1], w0 = origin[2], du = slope[0], dv = slope[1], dw = slope[2];
  const float right = other.width - 1, bottom = other.height - 1;
  const uint32_t *quads = &other.quads[0];
  constexpr float kQuarters = 3 << 20;  // the float numbers near it are multiples of 1/4
  for (int x = span.begin; x < span.end; ++x) {
    const float column = x, scale = 1 / (w0 + dw * column);
    const float u = least_of(most_of(0.0f, (u0 + du * column) * scale), right);  // not a number: 0
    const float v = least_of(most_of(0.0f, (v0 + dv * column) * scale), bottom);
    const int i = static_cast<int>(u), j = static_cast<int>(v);
    const uint32_t q = quads[j * other.width + i];
    const float a = static_cast<int>(q & 255), b = static_cast<int>(q >> 8 & 255);
    const float c = static_cast<int>(q >> 16 & 255), d = static_cast<int>(q >> 24);
    const float upper = a + (u - i) * (b - a), lower = c + (u - i) * (d - c);
    out[x] = upper + (v - j) * (lower - upper) + (kQuarters - 128) - kQuarters;
  }
  return span;
}

// Sums over the rows of the window, of the warped values, their squares and their products with the photo's, for every
// column and kReach more to each side.
struct Running {
  float *value, *square, *product;

  void slide(const float *__restrict in, const float *__restrict grey_in, const float *__restrict out,
             const float *__restrict grey_out, int width) {
    float *__restrict v = value, *__restrict s = square, *__restrict p = product;
    for (int x = 0; x < width; ++x) {
      v[x] += in[x] - out[x];
      s[x] += in[x] * in[x] - out[x] * out[x];
      p[x] += in[x] * grey_in[x] - out[x] * grey_out[x];
    }
  }
  void mirror(int width) {
    for (float *sums : {value, square, product})
      for (int i = 1; i <= kReach; ++i) {
        sums[-i] = sums[mirrored(-i, width)];
        sums[width - 1 + i] = sums[mirrored(width - 1 + i, width)];
      }
  }
};

inline __attribute__((always_inline)) float across(const float *sums) {
  return ((sums[-3] + sums[-2]) + (sums[-1] + sums[0])) + ((sums[1] + sums[2]) + sums[3]);
}

// Keeps the two largest correlations of each pixel.
inline __attribute__((always_inline)) void keep(float score, float &best, float &second) {
  second = most_of(second, least_of(best, score));
  best = most_of(best, score);
}

void score(const Running &sums, int begin, int end, const float *__restrict mean, const float *__restrict deviation,
           float *__restrict best, float *__restrict second) {
  const float *__restrict value = sums.value, *__restrict square = sums.square, *__restrict product = sums.product;
  constexpr float kShare = 1.0f / 49;
  for (int x = begin; x < end; ++x) {
    const float seen = across(value + x) * kShare, variance = across(square + x) * kShare - seen * seen;
    const float shared = across(product + x) * kShare - seen * mean[x];
    const float spread = __builtin_sqrtf(variance > 0 ? variance : 0) + 1;
    keep(shared / (spread * deviation[x]), best[x], second[x]);
  }
}

void correlate(const Sweep &s, const Neighbour &other, double inverse, int top, int bottom, float *best, float *second,
               float *scratch) {
  const int w = s.width, h = s.height, padded = w + 2 * kReach;
  const float *const centred = &s.centred[0];
  double H[9];
  for (int i = 0; i < 9; ++i) H[i] = other.still[i] + inverse * other.moving[i];
  float *const ring = scratch, *const none = ring + 8 * w, *const sums = none + w;
  for (int x = 0; x < w + 3 * padded; ++x) none[x] = 0;
  Running running{sums + kReach, sums + padded + kReach, sums + 2 * padded + kReach};
  Span spans[8];  // of the rows in the ring
  int next = most_of(0, top - kReach);
  for (int y = top; y < bottom; ++y) {
    for (; next < least_of(h, y + kReach + 1); ++next) spans[next & 7] = warp(other, H, next, w, ring + (next & 7) * w);
    for (int k = y == top ? -kReach : kReach; k <= kReach; ++k) {
      const int in = mirrored(y + k, h), out = mirrored(y - kReach - 1, h);
      running.slide(ring + (in & 7) * w, centred + size_t(in) * w, y == top ? none : ring + (out & 7) * w,
                    centred + size_t(out) * w, w);
    }
    running.mirror(w);
    // What lies inside is convex: a window does if its corners do. Elsewhere there is no evidence.
    const Span a = spans[most_of(0, y - kReach) & 7], b = spans[least_of(h - 1, y + kReach) & 7];
    int begin = most_of(a.begin, b.begin), end = least_of(a.end, b.end);
    begin += begin > 0 ? kReach : 0, end -= end < w ? kReach : 0;
    if (begin >= end) begin = end = 0;
    const size_t at = size_t(y - top) * w;
    for (int x = 0; x < begin; ++x) keep(0, best[at + x], second[at + x]);
    for (int x = end; x < w; ++x) keep(0, best[at + x], second[at + x]);
    score(running, begin, end, &s.mean[size_t(y) * w], &s.deviation[size_t(y) * w], best + at, second + at);
  }
}

// One pixel further along a path (equation 13 of the paper): next = cost + min(path at d, path at d +- 1 + P1,
// least + P2) - least. path has kFar before and after it. Returns the least of `next`.
inline __attribute__((always_inline)) int16_t advance(const int16_t *__restrict cost, const int16_t *__restrict path,
                                                      int16_t least, int16_t jump, int planes,
                                                      int16_t *__restrict next) {
  constexpr int16_t kStep = static_cast<int16_t>(kP1 * kScale + 0.5);
  const int16_t farthest = least + jump;
  int16_t smallest = kFar;
  for (int d = 0; d < planes; ++d) {
    const int16_t beside = least_of(path[d - 1], path[d + 1]) + kStep;
    const int16_t cheapest = least_of(least_of(path[d], farthest), beside);
    next[d] = cost[d] + cheapest - least;
    smallest = least_of(smallest, next[d]);
  }
  return smallest;
}

float choose(const Sweep &s, const uint16_t *total) {
  uint16_t smallest = total[0];
  for (int d = 1; d < s.planes; ++d) smallest = least_of(smallest, total[d]);
  int best = 0;
  while (total[best] != smallest) ++best;
  best = least_of(most_of(best, 1), s.planes - 2);
  const int low = total[best - 1], high = total[best + 1], curvature = low + high - 2 * total[best];
  const double vertex = curvature > 0 ? 0.5 * (low - high) / curvature : 0;  // of the parabola through the three
  return static_cast<float>(1 / (s.first + s.step * (best + least_of(most_of(vertex, -0.5), 0.5))));
}

}  // namespace

void match(const Sweep &s, int top, int bottom, int plane, float *scratch) {
  const size_t pixels = size_t(bottom - top) * s.width, at = size_t(top) * s.width;
  float *const best = scratch, *const second = best + pixels, *const work = second + pixels;
  int16_t *const block = reinterpret_cast<int16_t *>(work + 12 * s.width + 6 * kReach);
  for (int k = 0; k < kBlock; ++k) {
    for (size_t i = 0; i < pixels; ++i) best[i] = second[i] = -2;
    const double inverse = s.first + s.step * (plane + k);
    for (const Neighbour &other : s.others) correlate(s, other, inverse, top, bottom, best, second, work);
    const float *const runner_up = &s.others[0] + 1 == s.others.data() + s.others.size() ? best : second;
    const float first = s.first, scale = 1 / s.step, index = plane + k;
    for (size_t i = 0; i < pixels; ++i) {
      const float prior = s.prior[at + i], away = (1 / prior - first) * scale - index;
      const float penalty = prior > 0 ? least_of(kPriorLimit, kPriorCost * most_of(away, -away)) : 0;
      const float cost = 0.5f - 0.25f * (best[i] + runner_up[i]) + penalty;
      block[k * pixels + i] = static_cast<int16_t>(static_cast<int>(most_of(0.0f, cost) * kScale + 0.5f));
    }
  }
  for (size_t i = 0; i < pixels; ++i)
    for (int k = 0; k < kBlock; ++k) s.costs[(at + i) * s.planes + plane + k] = block[k * pixels + i];
}

void aggregate(const Sweep &s, const Paths &p, bool last, int16_t *scratch) {
  const int stride = s.planes + 2 * kBlock;
  for (const int way : {1, -1}) {
    for (int i = 0; i < 2 * p.lanes * stride; ++i) scratch[i] = 0;  // before the first pixel nothing was paid
    for (int i = 0; i < 2 * p.lanes; ++i) scratch[i * stride + kBlock - 1] = scratch[(i + 1) * stride - kBlock] = kFar;
    for (int64_t i = 0; i < p.length; ++i)
      for (int64_t lane = 0; lane < p.lanes; ++lane) {
        const int64_t pixel = p.first + p.along * (way > 0 ? i : p.length - 1 - i) + p.across * lane;
        const int step = i ? int(s.grey[pixel]) - int(s.grey[pixel - way * p.along]) : 0;
        int16_t *path[2] = {scratch + 2 * lane * stride + kBlock, scratch + (2 * lane + 1) * stride + kBlock};
        int16_t *least = path[0] - kBlock;  // in the space before it
        uint16_t *__restrict sums = s.sums + pixel * s.planes;
        const int16_t *now = path[i & 1], jump = s.jumps[step < 0 ? -step : step];
        *least = advance(s.costs + pixel * s.planes, path[~i & 1], *least, jump, s.planes, path[i & 1]);
        for (int d = 0; d < s.planes; ++d) sums[d] += now[d];
        if (last && way < 0) s.depth[pixel] = choose(s, sums);
      }
  }
}

}  // namespace perception::stereo::PERCEPTION_LEVEL
