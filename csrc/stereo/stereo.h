// Depth of a photo from its neighbours: plane sweep (Collins 1996) and semi-global matching (Hirschmueller 2008).
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "../common/levels.h"

namespace perception::stereo {

constexpr int kBlock = 32;                                // the number of planes is a multiple of it
constexpr int kReach = 3;                                 // the correlation window has a side of 7 pixels
constexpr float kPriorCost = 0.02f, kPriorLimit = 0.16f;  // per plane of distance from the prior depth, and the most
constexpr double kP1 = 0.06, kP2 = 0.6;  // a step to the next plane, and to any other where the photo has no gradient
constexpr float kScale = 8192;           // costs are whole numbers in this unit: sums over four directions fit 16 bits
constexpr int16_t kFar = 0x3fff;         // above every path cost

struct Image {
  const uint8_t *grey;  // [height, width]
  int width, height;
};

struct Neighbour : Image {
  const double *still, *moving;  // [3, 3] A, B: A + B / z maps pixels of the photo at depth z; centres are integers
  std::vector<uint32_t> quads;   // [height, width] the pixels (y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1), set here
};

struct Sweep : Image {
  std::vector<Neighbour> others;
  double first, step;  // inverse depth of plane i: first + step * i
  int planes;
  const float *prior;  // [height, width] depth, 0 = none
  float *depth;        // out, same shape
  // Set here. [height, width]: grey - 128; its mean and its standard deviation + 1 over the window.
  std::vector<float> centred, mean, deviation;
  int16_t jumps[256];  // P2 by the difference of grey values
  int16_t *costs;      // [height, width, planes]
  uint16_t *sums;      // of path costs, same shape
};

// The same bits for any number of threads. Memory: 4 bytes per pixel and plane, and 16 per pixel of each photo.
void sweep(Sweep &, int threads, Level);

// A line of pixels for each of `lanes` paths: `along` and `across` are steps to the next pixel and to the next path.
struct Paths {
  int64_t first, length, along, lanes, across;
};

PERCEPTION_DECLARE_LEVELS(
    // Matching costs of the rows [top, bottom) on kBlock planes.
    void match(const Sweep &, int top, int bottom, int plane, float *scratch);
    // Adds path costs, both ways, to `sums`; then the depth is chosen if these are the last.
    void aggregate(const Sweep &, const Paths &, bool last, int16_t *scratch))

inline size_t match_scratch(int width, int rows) { return size_t(width) * (12 + (2 + kBlock / 2) * rows) + 6 * kReach; }
inline size_t path_scratch(int planes, int lanes) { return size_t(planes + 2 * kBlock) * 2 * lanes; }

// Index i mirrored into [0, n) about the border pixels, which are not repeated.
inline __attribute__((always_inline)) int mirrored(int i, int n) {
  while (n > 1 && (i < 0 || i >= n)) i = i < 0 ? -i : 2 * n - 2 - i;
  return n > 1 ? i : 0;
}

}  // namespace perception::stereo
