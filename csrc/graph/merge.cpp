#include "merge.h"

#include <algorithm>
#include <cmath>
#include <numeric>
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

// The largest of numbers that change: a tree over them, each node with the larger of its two children.
class Largest {
 public:
  explicit Largest(std::size_t count) {
    while (leaves_ < count) leaves_ *= 2;
    values_.assign(2 * leaves_, -1);
  }

  double operator[](std::size_t i) const { return values_[leaves_ + i]; }

  void set(std::size_t i, double value) {
    std::size_t at = leaves_ + i;
    for (values_[at] = value; at > 1; at /= 2) values_[at / 2] = std::max(values_[at], values_[at ^ 1]);
  }

  // The first of the largest.
  std::size_t first() const {
    std::size_t at = 1;
    while (at < leaves_) at = 2 * at + (values_[2 * at] < values_[2 * at + 1]);
    return at - leaves_;
  }

 private:
  std::size_t leaves_ = 1;
  std::vector<double> values_;
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

// Pairs are not held: those of a segment are found by the masks that it shares, and their affinities computed, when it
// is merged or has lost its best partner. So memory grows with the masks' entries, not with the pairs.
class Merger {
 public:
  Merger(const Segments &input, const Between &between)
      : in_(input),
        between_(between),
        segments_(input.count),
        holders_(input.masks),
        near_(input.count),
        best_(input.count),
        partner_(input.count, kNone),
        z_(input.z, input.z + input.count * input.dims),
        sizes_(input.sizes, input.sizes + input.count),
        unit_(input.masks, 0),
        seen_(input.views, nullptr),
        mark_(input.count, 0),
        node_(input.count) {
    std::iota(node_.begin(), node_.end(), 0);
    for (std::size_t i = 0; i < in_.count; ++i) read(static_cast<std::int32_t>(i));
    for (auto &list : near_) {
      std::sort(list.begin(), list.end());
      list.erase(std::unique(list.begin(), list.end()), list.end());
    }
  }

  // Merges until no affinity reaches `lowest`. children, affinity: of all merges.
  void run(double lowest, bool neighbours_alone, std::int32_t *children, double *affinity) {
    neighbours_alone_ = neighbours_alone;
    for (std::size_t i = 0; i < in_.count; ++i) {
      between_();
      if (node_[i] != kNone) find_best(static_cast<std::int32_t>(i));
    }
    while (true) {
      between_();
      const auto top = static_cast<std::int32_t>(best_.first());
      const double value = best_[top];
      if (!(value >= lowest)) break;
      if (partner_[top] == kNone) {
        find_best(top);
        continue;
      }
      const std::int32_t i = std::min(top, partner_[top]), j = std::max(top, partner_[top]);
      children[2 * merges_] = node_[i];
      children[2 * merges_ + 1] = node_[j];
      affinity[merges_] = value;
      merge(i, j);
      node_[i] = static_cast<std::int32_t>(in_.count + merges_++);
      node_[j] = kNone;
    }
  }

  std::size_t merges() const { return merges_; }

 private:
  static constexpr std::int32_t kNone = -1;

  void read(std::int32_t i) {
    Segment &s = segments_[i];
    for (auto e = in_.pixels.start[i]; e < in_.pixels.start[i + 1]; ++e) {
      if (in_.pixels.value[e] > 0) s.masks.push_back({in_.pixels.index[e], in_.pixels.value[e], 0});
    }
    for (const MaskPart &part : s.masks) holders_[part.mask].push_back(i);
    for (auto e = in_.near_start[i]; e < in_.near_start[i + 1]; ++e) {
      if (in_.near[e] == i) continue;
      near_[i].push_back(in_.near[e]);
      near_[in_.near[e]].push_back(i);
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

  // Calls `use(j, a_ij)` for each segment j that is a neighbour of i or shares a mask with it.
  template <class Use>
  void for_pairs(std::int32_t i, Use use) {
    constexpr char kShares = 1, kNear = 2;
    const Segment &a = segments_[i];
    for (const MaskPart &part : a.masks) unit_[part.mask] = part.unit;
    for (const ViewPart &v : a.views) seen_[v.view] = &v;
    mark_[i] = kShares;
    std::vector<std::int32_t> others;
    const auto add = [&](std::int32_t j, char reason) {
      if (!mark_[j]) others.push_back(j);
      mark_[j] |= reason;
    };
    for (const MaskPart &part : a.masks) {
      if (neighbours_alone_) break;
      for (const std::int32_t j : holders_[part.mask]) add(j, kShares);
    }
    for (const std::int32_t j : near_[i]) add(j, kNear);
    for (const std::int32_t j : others) use(j, affinity(i, j, mark_[j] & kNear));
    for (const std::int32_t j : others) mark_[j] = 0;
    mark_[i] = 0;
    for (const MaskPart &part : a.masks) unit_[part.mask] = 0;
    for (const ViewPart &v : a.views) seen_[v.view] = nullptr;
  }

  // a_ij, where `unit_` and `seen_` hold i.
  double affinity(std::int32_t i, std::int32_t j, bool near) const {
    double agreed = 0, weight = in_.prior;
    if (near) {
      double squares = 0;
      for (std::size_t d = 0; d < in_.dims; ++d) {
        const double step = z_[i * in_.dims + d] - z_[j * in_.dims + d];
        squares += step * step;
      }
      agreed = in_.prior * std::max(0.0, 1 - squares);
    }
    const Segment &b = segments_[j];
    for (const ViewPart &v : b.views) {
      const ViewPart *u = seen_[v.view];
      if (u == nullptr) continue;
      const double w = std::min(u->share, v.share);
      if (!(w > in_.least_share)) continue;
      double cosine = 0;  // c_ijv
      for (std::size_t n = v.begin; n < v.end; ++n) cosine += unit_[b.masks[n].mask] * b.masks[n].unit;
      const double both = u->labelled * v.labelled, one = u->labelled + v.labelled - 2 * both;
      agreed += w * both * cosine;
      weight += w * (both + in_.one_sided * one);
    }
    return agreed / weight;
  }

  void find_best(std::int32_t i) {
    double value = -1;
    std::int32_t partner = kNone;
    for_pairs(i, [&](std::int32_t j, double a) {
      if (a > value || (a == value && j < partner)) value = a, partner = j;
    });
    best_.set(i, value);
    partner_[i] = partner;
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
    for (const MaskPart &part : b.masks) replace(holders_[part.mask], i, j);
    for (const std::int32_t k : near_[j]) {
      if (k == i) continue;
      replace(near_[k], i, j);
      if (std::find(near_[i].begin(), near_[i].end(), k) == near_[i].end()) near_[i].push_back(k);
    }
    near_[i].erase(std::remove(near_[i].begin(), near_[i].end(), j), near_[i].end());
    near_[j] = {};
    a.masks = merged(a.masks, b.masks, [](const MaskPart &p) { return p.mask; },
                     [](MaskPart &p, const MaskPart &q) { p.pixels += q.pixels; });
    a.views = joined(a.views, b.views);
    derive(a);
    b = {};
    best_.set(j, -1);
    double value = -1;
    std::int32_t partner = kNone;
    for_pairs(i, [&](std::int32_t k, double affinity) {
      if (affinity > value || (affinity == value && k < partner)) value = affinity, partner = k;
      offer(k, i, j, affinity);
    });
    best_.set(i, value);
    partner_[i] = partner;
  }

  // Of segment k, whose affinity with segment i is new, as j was merged into i. Where its best partner was i or j and
  // now is less, its best affinity stays as a bound of the true one, which is found when it comes first.
  void offer(std::int32_t k, std::int32_t i, std::int32_t j, double affinity) {
    const double before = best_[k];
    const bool lost = partner_[k] == i || partner_[k] == j;
    if (affinity > before || (affinity == before && (lost || i < partner_[k]))) {
      best_.set(k, affinity);
      partner_[k] = i;
    } else if (lost) {
      partner_[k] = kNone;
    }
  }

  // In a list of segments: j is replaced by i, unless that is there already.
  static void replace(std::vector<std::int32_t> &list, std::int32_t i, std::int32_t j) {
    const auto old = std::find(list.begin(), list.end(), j);
    if (old == list.end()) return;
    if (std::find(list.begin(), list.end(), i) == list.end()) {
      *old = i;
    } else {
      *old = list.back();
      list.pop_back();
    }
  }

  const Segments &in_;
  const Between &between_;
  std::vector<Segment> segments_;
  std::vector<std::vector<std::int32_t>> holders_;  // of each mask, the segments in it
  std::vector<std::vector<std::int32_t>> near_;     // of each segment, its neighbours
  Largest best_;                                    // of each segment, its largest affinity, or a bound of it; -1: none
  std::vector<std::int32_t> partner_;               // of each segment, the first with this affinity; kNone: not known
  std::vector<double> z_, sizes_;
  std::vector<double> unit_;             // of each mask, that of the segment in `for_pairs`
  std::vector<const ViewPart *> seen_;   // of each view, likewise
  std::vector<char> mark_;               // of each segment, why it is a pair
  std::vector<std::int32_t> node_;       // of each segment; kNone once it is merged into another
  std::size_t merges_ = 0;
  bool neighbours_alone_ = false;
};

}  // namespace

std::size_t merge_segments(const Segments &segments, std::int32_t *children, double *affinity, const Between &between) {
  Merger merger(segments, between);
  if (segments.count > segments.many) merger.run(segments.sure, true, children, affinity);
  merger.run(segments.lowest, false, children, affinity);
  return merger.merges();
}

}  // namespace perception::graph
