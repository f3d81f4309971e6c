// CUDA's thread blocks on one CPU thread, for tests: every CUDA thread is a fiber that runs until a barrier or a
// warp-wide call. What is checked while a kernel runs:
//   - a barrier or warp-wide call that some threads never reach, or that they reach at different lines;
//   - every element of shared memory (SHARED): read before it was written in this block, or touched by two threads, one
//     of them writing, with no barrier between. Only __syncthreads and __syncwarp order memory; ballots and shuffles do
//     not. So a missing barrier is found in any order of the lanes.
//   - every element of an array in global memory (GLOBAL): outside of the arrays registered by emulator_memory.
//     Reads by the headers shared with the CPU are not checked.
// Not modelled: races between blocks, caches, timing, the hardware's approximate functions.
#pragma once
#include <setjmp.h>
#include <ucontext.h>

#include <cmath>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <functional>
#include <iterator>
#include <map>
#include <utility>
#include <vector>

#define __global__ __attribute__((noinline))
#define __device__
#define __launch_bounds__(...)
#define __shared__ static
#define SHARED(Type) emulation::Tracked<Type>
#define GLOBAL(Type) emulation::Global<Type>
using std::exp2;
using std::fma;
using std::log2;
using std::sqrt;

namespace emulation {

constexpr int kWarp = 32, kMaxThreads = 256, kStack = 64 << 10;
enum class State { kReady, kAtBlockBarrier, kAtWarpCall, kDone };

struct Fiber {
  jmp_buf at;
  ucontext_t first;
  bool started = false;
  State state;
  int line;                // of the barrier or call it waits at
  unsigned calls;          // warp-wide calls so far
  unsigned blocks, warps;  // block barriers and warp barriers passed
};
struct Warp {
  int waiting;
  uint64_t values[2][kWarp];  // of the last two warp-wide calls
};
struct Dim3 {
  unsigned x, y, z;
};

inline Fiber fibers[kMaxThreads];
inline Warp warps[kMaxThreads / kWarp];
inline std::vector<char> stacks(static_cast<std::size_t>(kMaxThreads) * kStack);
inline jmp_buf scheduler;
inline Dim3 block_index, block_size, grid_size;
inline int current, alive, at_barrier, votes[2], barriers_done;
inline uint64_t block_serial;  // blocks run so far, over all launches
inline std::function<void()> body;
inline char error[256];

[[noreturn]] inline void fail(const char *format, ...) {
  va_list values;
  va_start(values, format);
  const int n = std::snprintf(error, sizeof error, "block %u, thread %d: ", block_index.x, current);
  std::vsnprintf(error + n, sizeof error - n, format, values);
  va_end(values);
  _longjmp(scheduler, 2);
}

inline void wait() {
  if (!_setjmp(fibers[current].at)) _longjmp(scheduler, 1);
}

inline void release_block() {
  at_barrier = 0, ++barriers_done;
  votes[(barriers_done + 1) & 1] = 0;
  for (unsigned i = 0; i < block_size.x; ++i)
    if (fibers[i].state == State::kAtBlockBarrier) fibers[i].state = State::kReady;
}

inline int block_barrier(int vote, int line) {
  Fiber &f = fibers[current];
  const int parity = (barriers_done + 1) & 1;
  votes[parity] |= vote != 0;
  f.state = State::kAtBlockBarrier, f.line = line, ++f.blocks;
  for (unsigned i = 0; i < block_size.x; ++i)
    if (fibers[i].state == State::kAtBlockBarrier && fibers[i].line != line)
      fail("waits at the barrier of line %d, thread %u at that of line %d", line, i, fibers[i].line);
  if (++at_barrier == alive)
    release_block();
  else
    wait();
  return votes[parity];
}

// Every lane's value, once all 32 have come.
inline const uint64_t *warp_call(uint64_t value, int line) {
  Fiber &f = fibers[current];
  Warp &w = warps[current / kWarp];
  uint64_t *values = w.values[f.calls++ & 1];
  values[current % kWarp] = value;
  f.state = State::kAtWarpCall, f.line = line;
  Fiber *lanes = fibers + current / kWarp * kWarp;
  for (int i = 0; i < kWarp; ++i) {
    if (lanes[i].state == State::kDone) fail("warp-wide call in line %d after lane %d has left", line, i);
    if (lanes[i].state == State::kAtWarpCall && lanes[i].line != line)
      fail("warp-wide call in line %d, lane %d in line %d", line, i, lanes[i].line);
  }
  if (++w.waiting == kWarp) {
    w.waiting = 0;
    for (int i = 0; i < kWarp; ++i) lanes[i].state = State::kReady;
  } else {
    wait();
  }
  return values;
}

inline void warp_barrier(int line) {
  warp_call(0, line);
  ++fibers[current].warps;
}

inline unsigned ballot(int vote, int line) {
  const uint64_t *votes = warp_call(vote != 0, line);
  unsigned mask = 0;
  for (int i = 0; i < kWarp; ++i) mask |= static_cast<unsigned>(votes[i]) << i;
  return mask;
}

template <class V>
V shuffle(V value, int lane, int line) {
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof value);
  std::memcpy(&value, &warp_call(bits, line)[lane % kWarp], sizeof value);
  return value;
}

// Who wrote an element last and who has read it since the last barriers, as numbers of barriers passed.
struct Accesses {
  static constexpr int kMany = -1;
  uint64_t block = 0;  // the block that wrote it
  int writer, reader, reader_warp;
  unsigned write_blocks, write_warps, read_blocks, read_warps;

  // Is an access by `thread` of warp `warp`, made after so many barriers, ordered before the running thread's?
  static bool ordered(int thread, int warp, unsigned blocks, unsigned warps) {
    const Fiber &me = fibers[current];
    return thread == current || blocks < me.blocks || (warp == current / kWarp && warps < me.warps);
  }
  void check_write(const char *what) const {
    if (block == block_serial && !ordered(writer, writer / kWarp, write_blocks, write_warps))
      fail("%s shared memory that thread %d wrote, without a barrier between", what, writer);
  }
  void read() {
    const Fiber &me = fibers[current];
    if (block != block_serial) fail("reads shared memory that no thread of the block wrote");
    check_write("reads");
    const int warp = current / kWarp;
    if (read_blocks != me.blocks) {
      reader = current, reader_warp = warp, read_blocks = me.blocks, read_warps = me.warps;
    } else if (reader_warp != warp) {
      reader = reader_warp = kMany;
    } else if (read_warps != me.warps) {
      reader = current, read_warps = me.warps;
    } else if (reader != current) {
      reader = kMany;
    }
  }
  void write() {
    const Fiber &me = fibers[current];
    check_write("writes");
    if (block == block_serial && !ordered(reader, reader_warp, read_blocks, read_warps))
      fail("writes shared memory that thread %d (-1: several) read, without a barrier between", reader);
    block = block_serial, writer = current, write_blocks = me.blocks, write_warps = me.warps;
    reader = current, reader_warp = current / kWarp, read_blocks = me.blocks, read_warps = me.warps;
  }
};

// An element of shared memory.
template <class V>
class Tracked {
 public:
  operator V() const {
    accesses_.read();
    return value_;
  }
  void operator=(V value) {
    accesses_.write();
    value_ = value;
  }

 private:
  V value_;
  mutable Accesses accesses_;
};

inline std::map<uintptr_t, uintptr_t> memory;  // begin -> end of the registered arrays; none: nothing is checked

inline void check_inside(const void *at, std::size_t size) {
  if (memory.empty()) return;
  const uintptr_t begin = reinterpret_cast<uintptr_t>(at);
  const auto after = memory.upper_bound(begin);
  if (after == memory.begin() || begin + size > std::prev(after)->second)
    fail("accesses memory outside of the registered arrays");
}

// Arrays that lay there before are gone.
inline void give_memory(uintptr_t begin, uintptr_t end) {
  auto at = memory.lower_bound(begin);
  if (at != memory.begin() && std::prev(at)->second > begin) --at;
  while (at != memory.end() && at->first < end) at = memory.erase(at);
  memory[begin] = end;
}

// A pointer to global memory.
template <class V>
class Global {
 public:
  Global() = default;
  Global(std::nullptr_t) : at_(nullptr) {}
  template <class W>
  Global(Global<W> other) : at_(other) {}  // to const
  V &operator[](long long i) const {
    check_inside(at_ + i, sizeof(V));
    return at_[i];
  }
  Global operator+(long long i) const {
    Global moved;
    moved.at_ = at_ + i;
    return moved;
  }
  operator V *() const { return at_; }

 private:
  V *at_;
};

inline void run_fiber() {
  while (true) {  // again for every block
    body();
    fibers[current].state = State::kDone;
    --alive;
    if (alive && at_barrier == alive) release_block();
    wait();
  }
}

inline uint64_t next_random(uint64_t &s) {
  s ^= s << 13, s ^= s >> 7, s ^= s << 17;
  return s;
}

inline void start(int i) {
  Fiber &f = fibers[i];
  f.started = true;
  getcontext(&f.first);
  f.first.uc_stack.ss_sp = stacks.data() + static_cast<std::size_t>(i) * kStack, f.first.uc_stack.ss_size = kStack;
  f.first.uc_link = nullptr;
  makecontext(&f.first, run_fiber, 0);
  setcontext(&f.first);
}

// lanes: 0 in order, 1 in reverse, else a seed: shuffled anew in every round.
inline bool run_block(unsigned index, uint64_t lanes) {
  static int order[kMaxThreads];
  const int n = static_cast<int>(block_size.x);
  block_index = {index, 0, 0}, ++block_serial;
  alive = n, at_barrier = 0, barriers_done = 0, votes[0] = votes[1] = 0;
  for (int i = 0; i < n; ++i) {
    Fiber &f = fibers[i];
    f.state = State::kReady, f.calls = f.blocks = f.warps = 0;
    order[i] = lanes == 1 ? n - 1 - i : i;
  }
  for (Warp &w : warps) w.waiting = 0;
  static uint64_t random;
  random = lanes * 0x9e3779b97f4a7c15ull + index + 1;
  static bool moved;
  moved = true;
  while (alive) {
    if (!moved) {
      std::snprintf(error, sizeof error, "block %u: some threads wait where others never come (line %d)", index,
                    fibers[order[0]].line);
      return false;
    }
    moved = false;
    if (lanes > 1)
      for (int i = n - 1; i > 0; --i) std::swap(order[i], order[next_random(random) % (i + 1)]);
    for (volatile int k = 0; k < n; k = k + 1) {
      if (fibers[order[k]].state != State::kReady) continue;
      moved = true, current = order[k];
      const int back = _setjmp(scheduler);
      if (back == 2) return false;
      if (back == 1) continue;
      if (fibers[current].started) _longjmp(fibers[current].at, 1);
      start(current);
    }
  }
  return true;
}

// False, with `error`, where a check failed; the fibers are then left where they stand.
inline bool run(unsigned grid, unsigned threads, uint64_t lanes, std::function<void()> kernel) {
  block_size = {threads, 1, 1}, grid_size = {grid, 1, 1};
  body = std::move(kernel);
  for (unsigned b = 0; b < grid; ++b)
    if (!run_block(lanes == 1 ? grid - 1 - b : b, lanes)) {
      for (Fiber &f : fibers) f.started = false;
      return false;
    }
  return true;
}

struct ThreadIndex {
  struct X {
    operator unsigned() const { return static_cast<unsigned>(current); }
  } x;
};

}  // namespace emulation

inline emulation::ThreadIndex threadIdx;
#define blockIdx emulation::block_index
#define blockDim emulation::block_size
#define gridDim emulation::grid_size
#define __syncthreads() emulation::block_barrier(0, __LINE__)
#define __syncthreads_or(vote) emulation::block_barrier(vote, __LINE__)
#define __syncwarp() emulation::warp_barrier(__LINE__)
#define __ballot_sync(mask, vote) emulation::ballot(vote, __LINE__)
#define __any_sync(mask, vote) (emulation::ballot(vote, __LINE__) != 0)
#define __shfl_sync(mask, value, lane) emulation::shuffle(value, lane, __LINE__)
#define __shfl_xor_sync(mask, value, bits) emulation::shuffle(value, (emulation::current ^ (bits)), __LINE__)
inline int __ffs(unsigned x) { return __builtin_ffs(static_cast<int>(x)); }
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline void atomicAdd(int *at, int value) { *at += value; }
inline void atomicMin(int *at, int value) { *at = value < *at ? value : *at; }
