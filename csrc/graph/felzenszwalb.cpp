#include "felzenszwalb.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "../common/parallel.h"

namespace perception::graph {
namespace {

struct Edge {
  float weight;
  std::int32_t a, b;  // a < b
  bool operator<(const Edge &o) const {
    if (weight != o.weight) return weight < o.weight;
    return a != o.a ? a < o.a : b < o.b;
  }
};

class Forest {
 public:
  explicit Forest(std::size_t nodes) : parent_(nodes), size_(nodes, 1) {
    for (std::size_t i = 0; i < nodes; ++i) parent_[i] = static_cast<std::int32_t>(i);
  }
  std::int32_t find(std::int32_t x) {
    while (parent_[x] != x) x = parent_[x] = parent_[parent_[x]];
    return x;
  }
  std::int32_t join(std::int32_t a, std::int32_t b) {  // two different roots; returns the root of both
    if (size_[a] < size_[b]) std::swap(a, b);
    parent_[b] = a;
    size_[a] += size_[b];
    return a;
  }
  std::size_t size(std::int32_t root) const { return size_[root]; }

 private:
  std::vector<std::int32_t> parent_;
  std::vector<std::uint32_t> size_;
};

std::vector<Edge> sorted_edges(const std::int32_t *edges, const float *weights, std::size_t count) {
  std::vector<Edge> sorted(count);
  for (std::size_t i = 0; i < count; ++i) {
    const auto [a, b] = std::minmax(edges[2 * i], edges[2 * i + 1]);
    sorted[i] = {weights[i], a, b};
  }
  const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(count / 2);
  parallel_for(2, 2, [&](std::size_t half, int) {
    std::sort(half == 0 ? sorted.begin() : middle, half == 0 ? middle : sorted.end());
  });
  std::inplace_merge(sorted.begin(), middle, sorted.end());
  return sorted;
}

std::size_t number(Forest &forest, std::size_t nodes, std::int32_t *labels) {
  std::vector<std::int32_t> name(nodes, -1);
  std::int32_t next = 0;
  for (std::size_t i = 0; i < nodes; ++i) {
    std::int32_t &n = name[forest.find(static_cast<std::int32_t>(i))];
    if (n < 0) n = next++;
    labels[i] = n;
  }
  return static_cast<std::size_t>(next);
}

}  // namespace

std::size_t segment(const std::int32_t *edges, const float *weights, std::size_t num_edges, std::size_t nodes, float k,
                    std::size_t min_size, std::int32_t *labels) {
  const std::vector<Edge> sorted = sorted_edges(edges, weights, num_edges);
  Forest forest(nodes);
  std::vector<float> threshold(nodes, k);  // Int(C) + k / |C|, the right side of the paper's equation 4
  for (const Edge &e : sorted) {
    const std::int32_t a = forest.find(e.a), b = forest.find(e.b);
    if (a == b || e.weight > threshold[a] || e.weight > threshold[b]) continue;
    const std::int32_t root = forest.join(a, b);
    threshold[root] = e.weight + k / static_cast<float>(forest.size(root));
  }
  for (const Edge &e : sorted) {
    const std::int32_t a = forest.find(e.a), b = forest.find(e.b);
    if (a != b && (forest.size(a) < min_size || forest.size(b) < min_size)) forest.join(a, b);
  }
  return number(forest, nodes, labels);
}

}  // namespace perception::graph
