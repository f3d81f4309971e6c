// Segments merged as the masks of all photos agree; the formulas stand in perception/masks/consensus.py.
#pragma once
#include <cstddef>
#include <cstdint>
#include <functional>

namespace perception::graph {

// A sparse matrix by rows: row r has the columns index[start[r]] to index[start[r + 1] - 1], ascending.
struct Rows {
  const std::int64_t *start;
  const std::int32_t *index;
  const float *value;
};

struct Segments {
  std::size_t count, masks, views, dims;
  Rows pixels;               // P [S, M]
  Rows blank;                // B [S, V]
  const std::int32_t *view;  // [M] view of each mask, ascending
  const std::int64_t *near_start;
  const std::int32_t *near;  // spatial neighbours of each segment
  const double *z;           // [S, D] mean features
  const double *sizes;       // [S] Gaussians
  double least_share, one_sided, prior, lowest;
  std::size_t many;  // of more segments, those neighbours are merged first whose affinity is at least `sure`
  double sure;
};

using Between = std::function<void()>;

// Merges the pair of largest affinity until none reaches `lowest`, which is above 0. children [S - 1, 2] and affinity
// [S - 1], out: the two nodes of each merge (0 ... S - 1: segments, then merges in order). Returns the number of merges.
// between: called between pieces of work, which take milliseconds; it may throw to end the work.
//
// Only segments that are neighbours or share a mask have an affinity above 0, so only these pairs are looked at. Of
// equal affinities the pair with the smallest numbers is merged first; the result does not depend on threads.
std::size_t merge_segments(const Segments &segments, std::int32_t *children, double *affinity, const Between &between);

}  // namespace perception::graph
