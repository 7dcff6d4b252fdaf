// Momentum exchange between many points and a few bodies in joint space. coupling/exchange.py says the same in JAX, with
// the equations, and stays the reference. Points are taken sixteen at a time; what is summed over all of them is summed
// and solved in f64.
#pragma once
#include <cmath>
#include <limits>
#include <vector>

#include "constraints.h"
#include "geoms.h"

namespace MPM_ISA {

constexpr double TINY = 1e-20, NOISE = 1e-6;  // those of exchange.py and contact.py, as a test sees to

// The sum over lanes.
template <class S> INLINE double total(const Pack<S>& a) {
  alignas(64) S lane[W];
  a.store(lane);
  double sum[4] = {0, 0, 0, 0};
  for (int l = 0; l < W; ++l) sum[l % 4] += lane[l];
  return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

enum CrowdRow { NORMAL = 0, SPEED = 3, MASS = 6, FRICTION = 7, HOLD = 8, SLACK = 9, LEVER = 10 };

// Points against bodies, packed: sixteen at a time, the last ones without mass.
template <class S> struct Crowd {
  int packs, nv;
  std::vector<Pack<S>> row;  // a pack's rows behind each other, in the order of CrowdRow; of the lever 3 nv

  Crowd(int packs, int nv) : packs(packs), nv(nv), row(size_t(packs) * (LEVER + 3 * nv), Pack<S>(S(0))) {}
  INLINE Pack<S>* of(int k) { return row.data() + size_t(k) * (LEVER + 3 * nv); }
  INLINE S* at(int64_t i) { return reinterpret_cast<S*>(of(int(i / W))) + i % W; }  // of one point, to fill it
};
// The inelastic contact with Coulomb friction and adhesion: impulses f on points that move with w relative to their bodies.
template <class S> INLINE void impulses(const Pack<S>* p, const Rows<S>& w, Rows<S>& f) {
  const Pack<S>*n = p + NORMAL, m = p[MASS], hold = p[HOLD];
  Pack<S> approach = -(w[0] * n[0] + w[1] * n[1] + w[2] * n[2]), normal = largest(m * (approach - p[SLACK]), -hold);
  Rows<S> slide;
  for (int i = 0; i < 3; ++i) slide[i] = w[i] + approach * n[i];
  Pack<S> held = p[FRICTION] * (normal + hold) / root(dot<S>(slide, slide) + S(TINY));
  held = select<S>(held > m, m, held);
  Pack<S> push = normal - held * approach;
  for (int i = 0; i < 3; ++i) f[i] = push * n[i] - held * w[i];
}

// Derivative (3, 3) of minus the impulses by w.
template <class S> INLINE void stiffness(const Pack<S>* p, const Rows<S>& w, Pack<S> D[3][3]) {
  const Pack<S> zero(S(0)), one(S(1));
  const Pack<S>*n = p + NORMAL, hold = p[HOLD];
  Pack<S> approach = -(w[0] * n[0] + w[1] * n[1] + w[2] * n[2]), normal = largest(p[MASS] * (approach - p[SLACK]), -hold);
  Rows<S> t;
  for (int i = 0; i < 3; ++i) t[i] = w[i] + approach * n[i];
  Pack<S> speed = root(dot<S>(t, t) + S(TINY)), rub = p[FRICTION] * (normal + hold) / speed;
  for (int i = 0; i < 3; ++i) t[i] = t[i] / speed;
  Pack<S> m = select<S>(p[MASS] * (approach - p[SLACK]) > -hold, p[MASS], zero);
  Bits<S> sticks = rub >= p[MASS];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      Pack<S> eye = i == j ? one : zero, nn = n[i] * n[j];
      Pack<S> slides = m * (nn - p[FRICTION] * t[i] * n[j]) + rub * (eye - nn - t[i] * t[j]);
      D[i][j] = select<S>(sticks, m * nn + p[MASS] * (eye - nn), slides);
    }
}

// What the exchange did: its impulses are those of `impulses` times `scale`, with the points' w left in the crowd.
struct Outcome {
  double residual = 0, scale = 1;
  Vector change;  // (nv,) of the joint velocities
  Vector given;   // of the rigid constraints
};

// Solves for the change of the joint velocities q with mass matrix M (nv, nv), from points that move with w as they would
// without contact and constraints. `energy` is twice the points' kinetic energy.
template <class S>
Outcome exchange(Crowd<S>& crowd, const Vector& M, const Constraints& rows, const Vector& q, double energy, int iterations) {
  const int nv = crowd.nv, packs = crowd.packs;
  const double rounding = std::numeric_limits<S>::epsilon();
  Outcome out;
  out.change.assign(nv, 0);
  out.given = rows.given;
  const bool constrained = nv && rows.count;
  Settled held{out.change, out.given, 0};
  const Vector mobility = constrained ? inverse(M, nv) : Vector();
  if (constrained) held = rows.settled(M, mobility, q, Vector(nv, 0), Vector(nv, 0), rounding);
  if (nv == 0 || packs == 0) { out.change = held.change; out.given = held.given; out.residual = held.left; return out; }
  Vector q_held(q);
  if (constrained) {
    for (int a = 0; a < nv; ++a) q_held[a] += held.change[a];
    for (int k = 0; k < packs; ++k) {
      Pack<S>*p = crowd.of(k), *lever = p + LEVER;
      for (int a = 0; a < nv; ++a) for (int i = 0; i < 3; ++i) p[SPEED + i] = p[SPEED + i] - S(held.change[a]) * lever[3 * a + i];
    }
  }
  std::vector<Pack<S>> scratch(size_t(packs) * 6 + size_t(STEPS) * nv + size_t(nv) * nv);
  Pack<S>* free = scratch.data();            // w without contact, three rows a pack
  Pack<S>* moved = free + 3 * size_t(packs);  // how the bodies' points move with a step
  Pack<S>* sum = moved + 3 * size_t(packs);   // (STEPS, nv) pulls, or (nv, nv)
  for (int k = 0; k < packs; ++k) for (int i = 0; i < 3; ++i) free[3 * k + i] = crowd.of(k)[SPEED + i];

  // metric = (M + J^T m J)^-1, and what the bodies would get if all points stuck to them
  Vector stick(nv, 0), H(M);
  for (int a = 0; a < nv * nv; ++a) sum[a] = Pack<S>(S(0));
  std::vector<Pack<S>> stuck(nv, Pack<S>(S(0)));
  for (int k = 0; k < packs; ++k) {
    const Pack<S>*p = crowd.of(k), *lever = p + LEVER;
    for (int a = 0; a < nv; ++a) {
      const Pack<S>* A = lever + 3 * a;
      Rows<S> mA = {p[MASS] * A[0], p[MASS] * A[1], p[MASS] * A[2]};
      stuck[a] = stuck[a] + mA[0] * p[SPEED] + mA[1] * p[SPEED + 1] + mA[2] * p[SPEED + 2];
      for (int b = 0; b <= a; ++b) {
        const Pack<S>* B = lever + 3 * b;
        sum[a * nv + b] = sum[a * nv + b] + mA[0] * B[0] + mA[1] * B[1] + mA[2] * B[2];
      }
    }
  }
  Vector points_mass(nv * nv);
  for (int a = 0; a < nv; ++a) {
    stick[a] = total(stuck[a]);
    for (int b = 0; b <= a; ++b) points_mass[a * nv + b] = points_mass[b * nv + a] = total(sum[a * nv + b]);
  }
  for (int j = 0; j < nv * nv; ++j) H[j] += points_mass[j];
  for (int i = 0; i < rows.count; ++i)
    if (held.given[i] > rows.low[i] && held.given[i] < rows.high[i])
      for (int a = 0; a < nv; ++a)
        for (int b = 0; b < nv; ++b) H[a * nv + b] += rows.D[i] * rows.J[i * nv + a] * rows.J[i * nv + b];
  const Vector stuck_mass(H), metric = inverse(stuck_mass, nv);

  // The equation's remainder for a change of q, and its size in the metric.
  Vector moved_q(nv);
  auto left_over = [&](const Vector& change, const Pack<S>* pull, Vector& R) {
    R = times(M, change);
    for (int a = 0; a < nv; ++a) { R[a] += total(pull[a]); moved_q[a] = q_held[a] + change[a]; }
    if (constrained) rows.take(rows.pushes(moved_q), held.given, R);
    return length(metric, R);
  };

  Vector change(nv, 0), R(nv), tried(nv), R_tried(nv), best_change(nv), best_R(nv);
  double size = 0;
  // Adds to the j-th pulls what points of a pack pull that move with w.
  auto pull = [&](int j, const Pack<S>* p, const Rows<S>& w) {
    Rows<S> f;
    impulses<S>(p, w, f);
    for (int a = 0; a < nv; ++a) {
      const Pack<S>* A = p + LEVER + 3 * a;
      sum[j * nv + a] = sum[j * nv + a] + f[0] * A[0] + f[1] * A[1] + f[2] * A[2];
    }
  };
  // The best of some changes of q, which propose(j) puts into `tried`, by their pulls: becomes `change` if it helps.
  // Returns which, or -1.
  auto choose = [&](int count, auto propose) {
    int best = -1;
    double least = 0;
    for (int j = 0; j < count; ++j) {
      propose(j);
      const double s = left_over(tried, sum + j * nv, R_tried);
      if (best < 0 || !(s >= least)) { best = j; least = s; best_change = tried; best_R = R_tried; }
    }
    if (!(least < size)) return -1;
    change = best_change; R = best_R; size = least;
    return best;
  };
  // Goes to the best of some changes of q, if it helps. Returns whether it did.
  auto nearest_of = [&](const Vector* changes, int count) {
    for (int j = 0; j < count * nv; ++j) sum[j] = Pack<S>(S(0));
    std::vector<S> further(size_t(count) * nv);
    for (int j = 0; j < count; ++j) for (int a = 0; a < nv; ++a) further[j * nv + a] = S(changes[j][a] - change[a]);
    auto further_on = [&](const Pack<S>* p, int j, Rows<S>& w) {
      for (int i = 0; i < 3; ++i) w[i] = p[SPEED + i];
      for (int a = 0; a < nv; ++a) for (int i = 0; i < 3; ++i) w[i] = w[i] - further[j * nv + a] * p[LEVER + 3 * a + i];
    };
    Rows<S> w;
    for (int k = 0; k < packs; ++k) for (int j = 0; j < count; ++j) { further_on(crowd.of(k), j, w); pull(j, crowd.of(k), w); }
    const int best = choose(count, [&](int j) { tried = changes[j]; });
    if (best < 0) return false;
    for (int k = 0; k < packs; ++k) { further_on(crowd.of(k), best, w); for (int i = 0; i < 3; ++i) crowd.of(k)[SPEED + i] = w[i]; }
    return true;
  };
  // The same among some shares of a step.
  auto nearer = [&](const Vector& step, int shares) {
    for (int j = 0; j < shares * nv; ++j) sum[j] = Pack<S>(S(0));
    for (int k = 0; k < packs; ++k) {
      const Pack<S>*p = crowd.of(k), *lever = p + LEVER;
      Rows<S> dw = {Pack<S>(S(0)), Pack<S>(S(0)), Pack<S>(S(0))};
      for (int a = 0; a < nv; ++a) for (int i = 0; i < 3; ++i) dw[i] = dw[i] + S(step[a]) * lever[3 * a + i];
      for (int i = 0; i < 3; ++i) moved[3 * k + i] = dw[i];
      for (int j = 0; j < shares; ++j) {
        Rows<S> w;
        for (int i = 0; i < 3; ++i) w[i] = p[SPEED + i] - S(STEP[j]) * dw[i];
        pull(j, p, w);
      }
    }
    const int best = choose(shares, [&](int j) { for (int a = 0; a < nv; ++a) tried[a] = change[a] + STEP[j] * step[a]; });
    if (best < 0) return false;
    for (int k = 0; k < packs; ++k)
      for (int i = 0; i < 3; ++i) crowd.of(k)[SPEED + i] = crowd.of(k)[SPEED + i] - S(STEP[best]) * moved[3 * k + i];
    return true;
  };
  // The change of q by a Newton step from `change` for points of stiffness K that pull so, which the constraints take
  // to the full: their kinks would stop a line search. Shorter steps are those of heavier points.
  Constraints later(rows);
  later.given = held.given;
  auto held_step = [&](const Vector& K, const Vector& pulled, double share) {
    Vector A(K), whole(M);
    for (int j = 0; j < nv * nv; ++j) { A[j] += (1 / share - 1) * stuck_mass[j]; whole[j] += A[j]; }
    Vector load = times(A, change);
    for (int a = 0; a < nv; ++a) load[a] -= pulled[a];
    return later.settled(whole, metric, q_held, load, change, rounding).change;
  };

  size = std::numeric_limits<double>::infinity();
  nearer(Vector(nv, 0), 1);  // no contact: only what remains of the equation is wanted
  const double none = size, enough = SOLVED * rounding * none;
  Vector step = times(metric, stick);
  if (constrained) {
    Vector pulled(nv);
    for (int a = 0; a < nv; ++a) pulled[a] = -stick[a];
    step = held_step(points_mass, pulled, 1);
    nearest_of(&step, 1);
  } else {
    nearer(step, 1);
  }
  bool going = size > enough;
  for (int it = 0; going && it < iterations; ++it) {
    for (int j = 0; j < nv * nv; ++j) sum[j] = Pack<S>(S(0));
    for (int k = 0; k < packs; ++k) {
      const Pack<S>*p = crowd.of(k), *lever = p + LEVER;
      Rows<S> w = {p[SPEED], p[SPEED + 1], p[SPEED + 2]};
      Pack<S> D[3][3];
      stiffness<S>(p, w, D);
      for (int a = 0; a < nv; ++a) {
        const Pack<S>* A = lever + 3 * a;
        Rows<S> DA;
        for (int i = 0; i < 3; ++i) DA[i] = D[i][0] * A[0] + D[i][1] * A[1] + D[i][2] * A[2];
        for (int b = 0; b < nv; ++b) {
          const Pack<S>* B = lever + 3 * b;
          sum[b * nv + a] = sum[b * nv + a] + DA[0] * B[0] + DA[1] * B[1] + DA[2] * B[2];
        }
      }
    }
    if (constrained) {
      Vector K(nv * nv), pulled(R), tries[STEPS];  // R = M change - J^T (p - given) + pulled
      for (int j = 0; j < nv * nv; ++j) K[j] = total(sum[j]);
      const Vector M_change = times(M, change);
      for (int a = 0; a < nv; ++a) { pulled[a] -= M_change[a]; moved_q[a] = q_held[a] + change[a]; }
      rows.take(held.given, rows.pushes(moved_q), pulled);
      for (int j = 0; j < STEPS; ++j) tries[j] = held_step(K, pulled, STEP[j]);
      going = nearest_of(tries, STEPS) && size > enough;
      continue;
    }
    H = M;
    for (int j = 0; j < nv * nv; ++j) H[j] += total(sum[j]);
    for (int a = 0; a < nv; ++a) step[a] = -R[a];
    solve(H, step, nv, 1);
    going = nearer(step, STEPS) && size > enough;
  }

  // Where that has not converged, impulses are scaled down until they dissipate.
  for (int a = 0; a < nv; ++a) sum[a] = Pack<S>(S(0));
  double work = 0, doubled = 0;
  for (int k = 0; k < packs; ++k) {
    const Pack<S>*p = crowd.of(k), *lever = p + LEVER;
    Rows<S> w = {p[SPEED], p[SPEED + 1], p[SPEED + 2]}, f, before = {free[3 * k], free[3 * k + 1], free[3 * k + 2]};
    impulses<S>(p, w, f);
    work += total(dot<S>(f, before));
    doubled += total(dot<S>(f, f) / select<S>(p[MASS] > S(0), p[MASS], Pack<S>(S(1))));
    for (int a = 0; a < nv; ++a) sum[a] = sum[a] + f[0] * lever[3 * a] + f[1] * lever[3 * a + 1] + f[2] * lever[3 * a + 2];
  }
  Vector pulled(nv), push(nv);  // push: what the bodies give, their joint velocities fall by it
  for (int a = 0; a < nv; ++a) push[a] = pulled[a] = total(sum[a]);
  if (constrained) {
    Vector load(nv), guess(nv);
    for (int a = 0; a < nv; ++a) { load[a] = -pulled[a]; guess[a] = held.change[a] + change[a]; }
    const Settled whole = rows.settled(M, mobility, q, load, guess, rounding);
    for (int a = 0; a < nv; ++a) push[a] = held.change[a] - whole.change[a];
  } else {
    H = M;
    solve(H, push, nv, 1);
  }
  for (int a = 0; a < nv; ++a) doubled += pulled[a] * push[a];
  const double noise = NOISE * energy;
  if (none * none > noise) out.residual = size / std::max(none, double(std::numeric_limits<S>::min()));
  if (std::abs(work) > noise && doubled > 0) out.scale = std::min(std::max(-work / doubled, 0.0), 1.0);
  for (int a = 0; a < nv; ++a) { out.change[a] = held.change[a] - out.scale * push[a]; pulled[a] *= -out.scale; }
  if (constrained) {
    const Settled done = rows.settled(M, mobility, q, pulled, out.change, rounding);
    out.change = done.change;
    out.given = done.given;
    out.residual = std::max({out.residual, held.left, done.left});
  }
  return out;
}

}  // namespace MPM_ISA
