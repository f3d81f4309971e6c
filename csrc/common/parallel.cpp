#include "parallel.h"

#include <pthread.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <memory>
#include <mutex>
#include <system_error>
#include <thread>

namespace perception {

namespace {

struct Job {
  Task run;
  void *context;
  std::size_t tasks;
  std::atomic<std::size_t> next{0};
  std::atomic<bool> failed{false};
  std::exception_ptr error;

  void work(int worker) {
    for (std::size_t t; !failed.load(std::memory_order_relaxed) && (t = next.fetch_add(1)) < tasks;) {
      try {
        run(context, t, worker);
      } catch (...) {
        if (!failed.exchange(true)) error = std::current_exception();
      }
    }
  }
};

// Jobs follow each other within microseconds, where waking a thread takes some tens.
constexpr std::chrono::microseconds kSpin{30};

// Waits until `ready`, at most for kSpin.
template <class Ready>
bool spin(Ready &&ready) {
  const auto end = std::chrono::steady_clock::now() + kSpin;
  do {
    for (int i = 0; i < 16; ++i) {
      if (ready()) return true;
#if defined(__x86_64__)
      __builtin_ia32_pause();
#elif defined(__aarch64__)
      asm volatile("yield");
#endif
    }
  } while (std::chrono::steady_clock::now() < end);
  return false;
}

class Pool {
 public:
  void run(Job &job, int helpers) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      try {
        for (; started_ < helpers; ++started_) std::thread(&Pool::loop, this, started_ + 1).detach();
      } catch (const std::system_error &) {  // a thread that the system will not start is done without
        helpers = started_;
      }
      job_ = &job;
      wanted_ = helpers;
      running_ = helpers;
      ++generation_;
    }
    for (int i = 0; i < helpers; ++i) wake_[i].notify_one();
    job.work(0);
    if (spin([this] { return running_ == 0; })) return;
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [this] { return running_ == 0; });
  }

  std::atomic<bool> busy{false};  // one job at a time; a second caller, or a task that asks for tasks, runs alone

 private:
  // Woken only where the job wants it; spins after a job only where it has a core: the others' time is theirs.
  void loop(int worker) {
    const bool has_core = worker < hardware_threads();
    for (unsigned long seen = 0;;) {
      if (has_core) spin([&] { return generation_ != seen; });
      std::unique_lock<std::mutex> lock(mutex_);
      wake_[worker - 1].wait(lock, [&] { return generation_ != seen && worker <= wanted_; });
      seen = generation_;
      Job *job = job_;
      lock.unlock();
      job->work(worker);
      lock.lock();
      if (--running_ == 0) done_.notify_one();
    }
  }

  std::mutex mutex_;
  std::array<std::condition_variable, kMaxThreads> wake_;  // of each thread
  std::condition_variable done_;
  Job *job_ = nullptr;  // of a past generation, all its helpers are done and none reads it
  int started_ = 0, wanted_ = 0;
  std::atomic<int> running_{0};
  std::atomic<unsigned long> generation_{0};
};

// Threads do not survive a fork: the child starts a pool of its own. Never destroyed: its threads outlive main.
std::atomic<Pool *> current_pool{nullptr};

Pool &pool() {
  static std::once_flag once;
  std::call_once(once, [] {
    current_pool = new Pool;
    pthread_atfork(nullptr, nullptr, [] { current_pool = new Pool; });
  });
  return *current_pool.load();
}

}  // namespace

void parallel_for(int threads, std::size_t tasks, Task run, void *context) {
  Job job{run, context, tasks, {}, {}, {}};
  const int useful = static_cast<int>(std::min<std::size_t>(std::clamp(threads, 1, kMaxThreads), tasks));
  Pool *shared = useful > 1 ? &pool() : nullptr;
  if (shared && !shared->busy.exchange(true)) {
    const std::unique_ptr<std::atomic<bool>, void (*)(std::atomic<bool> *)> release(
        &shared->busy, [](std::atomic<bool> *busy) { *busy = false; });
    shared->run(job, useful - 1);
  } else {
    job.work(0);
  }
  if (job.error) std::rethrow_exception(job.error);
}

int hardware_threads() {
  unsigned n = std::thread::hardware_concurrency();
  return n ? static_cast<int>(n) : 1;
}

namespace {
std::atomic<int> default_threads{0};
}

void set_default_threads(int threads) { default_threads = std::max(0, threads); }

int resolve_threads(int threads) {
  if (threads <= 0) threads = default_threads;
  return threads > 0 ? threads : hardware_threads();
}

}  // namespace perception
