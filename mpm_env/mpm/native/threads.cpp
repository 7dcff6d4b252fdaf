#include "threads.h"

#include <sched.h>
#include <unistd.h>

#include <atomic>
#include <cstdint>
#include <cstdlib>
#include <mutex>
#include <thread>

namespace {

constexpr int SPINS = 20000;  // looks before a thread goes to sleep: about as long as the pause between two calls

thread_local bool inside = false;  // this thread is running a task

struct Pool {
  const int size;
  const pid_t owner = getpid();
  std::mutex busy;
  std::atomic<uint32_t> round{0};
  std::atomic<int> next{0}, working{0};
  int count = 0;
  const std::function<void(int)>* task = nullptr;

  explicit Pool(int size) : size(size) {
    for (int i = 1; i < size; ++i) std::thread([this] { wait_and_work(); }).detach();
  }

  void work() {
    inside = true;
    for (int i; (i = next.fetch_add(1)) < count;) (*task)(i);
    inside = false;
  }

  void wait_and_work() {
    for (uint32_t seen = 0;;) {
      for (int spin = 0; round.load() == seen && spin < SPINS; ++spin)
#if defined(__x86_64__)
        __builtin_ia32_pause();
#else
        ;
#endif
      while (round.load() == seen) round.wait(seen);
      seen = round.load();
      work();
      working.fetch_sub(1);
    }
  }

  void run(int tasks, const std::function<void(int)>& what) {
    count = tasks;
    task = &what;
    next = 0;
    working = size - 1;
    round.fetch_add(1);
    round.notify_all();
    work();
    while (working.load() > 0) {
    }
  }
};

}  // namespace

int threads() {
  static const int found = [] {
    if (const char* wish = std::getenv("MPM_ENV_THREADS")) {
      int n = std::atoi(wish);
      if (n > 0) return n;
    }
    cpu_set_t cores;
    return sched_getaffinity(0, sizeof cores, &cores) == 0 ? CPU_COUNT(&cores) : 1;
  }();
  return found;
}

void each(int count, const std::function<void(int)>& task) {
  static Pool* pool = new Pool(threads());  // never destroyed: its threads may still wait when the process ends
  // A process that was forked has no threads but its own.
  if (count > 1 && pool->size > 1 && !inside && pool->owner == getpid()) {
    std::unique_lock<std::mutex> mine(pool->busy, std::try_to_lock);
    if (mine) return pool->run(count, task);
  }
  for (int i = 0; i < count; ++i) task(i);
}
