#include <cmath>
#include <stdexcept>

#include "../common/parallel.h"
#include "kernels/table.h"
#include "training.h"

namespace perception::training {
namespace {

// Labels in use, ascending. Dense ids go through a table, wild ones through a sort.
constexpr int32_t kTableLimit = 1 << 20;

std::vector<int32_t> used_labels(const int32_t *slots, int64_t pixels, int32_t largest) {
  std::vector<int32_t> ids;
  if (largest < kTableLimit) {
    std::vector<uint8_t> used(int64_t(largest) + 1);
    for (int64_t p = 0; p < pixels; ++p) used[slots[p]] = 1;
    for (int32_t id = 1; id <= largest; ++id)
      if (used[id]) ids.push_back(id);
    return ids;
  }
  for (int64_t p = 0; p < pixels; ++p)
    if (slots[p] && (p == 0 || slots[p] != slots[p - 1])) ids.push_back(slots[p]);
  std::sort(ids.begin(), ids.end());
  ids.erase(std::unique(ids.begin(), ids.end()), ids.end());
  return ids;
}

}  // namespace

Assignment assign(const int32_t *labels, int64_t pixels, int32_t *slots) {
  int32_t largest = 0;
  for (int64_t p = 0; p < pixels; ++p) {
    const int32_t label = labels[p];
    if (label < 0) throw std::invalid_argument("labels must be >= 0 (0 = unlabelled), found " + std::to_string(label));
    slots[p] = label;
    largest = std::max(largest, label);
  }
  Assignment out;
  out.ids = used_labels(slots, pixels, largest);
  out.counts.assign(out.ids.size(), 0);
  out.first.assign(out.ids.size(), -1);
  std::vector<int32_t> table;
  if (largest < kTableLimit) {
    table.assign(int64_t(largest) + 1, -1);
    for (size_t i = 0; i < out.ids.size(); ++i) table[out.ids[i]] = static_cast<int32_t>(i);
  }
  for (int64_t p = 0; p < pixels; ++p) {
    const int32_t label = slots[p];
    int32_t slot = -1;
    if (label && !table.empty())
      slot = table[label];
    else if (label)
      slot = static_cast<int32_t>(std::lower_bound(out.ids.begin(), out.ids.end(), label) - out.ids.begin());
    slots[p] = slot;
    if (slot >= 0 && out.counts[slot]++ == 0) out.first[slot] = p;
  }
  return out;
}

template <class T>
void prototypes(const LabelledFeatures<T> &input, const Prototypes &of, const Execution &execution) {
  const int64_t labels = of.labels, width = input.width;
  if (labels == 0) return;
  const auto &table = kernels<T>(execution.level);
  // Sums are taken about a pixel of the label itself, so that features far from zero do not cancel.
  std::vector<T> reference(labels * width);
  for (int64_t i = 0; i < labels; ++i) 
    std::copy_n(input.features + of.first[i] * width, width, reference.begin() + i * width);
  const Pieces pieces(input.pixels, 8192, labels * width > 100000 ? 4 : 16);
  const int64_t stride = labels * 2 * width;
  std::vector<double> sums(pieces.count * stride);
  parallel_for(resolve_threads(execution.threads), pieces.count, [&](std::size_t i, int) {
    table.accumulate(input.features, input.slots, reference.data(), pieces.begin(i), pieces.end(i), width,
                     &sums[i * stride]);
  });
  for (int64_t i = 1; i < pieces.count; ++i)
    for (int64_t k = 0; k < stride; ++k) sums[k] += sums[i * stride + k];
  for (int64_t i = 0; i < labels; ++i) {
    const double *sum = &sums[i * 2 * width], *squares = sum + width, n = static_cast<double>(of.counts[i]);
    of.scatter[i] = 0;
    for (int64_t k = 0; k < width; ++k) {
      of.means[i * width + k] = double(reference[i * width + k]) + sum[k] / n;
      of.scatter[i] += std::max(0.0, squares[k] - sum[k] * sum[k] / n);
    }
  }
}

template <class T>
void spread(const LabelledFeatures<T> &input, const double *means, const double *pull, const double *push, T *out,
            const Execution &execution) {
  const auto &table = kernels<T>(execution.level);
  const Pieces pieces(input.pixels);
  parallel_for(resolve_threads(execution.threads), pieces.count, [&](std::size_t i, int) {
    table.spread(input.features, input.slots, means, pull, push, pieces.begin(i), pieces.end(i), input.width, out);
  });
}

double separation(const double *points, int64_t rows, int64_t width, double margin, double *gradient) {
  const double pairs = 0.5 * rows * (rows - 1);
  std::fill_n(gradient, rows * width, 0.0);
  double total = 0;
  std::vector<double> difference(width);
  for (int64_t i = 0; i < rows; ++i) {
    for (int64_t j = i + 1; j < rows; ++j) {
      double square = 0;
      for (int64_t k = 0; k < width; ++k) {
        difference[k] = points[i * width + k] - points[j * width + k];
        square += difference[k] * difference[k];
      }
      if (!(square < margin)) continue;
      total += margin - square;
      for (int64_t k = 0; k < width; ++k) {
        const double g = 2 * difference[k] / pairs;
        gradient[i * width + k] -= g;
        gradient[j * width + k] += g;
      }
    }
  }
  return rows > 1 ? total / pairs : 0;
}

template void prototypes(const LabelledFeatures<float> &, const Prototypes &, const Execution &);
template void prototypes(const LabelledFeatures<double> &, const Prototypes &, const Execution &);
template void spread(const LabelledFeatures<float> &, const double *, const double *, const double *, float *,
                     const Execution &);
template void spread(const LabelledFeatures<double> &, const double *, const double *, const double *, double *,
                     const Execution &);

}  // namespace perception::training
