// Nearest neighbours in three dimensions: a balanced k-d tree with full buckets, built and searched by several threads.
#pragma once
#include <cstddef>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

namespace perception::graph {

// Points and squared distances are float. Equal distances go to the smaller index, so answers depend neither on
// threads nor on the order of queries. Points must be finite; a query that is not finite has no neighbours.
class KdTree {
 public:
  static constexpr std::size_t kBucket = 16;  // one AVX-512 or two AVX2 registers of floats

  KdTree(const float *points, std::size_t count, int threads);  // points [count, 3]

  // The k nearest of each query [count, 3], nearest first: indices [count, k] (-1 where fewer than k lie within
  // max_distance) and squared distances [count, k] (infinity there). A distance equal to max_distance is within.
  void knn(const float *queries, std::size_t count, int k, float max_distance, int threads, std::int32_t *indices,
           float *squared) const;

  std::size_t size() const { return size_; }

  struct Node {
    float split;
    std::int32_t axis;   // 0..2; -1 for a leaf
    std::uint32_t next;  // inner node: the right child (the left one follows directly); leaf: its first slot
  };
  // What a search reads: nodes in preorder, slots of points in structure-of-arrays form.
  struct View {
    const Node *nodes;
    const float *x, *y, *z;
    const std::int32_t *index;  // original index of the point in a slot
  };

 private:
  struct Entry {
    float at[3];
    std::int32_t index;
  };
  struct Subtree {
    std::size_t begin, end, node;  // its entries and its root
  };
  // Writes the root of a subtree of more than one leaf and returns its children.
  std::pair<Subtree, Subtree> split(std::vector<Entry> &entries, const Subtree &tree);
  void build(std::vector<Entry> &entries, const Subtree &tree);

  std::size_t size_;
  float low_[3], high_[3];
  std::vector<Node> nodes_;
  std::vector<float> x_, y_, z_;
  std::vector<std::int32_t> index_;
};

}  // namespace perception::graph
