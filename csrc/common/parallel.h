// The one pool of threads. They wait some microseconds for the next job and then sleep: other work shares the machine.
// Tasks may run on any worker in any order, so nothing that is computed may depend on either: a task writes only what
// is its own, and sums over tasks are taken afterwards in the order of the tasks.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdint>

namespace perception {

constexpr int kMaxThreads = 256;

using Task = void (*)(void *context, std::size_t task, int worker);

// Calls run(context, task, worker) for task in [0, tasks), worker in [0, threads), on at most kMaxThreads threads.
// Blocks until all are done and rethrows what the first failed task threw. On one thread when the pool is busy, and one
// thread less for each that the system will not start.
void parallel_for(int threads, std::size_t tasks, Task run, void *context);

int hardware_threads();

// 0 or less: as set_default_threads says, which is all processors at first.
int resolve_threads(int threads);
void set_default_threads(int threads);

// The same with a callable body(task, worker).
template <class Body>
void parallel_for(int threads, std::size_t tasks, Body &&body) {
  parallel_for(
      threads, tasks,
      [](void *context, std::size_t task, int worker) { (*static_cast<Body *>(context))(task, worker); },
      const_cast<void *>(static_cast<const void *>(&body)));
}

// Splits [0, n) into pieces whose size depends on the arguments alone, so that sums over pieces have one fixed order.
struct Pieces {
  int64_t n, size, count;
  explicit Pieces(int64_t n, int64_t at_least = 8192, int64_t at_most = 32)
      : n(n), size(std::max(at_least, (n + at_most - 1) / at_most)), count((n + size - 1) / size) {}
  int64_t begin(int64_t i) const { return i * size; }
  int64_t end(int64_t i) const { return std::min(n, (i + 1) * size); }
};

// body(begin, end) over the pieces.
template <class Body>
void parallel_pieces(int threads, const Pieces &pieces, Body &&body) {
  parallel_for(threads, pieces.count, [&](std::size_t i, int) { body(pieces.begin(i), pieces.end(i)); });
}

}  // namespace perception
