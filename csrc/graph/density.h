// Which instance is densest at a point, given its candidate Gaussians.
#pragma once
#include <cstddef>
#include <cstdint>

namespace perception::graph {

// What a Gaussian contributes: mean, upper triangle (xx xy xz yy yz zz) of the inverse covariance, opacity, instance.
struct Gaussians {
  const float *means;       // [N, 3]
  const float *precisions;  // [N, 6]
  const float *opacities;   // [N]
  const std::int32_t *instances;
};

// labels [count]: for each of points [count, 3] the instance with the largest sum of o exp(-1/2 d' P d) over its
// candidates [count, k] (-1 = none, nearest first). Of equal sums the one with the nearer candidate; with no candidate
// -1. Densities that vanish thereby leave the decision to the nearest mean.
void densest(const Gaussians &gaussians, const float *points, const std::int32_t *candidates, std::size_t count,
             std::size_t k, int threads, std::int32_t *labels);

}  // namespace perception::graph
