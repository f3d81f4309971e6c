#include "parallel.h"

#include "training.h"

namespace perception::training {
namespace {
std::atomic<int> default_threads{0};
}

void set_default_threads(int threads) { default_threads = std::max(0, threads); }

int resolve_threads(int threads) {
  if (threads <= 0) threads = default_threads;
  return threads > 0 ? threads : std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
}

}  // namespace perception::training
