// Stage 2: splats from front to back. A stable radix sort on the bits of the depth (positive, so its bits order as
// it does); equal depths keep the order of the Gaussians' index.
#pragma once
#include "../common/parallel.h"
#include "scratch.h"

namespace perception {

// On return scratch.order[0] holds splat indices by rising depth.
template <class T>
void sort_by_depth(const Options &opt, uint32_t n, Scratch<T> &scratch) {
  using Key = DepthKey<T>;
  constexpr int kDigit = 11, kBins = 1 << kDigit, kPasses = (8 * sizeof(Key) + kDigit - 1) / kDigit;
  constexpr uint32_t kMinPart = 1 << 15;  // smaller parts cost more to hand out than to sort
  const int parts =
      static_cast<int>(n / kMinPart + 1 < static_cast<uint32_t>(opt.threads) ? n / kMinPart + 1 : opt.threads);
  scratch.keys[1].reserve(n);
  for (auto &o : scratch.order) o.reserve(n);
  uint32_t *histograms = scratch.histograms.reserve(static_cast<std::size_t>(parts) * kBins);
  for (uint32_t i = 0; i < n; ++i) scratch.order[0][i] = i;
  auto begin = [&](std::size_t part) { return static_cast<uint32_t>(static_cast<uint64_t>(n) * part / parts); };
  for (int pass = 0; pass < kPasses; ++pass) {
    const Key *key = scratch.keys[0].data();
    const int shift = pass * kDigit;
    auto digit = [shift](Key k) { return static_cast<uint32_t>(k >> shift) & (kBins - 1); };
    parallel_for(parts, parts, [&](std::size_t part, int) {
      uint32_t *h = histograms + part * kBins;
      std::memset(h, 0, kBins * sizeof *h);
      for (uint32_t i = begin(part); i < begin(part + 1); ++i) ++h[digit(key[i])];
    });
    uint32_t total = 0;
    bool one_bin = false;
    for (int bin = 0; bin < kBins; ++bin) {
      const uint32_t before = total;
      for (int part = 0; part < parts; ++part) {
        uint32_t &h = histograms[part * kBins + bin], count = h;
        h = total, total += count;
      }
      one_bin |= total - before == n;
    }
    if (one_bin) continue;  // all digits equal: nothing moves
    parallel_for(parts, parts, [&](std::size_t part, int) {
      uint32_t *h = histograms + part * kBins;
      for (uint32_t i = begin(part); i < begin(part + 1); ++i) {
        const uint32_t to = h[digit(key[i])]++;
        scratch.keys[1][to] = key[i];
        scratch.order[1][to] = scratch.order[0][i];
      }
    });
    std::swap(scratch.keys[0], scratch.keys[1]);
    std::swap(scratch.order[0], scratch.order[1]);
  }
}

}  // namespace perception
