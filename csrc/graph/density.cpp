#include "density.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "../common/parallel.h"

namespace perception::graph {
namespace {

float density(const Gaussians &g, std::size_t i, const float *point) {
  const float x = point[0] - g.means[3 * i], y = point[1] - g.means[3 * i + 1], z = point[2] - g.means[3 * i + 2];
  const float *p = g.precisions + 6 * i;
  const float power = p[0] * x * x + p[3] * y * y + p[5] * z * z + 2 * (p[1] * x * y + p[2] * x * z + p[4] * y * z);
  return power < 80.f ? g.opacities[i] * std::exp(-0.5f * power) : 0.f;
}

struct Sum {
  std::int32_t instance;
  float total;
};

std::int32_t winner(const Gaussians &g, const float *point, const std::int32_t *candidates, std::size_t k,
                    std::vector<Sum> &sums) {
  sums.clear();
  for (std::size_t j = 0; j < k && candidates[j] >= 0; ++j) {
    const auto i = static_cast<std::size_t>(candidates[j]);
    const float d = density(g, i, point);
    const std::int32_t instance = g.instances[i];
    const auto known = std::find_if(sums.begin(), sums.end(), [=](const Sum &s) { return s.instance == instance; });
    if (known == sums.end()) {
      sums.push_back({instance, d});
    } else {
      known->total += d;
    }
  }
  if (sums.empty()) return -1;
  // The first of equals stands for the nearest mean.
  return std::max_element(sums.begin(), sums.end(), [](const Sum &a, const Sum &b) { return a.total < b.total; })
      ->instance;
}

}  // namespace

void densest(const Gaussians &gaussians, const float *points, const std::int32_t *candidates, std::size_t count,
             std::size_t k, int threads, std::int32_t *labels) {
  parallel_pieces(threads, Pieces(count, 1024, 256), [&](std::size_t begin, std::size_t end) {
    std::vector<Sum> sums;
    for (std::size_t i = begin; i < end; ++i) {
      labels[i] = winner(gaussians, points + 3 * i, candidates + i * k, k, sums);
    }
  });
}

}  // namespace perception::graph
