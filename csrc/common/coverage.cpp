// Coverage of the compiled core for tests/fuzz (PERCEPTION_COVERAGE): GCC calls the first function on every edge, the
// fuzzer is given the counters. Not part of any build that is installed.
#include <cstddef>
#include <cstdint>

namespace {
constexpr std::size_t kCounters = 1 << 16;
uint8_t counters[kCounters];
uintptr_t base = 0;
}  // namespace

extern "C" {
__attribute__((visibility("hidden"))) void __sanitizer_cov_trace_pc() {
  const uintptr_t at = reinterpret_cast<uintptr_t>(__builtin_return_address(0)) - base;
  uint8_t &counter = counters[(at ^ at >> 16) % kCounters];
  if (counter < 255) ++counter;
}

// Where the counters lie, [begin, end); addresses are counted from this very function, so that they repeat.
__attribute__((visibility("default"))) void perception_coverage(uint8_t **begin, uint8_t **end) {
  base = reinterpret_cast<uintptr_t>(&perception_coverage);
  *begin = counters, *end = counters + kCounters;
}
}
