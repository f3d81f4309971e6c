#include "merge.h"

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

namespace perception::graph {
namespace {

struct MaskPart {
  std::int32_t mask;
  double pixels, unit;  // P_im, and P_im / |P_i|_v
};

struct ViewPart {
  std::int32_t view;
  double blank, share, labelled;  // B_iv, s_iv, l_iv
  std::size_t begin, end;         // its masks
};

struct Segment {
  std::vector<MaskPart> masks;  // ascending
  std::vector<ViewPart> views;  // ascending
};

struct Pair {
  std::int32_t other;
  bool near;
  double affinity;
};

// Sums the entries of two ascending lists; `key` tells their order, `add` adds the second to an equal first.
template <class T, class Key, class Add>
std::vector<T> merged(const std::vector<T> &a, const std::vector<T> &b, Key key, Add add) {
  std::vector<T> out;
  out.reserve(a.size() + b.size());
  auto i = a.begin(), j = b.begin();
  while (i != a.end() || j != b.end()) {
    if (j == b.end() || (i != a.end() && key(*i) < key(*j))) {
      out.push_back(*i++);
    } else if (i == a.end() || key(*j) < key(*i)) {
      out.push_back(*j++);
    } else {
      out.push_back(*i++);
      add(out.back(), *j++);
    }
  }
  return out;
}

class Merger {
 public:
  explicit Merger(const Segments &input)
      : in_(input),
        segments_(input.count),
        rows_(input.count),
        best_(input.count, -1),
        z_(input.z, input.z + input.count * input.dims),
        sizes_(input.sizes, input.sizes + input.count) {
    for (std::size_t i = 0; i < in_.count; ++i) read(i);
    find_pairs();
    for (std::size_t i = 0; i < in_.count; ++i) best_[i] = largest(i);
  }

  std::size_t run(std::int32_t *children, double *affinity) {
    std::vector<std::int32_t> node(in_.count);
    for (std::size_t i = 0; i < in_.count; ++i) node[i] = static_cast<std::int32_t>(i);
    std::size_t merges = 0;
    while (!best_.empty()) {
      const std::size_t top = std::max_element(best_.begin(), best_.end()) - best_.begin();
      const double value = best_[top];
      if (!(value >= in_.lowest)) break;
      const auto &row = rows_[top];
      const auto pair = std::find_if(row.begin(), row.end(), [&](const Pair &p) { return p.affinity == value; });
      const std::int32_t i = std::min(static_cast<std::int32_t>(top), pair->other);
      const std::int32_t j = std::max(static_cast<std::int32_t>(top), pair->other);
      children[2 * merges] = node[i];
      children[2 * merges + 1] = node[j];
      affinity[merges++] = value;
      merge(i, j);
      node[i] = static_cast<std::int32_t>(in_.count + merges - 1);
    }
    return merges;
  }

 private:
  void read(std::size_t i) {
    Segment &s = segments_[i];
    for (auto e = in_.pixels.start[i]; e < in_.pixels.start[i + 1]; ++e) {
      if (in_.pixels.value[e] > 0) s.masks.push_back({in_.pixels.index[e], in_.pixels.value[e], 0});
    }
    std::vector<ViewPart> seen, blank;
    for (const MaskPart &part : s.masks) {
      const std::int32_t view = in_.view[part.mask];
      if (seen.empty() || seen.back().view != view) seen.push_back({view, 0, 0, 0, 0, 0});
    }
    for (auto e = in_.blank.start[i]; e < in_.blank.start[i + 1]; ++e) {
      if (in_.blank.value[e] > 0) blank.push_back({in_.blank.index[e], in_.blank.value[e], 0, 0, 0, 0});
    }
    s.views = joined(seen, blank);
    derive(s);
  }

  static std::vector<ViewPart> joined(const std::vector<ViewPart> &a, const std::vector<ViewPart> &b) {
    return merged(a, b, [](const ViewPart &p) { return p.view; },
                  [](ViewPart &p, const ViewPart &q) { p.blank += q.blank; });
  }

  // unit, share and labelled from P and B.
  void derive(Segment &s) const {
    double most = 1e-12;
    std::size_t at = 0;
    for (ViewPart &v : s.views) {
      v.begin = at;
      double sum = 0, squares = 0;
      for (; at < s.masks.size() && in_.view[s.masks[at].mask] == v.view; ++at) {
        sum += s.masks[at].pixels;
        squares += s.masks[at].pixels * s.masks[at].pixels;
      }
      v.end = at;
      const double norm = std::max(std::sqrt(squares), 1e-12);
      for (std::size_t m = v.begin; m < v.end; ++m) s.masks[m].unit = s.masks[m].pixels / norm;
      v.share = sum + v.blank;
      v.labelled = 1 - v.blank / std::max(v.share, 1e-12);
      most = std::max(most, v.share);
    }
    for (ViewPart &v : s.views) v.share /= most;
  }

  // c_ijv
  static double cosine(const Segment &a, const ViewPart &u, const Segment &b, const ViewPart &v) {
    double sum = 0;
    std::size_t m = u.begin, n = v.begin;
    while (m < u.end && n < v.end) {
      const std::int32_t x = a.masks[m].mask, y = b.masks[n].mask;
      if (x == y) sum += a.masks[m].unit * b.masks[n].unit;
      m += x <= y;
      n += y <= x;
    }
    return sum;
  }

  // a_ij
  double affinity(std::size_t i, std::size_t j, bool near) const {
    const Segment &a = segments_[i], &b = segments_[j];
    double agreed = 0, weight = in_.prior;
    if (near) {
      double squares = 0;
      for (std::size_t d = 0; d < in_.dims; ++d) {
        const double step = z_[i * in_.dims + d] - z_[j * in_.dims + d];
        squares += step * step;
      }
      agreed = in_.prior * std::max(0.0, 1 - squares);
    }
    auto u = a.views.begin();
    auto v = b.views.begin();
    while (u != a.views.end() && v != b.views.end()) {
      const std::int32_t x = u->view, y = v->view;
      const double w = std::min(u->share, v->share);
      if (x == y && w > in_.least_share) {
        const double both = u->labelled * v->labelled, one = u->labelled + v->labelled - 2 * both;
        agreed += w * both * cosine(a, *u, b, *v);
        weight += w * (both + in_.one_sided * one);
      }
      u += x <= y;
      v += y <= x;
    }
    return agreed / weight;
  }

  // The pairs of segments that are neighbours or share a mask, with their affinities.
  void find_pairs() {
    std::vector<std::vector<std::int32_t>> holders(in_.masks), near(in_.count);
    for (std::size_t i = 0; i < in_.count; ++i) {
      for (const MaskPart &part : segments_[i].masks) holders[part.mask].push_back(static_cast<std::int32_t>(i));
      for (auto e = in_.near_start[i]; e < in_.near_start[i + 1]; ++e) {
        const std::int32_t a = static_cast<std::int32_t>(i), b = in_.near[e];
        if (a != b) near[std::min(a, b)].push_back(std::max(a, b));
      }
    }
    constexpr char kShares = 1, kNear = 2;
    std::vector<char> mark(in_.count, 0);
    std::vector<std::int32_t> others;
    for (std::size_t i = 0; i < in_.count; ++i) {
      const auto add = [&](std::int32_t j, char reason) {
        if (!mark[j]) others.push_back(j);
        mark[j] |= reason;
      };
      for (const MaskPart &part : segments_[i].masks) {
        const auto &list = holders[part.mask];
        for (auto j = std::upper_bound(list.begin(), list.end(), static_cast<std::int32_t>(i)); j != list.end(); ++j) {
          add(*j, kShares);
        }
      }
      for (const std::int32_t j : near[i]) add(j, kNear);
      std::sort(others.begin(), others.end());
      for (const std::int32_t j : others) {  // in order of i, so every row is ascending
        const bool is_near = mark[j] & kNear;
        const double value = affinity(i, j, is_near);
        rows_[i].push_back({j, is_near, value});
        rows_[j].push_back({static_cast<std::int32_t>(i), is_near, value});
        mark[j] = 0;
      }
      others.clear();
    }
  }

  double largest(std::size_t i) const {
    double value = -1;
    for (const Pair &pair : rows_[i]) value = std::max(value, pair.affinity);
    return value;
  }

  // Merges segment j into segment i < j.
  void merge(std::int32_t i, std::int32_t j) {
    const double size = sizes_[i] + sizes_[j];
    for (std::size_t d = 0; d < in_.dims; ++d) {
      double &z = z_[i * in_.dims + d];
      z = (z * sizes_[i] + z_[j * in_.dims + d] * sizes_[j]) / size;
    }
    sizes_[i] = size;
    Segment &a = segments_[i], &b = segments_[j];
    a.masks = merged(a.masks, b.masks, [](const MaskPart &p) { return p.mask; },
                     [](MaskPart &p, const MaskPart &q) { p.pixels += q.pixels; });
    a.views = joined(a.views, b.views);
    derive(a);
    b = {};
    auto row = merged(rows_[i], rows_[j], [](const Pair &p) { return p.other; },
                      [](Pair &p, const Pair &q) { p.near |= q.near; });
    row.erase(std::remove_if(row.begin(), row.end(), [&](const Pair &p) { return p.other == i || p.other == j; }),
              row.end());
    rows_[j] = {};
    best_[j] = best_[i] = -1;
    for (Pair &pair : row) {
      pair.affinity = affinity(i, pair.other, pair.near);
      best_[i] = std::max(best_[i], pair.affinity);
      replace(pair.other, i, j, pair);
    }
    rows_[i] = std::move(row);
  }

  // In the row of k: the pairs with i and j are replaced by the one with their merged segment i.
  void replace(std::int32_t k, std::int32_t i, std::int32_t j, const Pair &joint) {
    auto &row = rows_[k];
    const auto place = [&](std::int32_t other) {
      return std::lower_bound(row.begin(), row.end(), other, [](const Pair &p, std::int32_t o) { return p.other < o; });
    };
    double before = -1;
    if (const auto old = place(j); old != row.end() && old->other == j) {
      before = old->affinity;
      row.erase(old);
    }
    const Pair pair{i, joint.near, joint.affinity};
    if (const auto at = place(i); at != row.end() && at->other == i) {
      before = std::max(before, at->affinity);
      *at = pair;
    } else {
      row.insert(at, pair);
    }
    best_[k] = before >= best_[k] ? largest(k) : std::max(best_[k], joint.affinity);
  }

  const Segments &in_;
  std::vector<Segment> segments_;
  std::vector<std::vector<Pair>> rows_;  // of each segment, ascending; empty once it is merged into another
  std::vector<double> best_;             // the largest affinity of each row, -1 where there is none
  std::vector<double> z_, sizes_;
};

}  // namespace

std::size_t merge_segments(const Segments &segments, std::int32_t *children, double *affinity) {
  return Merger(segments).run(children, affinity);
}

}  // namespace perception::graph
