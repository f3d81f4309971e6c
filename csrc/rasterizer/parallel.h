// Runs tasks on a small pool of threads that sleep while there is nothing to do (no spinning: other work shares
// the machine). Tasks may run on any worker in any order, so nothing that is computed may depend on either.
#pragma once
#include <cstddef>

namespace perception {

using Task = void (*)(void *context, std::size_t task, int worker);

// Calls run(context, task, worker) for task in [0, tasks), worker in [0, threads). Blocks until all are done.
void parallel_for(int threads, std::size_t tasks, Task run, void *context);

int hardware_threads();

// The same with a callable body(task, worker).
template <class Body>
void parallel_for(int threads, std::size_t tasks, Body &&body) {
  parallel_for(
      threads, tasks,
      [](void *context, std::size_t task, int worker) { (*static_cast<Body *>(context))(task, worker); },
      const_cast<void *>(static_cast<const void *>(&body)));
}

}  // namespace perception
