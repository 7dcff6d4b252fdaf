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

// A call is a round. Whoever is awake takes its tasks one by one; nobody waits for a thread that did not wake in time.
struct Pool {
  const int size;
  const pid_t owner = getpid();
  std::mutex busy;
  std::atomic<uint32_t> round{0};
  std::atomic<uint64_t> next{0};  // the round in the upper half, its next task in the lower: both change together
  std::atomic<int> count{0}, done{0};
  std::atomic<const std::function<void(int)>*> task{nullptr};

  explicit Pool(int size) : size(size) {
    for (int i = 1; i < size; ++i) std::thread([this] { wait_and_work(); }).detach();
  }

  void work(uint32_t mine) {
    inside = true;
    for (uint64_t at = next; uint32_t(at >> 32) == mine && int(uint32_t(at)) < count;)
      if (next.compare_exchange_weak(at, at + 1)) {
        (*task.load())(int(uint32_t(at)));
        done.fetch_add(1);
        at = next;
      }
    inside = false;
  }

  void wait_and_work() {
    for (uint32_t seen = 0;;) {
      for (int spin = 0; round == seen && spin < SPINS; ++spin)
#if defined(__x86_64__)
        __builtin_ia32_pause();
#else
        ;
#endif
      round.wait(seen);
      seen = round;
      work(seen);
    }
  }

  void run(int tasks, const std::function<void(int)>& what) {
    const uint32_t mine = round + 1;
    next = uint64_t(mine) << 32 | INT32_MAX;  // first, so that whoever still looks at the old round finds it over
    done = 0;
    count = tasks;
    task = &what;
    next = uint64_t(mine) << 32;
    round = mine;
    round.notify_all();
    work(mine);
    while (done < tasks) {
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
