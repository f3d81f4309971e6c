// Runs independent items on a few threads. Results never depend on which thread ran which item: every item writes
// only what is its own, and sums over items are taken afterwards in the order of the items.
#pragma once
#include <algorithm>
#include <atomic>
#include <cstdint>
#include <system_error>
#include <thread>
#include <vector>

namespace perception::training {

int resolve_threads(int threads);  // 0 becomes the default of set_default_threads

template <class Body>  // body(item, worker) for item in [0, items)
void parallel_for(int64_t items, int threads, const Body &body) {
  const int workers = static_cast<int>(std::min<int64_t>(items, resolve_threads(threads)));
  if (workers <= 1) {
    for (int64_t i = 0; i < items; ++i) body(i, 0);
    return;
  }
  std::atomic<int64_t> next{0};
  auto work = [&](int worker) {
    for (int64_t i = next.fetch_add(1); i < items; i = next.fetch_add(1)) body(i, worker);
  };
  std::vector<std::thread> others;
  others.reserve(workers - 1);
  try {
    for (int w = 1; w < workers; ++w) others.emplace_back(work, w);
  } catch (const std::system_error &) {  // a thread that the system will not start is done without
  }
  work(0);
  for (auto &thread : others) thread.join();
}

// Splits [0, n) into pieces whose size depends on n alone, so that sums over pieces have one fixed order.
struct Pieces {
  int64_t n, size, count;
  explicit Pieces(int64_t n, int64_t at_least = 8192, int64_t at_most = 32)
      : n(n), size(std::max(at_least, (n + at_most - 1) / at_most)), count((n + size - 1) / size) {}
  int64_t begin(int64_t i) const { return i * size; }
  int64_t end(int64_t i) const { return std::min(n, (i + 1) * size); }
};

}  // namespace perception::training
