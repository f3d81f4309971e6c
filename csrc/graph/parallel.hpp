// Runs work on a range by a few threads. A thread that the system will not start is done without.
#pragma once
#include <algorithm>
#include <atomic>
#include <cstddef>
#include <exception>
#include <system_error>
#include <thread>
#include <vector>

namespace perception::graph {

constexpr int kMaxThreads = 256;

inline int sane_threads(int threads) { return std::clamp(threads, 1, kMaxThreads); }

// Calls other() on a new thread and here() on this one; both here, one after the other, when none can be started.
template <class Other, class Here>
void both(Other other, Here here) {
  std::thread thread;
  try {
    thread = std::thread(other);
  } catch (const std::system_error &) {
    other();
  }
  here();
  if (thread.joinable()) thread.join();
}

// work(begin, end) over blocks of [0, count), each taken by whichever thread is free; rethrows what the first one threw.
template <class Work>
void parallel_blocks(std::size_t count, std::size_t block, int threads, const Work &work) {
  std::atomic<std::size_t> next{0};
  std::atomic<bool> failed{false};
  std::exception_ptr error;
  const auto run = [&] {
    try {
      for (std::size_t begin = next.fetch_add(block); begin < count && !failed; begin = next.fetch_add(block)) {
        work(begin, std::min(begin + block, count));
      }
    } catch (...) {
      if (!failed.exchange(true)) error = std::current_exception();
    }
  };
  std::vector<std::thread> others;
  const std::size_t useful = std::min<std::size_t>(sane_threads(threads), (count + block - 1) / block);
  others.reserve(useful);
  try {
    while (others.size() + 1 < useful) others.emplace_back(run);
  } catch (const std::system_error &) {
  }
  run();
  for (std::thread &other : others) other.join();
  if (error) std::rethrow_exception(error);
}

}  // namespace perception::graph
