#include "kdtree.h"

#include <algorithm>
#include <cmath>

#include "../common/levels.h"
#include "../common/parallel.h"

namespace perception::graph {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr std::int32_t kNone = std::numeric_limits<std::int32_t>::max();  // sorts behind every index
constexpr int64_t kBlock = 1 << 17;                                       // queries a thread takes at a time, at most
constexpr std::size_t kWorthSplitting = 4096;                             // points of a subtree
constexpr int kDepth = 64;

std::size_t leaves(std::size_t points) { return (points + KdTree::kBucket - 1) / KdTree::kBucket; }

// Points of the left child: half of the buckets, all of them full, so that slots need no padding but at the end.
std::size_t left_size(std::size_t points) { return (leaves(points) / 2) * KdTree::kBucket; }

struct Pending {
  std::uint32_t node;
  float squared;    // distance from the query to the node's cell
  float offset[3];  // by axis
};

// Squared distances of the query to one bucket; the loop is a fixed number of lanes.
inline __attribute__((always_inline)) void measure(const KdTree::View &tree, std::uint32_t slot, const float q[3],
                                                   float out[KdTree::kBucket]) {
  for (std::size_t i = 0; i < KdTree::kBucket; ++i) {
    const float dx = tree.x[slot + i] - q[0], dy = tree.y[slot + i] - q[1], dz = tree.z[slot + i] - q[2];
    out[i] = dx * dx + dy * dy + dz * dz;
  }
}

// Keeps the k best in ascending (distance, index); the caller has checked that the entry beats the last one.
inline void insert(float *best, std::int32_t *who, int k, float d, std::int32_t index) {
  int i = k - 1;
  for (; i > 0 && (best[i - 1] > d || (best[i - 1] == d && who[i - 1] > index)); --i) {
    best[i] = best[i - 1];
    who[i] = who[i - 1];
  }
  best[i] = d;
  who[i] = index;
}

inline __attribute__((always_inline)) void search(const KdTree::View &tree, const float q[3], int k, float *best,
                                                  std::int32_t *who) {
  Pending stack[kDepth];
  int top = 0;
  Pending at{0, 0.f, {0.f, 0.f, 0.f}};
  for (;;) {
    const KdTree::Node *node = tree.nodes + at.node;
    while (node->axis >= 0) {  // descend to the query's side, remember the other (Arya and Mount 1993)
      const float d = q[node->axis] - node->split;
      const std::uint32_t left = static_cast<std::uint32_t>(node - tree.nodes) + 1;
      const std::uint32_t near = d < 0.f ? left : node->next, far = d < 0.f ? node->next : left;
      const float old = at.offset[node->axis];
      const float squared = at.squared - old * old + d * d;
      if (squared <= best[k - 1]) {
        Pending &p = stack[top++];
        p = at;
        p.node = far;
        p.squared = squared;
        p.offset[node->axis] = d;
      }
      node = tree.nodes + near;
    }
    float d[KdTree::kBucket];
    measure(tree, node->next, q, d);
    float smallest = d[0];
    for (std::size_t i = 1; i < KdTree::kBucket; ++i) smallest = std::min(smallest, d[i]);
    if (smallest <= best[k - 1]) {
      for (std::size_t i = 0; i < KdTree::kBucket; ++i) {
        const std::int32_t index = tree.index[node->next + i];
        if (d[i] < best[k - 1] || (d[i] == best[k - 1] && index < who[k - 1])) insert(best, who, k, d[i], index);
      }
    }
    do {
      if (top == 0) return;
      at = stack[--top];
    } while (at.squared > best[k - 1]);
  }
}

struct Task {
  KdTree::View tree;
  const float *queries;
  int k;
  float limit;             // squared
  float low[3], cells[3];  // corner of the tree's box, Morton cells per unit length
  std::int32_t *indices;
  float *squared;
};

// Every third bit of the result is one of the low ten bits of v.
inline std::uint32_t spread(std::uint32_t v) {
  v = (v | v << 16) & 0x030000ffu;
  v = (v | v << 8) & 0x0300f00fu;
  v = (v | v << 4) & 0x030c30c3u;
  return (v | v << 2) & 0x09249249u;
}

// The queries of a block along a Morton curve through the tree's box: neighbours in the order share their path
// through the tree, which stays in the cache. Radix sort of (code, index), three digits of ten bits.
std::vector<std::uint64_t> ordered(const Task &t, std::size_t begin, std::size_t end) {
  const std::size_t count = end - begin;
  std::vector<std::uint64_t> keys(count), other(count);
  for (std::size_t i = 0; i < count; ++i) {
    std::uint32_t code = 0;
    for (int a = 0; a < 3; ++a) {
      const float cell = (t.queries[3 * (begin + i) + a] - t.low[a]) * t.cells[a];
      code |= spread(cell > 0.f ? static_cast<std::uint32_t>(std::min(cell, 1023.f)) : 0u) << a;  // NaN goes to 0
    }
    keys[i] = static_cast<std::uint64_t>(code) << 32 | i;
  }
  for (int shift = 32; shift < 62; shift += 10) {
    std::size_t start[1025] = {};
    for (const std::uint64_t key : keys) ++start[(key >> shift & 1023) + 1];
    for (int d = 0; d < 1024; ++d) start[d + 1] += start[d];
    for (const std::uint64_t key : keys) other[start[key >> shift & 1023]++] = key;
    keys.swap(other);
  }
  return keys;
}

inline __attribute__((always_inline)) void answer(const Task &t, std::size_t begin, std::size_t end) {
  for (const std::uint64_t key : ordered(t, begin, end)) {
    const std::size_t i = begin + (key & 0xffffffffu);
    const float *q = t.queries + 3 * i;
    float *best = t.squared + i * t.k;
    std::int32_t *who = t.indices + i * t.k;
    std::fill(best, best + t.k, t.limit);
    std::fill(who, who + t.k, kNone);
    if (std::isfinite(q[0]) && std::isfinite(q[1]) && std::isfinite(q[2])) search(t.tree, q, t.k, best, who);
    for (int j = 0; j < t.k; ++j) {
      if (who[j] != kNone) continue;
      who[j] = -1;
      best[j] = kInfinity;
    }
  }
}

void answer_plain(const Task &t, std::size_t begin, std::size_t end) { answer(t, begin, end); }

#if defined(__x86_64__)
__attribute__((target("avx2"))) void answer_avx2(const Task &t, std::size_t begin, std::size_t end) {
  answer(t, begin, end);
}
#endif

using Answer = void (*)(const Task &, std::size_t, std::size_t);

Answer pick() {
#if defined(__x86_64__)
  if (level_supported(Level::avx2)) return answer_avx2;
#endif
  return answer_plain;
}

}  // namespace

KdTree::KdTree(const float *points, std::size_t count, int threads) : size_(count) {
  const std::size_t slots = std::max<std::size_t>(leaves(count), 1) * kBucket;
  nodes_.resize(2 * (slots / kBucket) - 1);
  std::vector<Entry> entries(count);
  for (std::size_t i = 0; i < count; ++i) {
    entries[i] = {{points[3 * i], points[3 * i + 1], points[3 * i + 2]}, static_cast<std::int32_t>(i)};
  }
  for (int a = 0; a < 3; ++a) {
    low_[a] = kInfinity;
    high_[a] = -kInfinity;
    for (const Entry &e : entries) {
      low_[a] = std::min(low_[a], e.at[a]);
      high_[a] = std::max(high_[a], e.at[a]);
    }
  }
  std::vector<Subtree> open = {{0, count, 0}};
  while (static_cast<int>(open.size()) < threads && count / open.size() > kWorthSplitting) {
    std::vector<Subtree> children(2 * open.size());
    parallel_for(threads, open.size(), [&](std::size_t i, int) {
      const auto [left, right] = split(entries, open[i]);
      children[2 * i] = left, children[2 * i + 1] = right;
    });
    open.swap(children);
  }
  parallel_for(threads, open.size(), [&](std::size_t i, int) { build(entries, open[i]); });
  x_.assign(slots, kInfinity);
  y_.assign(slots, kInfinity);
  z_.assign(slots, kInfinity);
  index_.assign(slots, kNone);
  for (std::size_t i = 0; i < count; ++i) {
    x_[i] = entries[i].at[0];
    y_[i] = entries[i].at[1];
    z_[i] = entries[i].at[2];
    index_[i] = entries[i].index;
  }
}

std::pair<KdTree::Subtree, KdTree::Subtree> KdTree::split(std::vector<Entry> &entries, const Subtree &tree) {
  const auto [begin, end, node] = tree;
  const std::size_t middle = begin + left_size(end - begin);
  float low[3] = {kInfinity, kInfinity, kInfinity}, high[3] = {-kInfinity, -kInfinity, -kInfinity};
  for (std::size_t i = begin; i < end; ++i) {
    for (int a = 0; a < 3; ++a) {
      low[a] = std::min(low[a], entries[i].at[a]);
      high[a] = std::max(high[a], entries[i].at[a]);
    }
  }
  int axis = 0;
  for (int a = 1; a < 3; ++a) {
    if (high[a] - low[a] > high[axis] - low[axis]) axis = a;
  }
  Entry *first = entries.data();
  std::nth_element(first + begin, first + middle, first + end,
                   [axis](const Entry &a, const Entry &b) { return a.at[axis] < b.at[axis]; });
  const std::size_t right = node + 2 * leaves(middle - begin);  // a subtree of n leaves has 2n - 1 nodes
  nodes_[node] = {entries[middle].at[axis], axis, static_cast<std::uint32_t>(right)};
  return {{begin, middle, node + 1}, {middle, end, right}};
}

void KdTree::build(std::vector<Entry> &entries, const Subtree &tree) {
  if (leaves(tree.end - tree.begin) <= 1) {
    nodes_[tree.node] = {0.f, -1, static_cast<std::uint32_t>(tree.begin)};
    return;
  }
  const auto [left, right] = split(entries, tree);
  build(entries, left);
  build(entries, right);
}

void KdTree::knn(const float *queries, std::size_t count, int k, float max_distance, int threads, std::int32_t *indices,
                 float *squared) const {
  const View view{nodes_.data(), x_.data(), y_.data(), z_.data(), index_.data()};
  // Without a limit, what is farther than a float can hold squared is left out like everything beyond a limit.
  const float limit = max_distance < kInfinity ? max_distance * max_distance : std::numeric_limits<float>::max();
  Task task{view, queries, k, limit, {}, {}, indices, squared};
  for (int a = 0; a < 3; ++a) {
    task.low[a] = low_[a];
    task.cells[a] = high_[a] > low_[a] ? 1024.f / (high_[a] - low_[a]) : 0.f;
  }
  const Answer run = pick();
  const int64_t n = static_cast<int64_t>(count), blocks = std::max<int64_t>(4 * int64_t{threads}, n / kBlock + 1);
  parallel_pieces(threads, Pieces(n, 1, blocks), [&](std::size_t begin, std::size_t end) { run(task, begin, end); });
}

}  // namespace perception::graph
