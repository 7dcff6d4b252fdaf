// The kernels for one width of registers, which MPM_ISA names: who works on what. mpm_env/mpm/transfer.py and substep.py
// say the same in JAX and stay the reference.
#include "gather.h"
#include "scatter.h"

namespace MPM_ISA {
namespace {

constexpr int SERIAL = 4096;  // grains per thread at least: fewer are not worth waking one for

template <class S, int D> void run(const ToNodes& t) {
  const int64_t cores = t.batch * t.grains < SERIAL ? 1 : threads();
  if (t.batch >= cores && t.batch > 1) return each(int(t.batch), [&](int b) { scatter<S, D>(t, b, 1); });
  const int parts = int(std::min<int64_t>(cores, std::max<int64_t>(t.grains / SERIAL, 1)));
  for (int64_t b = 0; b < t.batch; ++b) scatter<S, D>(t, b, parts);
}

template <class S, int D> void run(const ToGrains& t) {
  const int64_t count = t.stop - t.start;
  if (t.batch * count < SERIAL || threads() == 1) {
    for (int64_t b = 0; b < t.batch; ++b) gather<S, D>(t, b, t.start, t.stop);
    return;
  }
  const int64_t pieces = std::max<int64_t>(1, std::min<int64_t>(count / BLOCK, 4 * threads()));
  each(int(t.batch * pieces), [&](int i) {
    const int64_t b = i / pieces, k = i % pieces, sixteens = count / W;
    gather<S, D>(t, b, t.start + sixteens * k / pieces * W, t.start + sixteens * (k + 1) / pieces * W);
  });
}

template <class T> void pick(const T& t, bool f64) {
  if (t.grid.dim == 3) f64 ? run<double, 3>(t) : run<float, 3>(t);
  else f64 ? run<double, 2>(t) : run<float, 2>(t);
}

}  // namespace

void to_nodes(const ToNodes& t, bool f64) { pick(t, f64); }
void to_grains(const ToGrains& t, bool f64) { pick(t, f64); }

}  // namespace MPM_ISA
