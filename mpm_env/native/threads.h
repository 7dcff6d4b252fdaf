// A few threads that wait for the next call, since a substep is too short to start any.
#pragma once
#include <functional>

int threads();  // how many a call may use: the cores this process may run on, or MPM_ENV_THREADS

// Runs task(i) for i in [0, count) on up to `threads()` threads, this one among them. A call from inside another one,
// or while another is under way, runs all of its tasks itself.
void each(int count, const std::function<void(int)>& task);
