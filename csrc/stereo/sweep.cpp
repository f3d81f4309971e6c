#include <algorithm>
#include <cmath>
#include <memory>

#include "../common/parallel.h"
#include "stereo.h"

namespace perception::stereo {
namespace {

constexpr int kRows = 40;  // of a matching task

void prepare(Neighbour &other) {
  const int w = other.width, h = other.height;
  other.quads.resize(size_t(w) * h);
  for (int y = 0; y < h; ++y)
    for (int x = 0; x < w; ++x) {
      const uint8_t *upper = other.grey + size_t(y) * w, *lower = y + 1 < h ? upper + w : upper;
      const int next = std::min(x + 1, w - 1);
      other.quads[size_t(y) * w + x] = upper[x] | upper[next] << 8 | lower[x] << 16 | uint32_t(lower[next]) << 24;
    }
}

void measure_windows(Sweep &s, int y) {
  std::vector<int> sums(s.width), squares(s.width);  // over the rows of the window
  for (int k = -kReach; k <= kReach; ++k)
    for (int x = 0; x < s.width; ++x) {
      const int grey = s.grey[size_t(mirrored(y + k, s.height)) * s.width + x] - 128;
      sums[x] += grey, squares[x] += grey * grey;
    }
  for (int x = 0; x < s.width; ++x) {
    int sum = 0, square = 0;
    for (int k = -kReach; k <= kReach; ++k) sum += sums[mirrored(x + k, s.width)];
    for (int k = -kReach; k <= kReach; ++k) square += squares[mirrored(x + k, s.width)];
    const size_t at = size_t(y) * s.width + x;
    s.centred[at] = s.grey[at] - 128.0f;
    s.mean[at] = sum / 49.0f;
    s.deviation[at] = static_cast<float>(std::sqrt(49.0 * square - double(sum) * sum) / 49 + 1);
  }
}

}  // namespace

void sweep(Sweep &s, int threads, Level level) {
  threads = resolve_threads(threads);
  const int bands = (s.height + kRows - 1) / kRows, blocks = s.planes / kBlock;
  const size_t pixels = size_t(s.width) * s.height;
  for (auto *map : {&s.centred, &s.mean, &s.deviation}) map->resize(pixels);
  parallel_for(threads, s.others.size(), [&](size_t i, int) { prepare(s.others[i]); });
  parallel_for(threads, s.height, [&](size_t y, int) { measure_windows(s, static_cast<int>(y)); });
  for (int step = 0; step < 256; ++step)
    s.jumps[step] = static_cast<int16_t>(std::lround(kScale * std::max(kP2 / (1 + step / 8.0), 1.5 * kP1)));
  const std::unique_ptr<int16_t[]> costs(new int16_t[pixels * s.planes]);
  s.costs = costs.get();
  parallel_for(threads, size_t(bands) * blocks, [&](size_t task, int) {
    const int top = static_cast<int>(task) / blocks * kRows, plane = static_cast<int>(task) % blocks * kBlock;
    const std::unique_ptr<float[]> scratch(new float[match_scratch(s.width, kRows)]);
    PERCEPTION_AT_LEVEL(level, match)(s, top, std::min(top + kRows, s.height), plane, scratch.get());
  });
  const std::unique_ptr<uint16_t[]> sums(new uint16_t[pixels * s.planes]());
  s.sums = sums.get();
  auto aggregate = [&](int64_t lines, int64_t across, int64_t length, int64_t along, int64_t lanes, bool last) {
    parallel_for(threads, (lines + lanes - 1) / lanes, [&](size_t task, int) {
      const int64_t line = static_cast<int64_t>(task) * lanes;
      const Paths paths{line * across, length, along, std::min(lanes, lines - line), across};
      const std::unique_ptr<int16_t[]> scratch(new int16_t[path_scratch(s.planes, lanes)]);
      PERCEPTION_AT_LEVEL(level, aggregate)(s, paths, last, scratch.get());
    });
  };
  aggregate(s.width, 1, s.height, s.width, 32, false);
  aggregate(s.height, s.width, s.width, 1, 4, true);
}

}  // namespace perception::stereo
