// The constitutive laws of mpm_env/mpm/materials, as many grains at a time as fill a machine register: a law that keeps
// whole tensors has no registers to spare. Parameters come in the order that
// mpm_env/mpm/kernels.py gives them; equations and sources are in the Python classes, which stay the reference.
#pragma once
#include "kernels.h"
#include "pack.h"

namespace MPM_ISA {

template <class S> using Lane = Pack<S, LANES<S>>;
template <class S> using Yes = Bits<S, LANES<S>>;

constexpr double TINY = 1e-30;  // keeps square roots and quotients finite at zero, as in linalg3.py

// Symmetric tensors as in Particles.e: xx zz yy xz in plane strain (the third is out of plane), xx yy zz yz xz xy in 3-D.
template <class S, int D> struct Sym {
  static constexpr int count = D == 3 ? 6 : 4;
  Lane<S> c[count];
  INLINE const Lane<S>& at(int i, int j) const {  // in-plane component
    if constexpr (D == 2) return c[i == j ? i : 3];
    else return c[i == j ? i : 6 - i - j];
  }
};

// The tensor with these in-plane entries (i, j), and in plane strain this one out of plane.
template <class S, int D, class F> INLINE Sym<S, D> symmetric(Lane<S> out_of_plane, F entry) {
  Sym<S, D> r;
  r.c[0] = entry(0, 0); r.c[1] = entry(1, 1);
  if constexpr (D == 2) { r.c[2] = out_of_plane; r.c[3] = entry(0, 1); }
  else { r.c[2] = entry(2, 2); r.c[3] = entry(1, 2); r.c[4] = entry(0, 2); r.c[5] = entry(0, 1); }
  return r;
}

// Principal values of a tensor and, by columns, its in-plane axes.
template <class S, int D> struct Principal {
  Lane<S> value[3], axis[D][D];
};

// Cosine, sine and tangent of the Jacobi angle that removes the off-diagonal element pq.
template <class S> INLINE void rotation(Lane<S> pp, Lane<S> qq, Lane<S> pq, Lane<S>& c, Lane<S>& s, Lane<S>& t) {
  Lane<S> d = qq - pp;
  t = S(2) * pq / (d + with_sign(root(d * d + S(4) * pq * pq + S(TINY)), d));
  c = per_root(S(1) + t * t);
  s = c * t;
}

constexpr int MOST_SWEEPS = 8;  // of cyclic Jacobi; three are usual

template <class S> INLINE Principal<S, 2> eigen(const Sym<S, 2>& e) {
  Principal<S, 2> r;
  Lane<S> c, s, t;
  rotation(e.c[0], e.c[1], e.c[3], c, s, t);
  r.value[0] = e.c[0] - t * e.c[3]; r.value[1] = e.c[1] + t * e.c[3]; r.value[2] = e.c[2];
  r.axis[0][0] = c; r.axis[0][1] = s; r.axis[1][0] = -s; r.axis[1][1] = c;
  return r;
}

template <class S> INLINE Principal<S, 3> eigen(const Sym<S, 3>& e) {
  Principal<S, 3> r;
  for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) r.axis[i][j] = Lane<S>(i == j);
  Sym<S, 3> a = e;
  const S least = sizeof(S) == 4 ? S(1e-16) : S(1e-34);  // squared share of what may stay off the diagonal
  for (int sweep = 0; sweep < MOST_SWEEPS; ++sweep) {
    Lane<S> off = a.c[3] * a.c[3] + a.c[4] * a.c[4] + a.c[5] * a.c[5];
    Lane<S> on = a.c[0] * a.c[0] + a.c[1] * a.c[1] + a.c[2] * a.c[2];
    if (!any(off > on * least + S(1e-36))) break;
    constexpr int turn[3][3] = {{0, 1, 2}, {0, 2, 1}, {1, 2, 0}};
#pragma GCC unroll 3
    for (int k = 0; k < 3; ++k) {
      const int p = turn[k][0], q = turn[k][1], o = turn[k][2], pq = 6 - p - q, po = 6 - p - o, qo = 6 - q - o;
      Lane<S> c, s, t;
      rotation(a.c[p], a.c[q], a.c[pq], c, s, t);
      a.c[p] = a.c[p] - t * a.c[pq]; a.c[q] = a.c[q] + t * a.c[pq]; a.c[pq] = Lane<S>(S(0));
      Lane<S> x = a.c[po];
      a.c[po] = c * x - s * a.c[qo]; a.c[qo] = s * x + c * a.c[qo];
      for (int i = 0; i < 3; ++i) {
        x = r.axis[i][p];
        r.axis[i][p] = c * x - s * r.axis[i][q]; r.axis[i][q] = s * x + c * r.axis[i][q];
      }
    }
  }
  for (int i = 0; i < 3; ++i) r.value[i] = a.c[i];
  return r;
}

template <class S, int D> INLINE Sym<S, D> compose(const Principal<S, D>& r, const Lane<S>* value) {
  return symmetric<S, D>(value[2], [&](int i, int j) {
    Lane<S> sum = r.axis[i][0] * value[0] * r.axis[j][0];
    for (int k = 1; k < D; ++k) sum = sum + r.axis[i][k] * value[k] * r.axis[j][k];
    return sum;
  });
}

// Product of symmetric tensors with the same axes.
template <class S, int D> INLINE Sym<S, D> product(const Sym<S, D>& a, const Sym<S, D>& b) {
  return symmetric<S, D>(a.c[2] * b.c[2], [&](int i, int j) {
    Lane<S> sum = a.at(i, 0) * b.at(0, j);
    for (int k = 1; k < D; ++k) sum = sum + a.at(i, k) * b.at(k, j);
    return sum;
  });
}

// Power series of the logarithm and the exponential, of even order: exact to the last digit where no element of e
// exceeds the limit. Most strains do with the few terms.
template <class S> struct Series {
  static constexpr int few = sizeof(S) == 4 ? 4 : 6, many = sizeof(S) == 4 ? 6 : 10;
  static constexpr S few_limit = sizeof(S) == 4 ? S(0.0065) : S(0.001), limit = sizeof(S) == 4 ? S(0.03) : S(0.01);
};

// a_1 e + a_2 e^2 + ... in pairs of powers.
template <int ORDER, class S, int D> INLINE Sym<S, D> series(const Sym<S, D>& e, const S* a) {
  Sym<S, D> square = product(e, e), sum;
  auto pair = [&](int k, int c) { return c < 3 ? a[k] + a[k + 1] * e.c[c] : a[k + 1] * e.c[c]; };
  for (int c = 0; c < Sym<S, D>::count; ++c) sum.c[c] = pair(ORDER - 2, c);
  for (int k = ORDER - 4; k >= 0; k -= 2) {
    sum = product(square, sum);
    for (int c = 0; c < Sym<S, D>::count; ++c) sum.c[c] = sum.c[c] + pair(k, c);
  }
  return product(e, sum);
}

// Half the logarithm of I + e.
template <int ORDER, class S, int D> INLINE Sym<S, D> half_log(const Sym<S, D>& e) {
  S a[ORDER];
  for (int k = 1; k <= ORDER; ++k) a[k - 1] = S(k % 2 ? 0.5 : -0.5) / S(k);
  return series<ORDER>(e, a);
}

// exp(2 h) - I.
template <int ORDER, class S, int D> INLINE Sym<S, D> exp_twice(const Sym<S, D>& h) {
  S a[ORDER], factor = 1;
  for (int k = 1; k <= ORDER; ++k) a[k - 1] = factor *= S(2) / S(k);
  return series<ORDER>(h, a);
}

// How many terms of the series these strains need: few, many, or none of both (0).
template <class S, int D> INLINE int terms(const Sym<S, D>& e) {
  Lane<S> most = magnitude(e.c[0]);
  for (int k = 1; k < Sym<S, D>::count; ++k) {
    Lane<S> a = magnitude(e.c[k]);
    most = select<S>(a < most, most, a);  // keeps a NaN
  }
  if (any(~(most < Series<S>::limit))) return 0;
  return any(most > Series<S>::few_limit) ? Series<S>::many : Series<S>::few;
}

// Every law: trial strain in, strain and Kirchhoff stress out; memory is the grains' history.
template <class S, int D> struct Elastic {
  S lam, mu, least_b;
  explicit Elastic(const S* p) : lam(p[0]), mu(p[1]), least_b(p[2]) {}
  INLINE void operator()(Sym<S, D>& e, Sym<S, D>& tau, Lane<S>&) const {
    const int order = terms(e);
    if (order == Series<S>::few) return by_series<Series<S>::few>(e, tau);
    if (order == Series<S>::many) return by_series<Series<S>::many>(e, tau);
    auto r = eigen(e);
    Lane<S> h[3];
    for (int i = 0; i < 3; ++i) h[i] = S(0.5) * log1p(largest(r.value[i], least_b - S(1)));
    Lane<S> tr = lam * (h[0] + h[1] + h[2]);
    for (auto& a : h) a = S(2) * mu * a + tr;
    tau = compose(r, h);
  }

  template <int ORDER> INLINE void by_series(const Sym<S, D>& e, Sym<S, D>& tau) const {
    tau = half_log<ORDER>(e);
    Lane<S> tr = lam * (tau.c[0] + tau.c[1] + tau.c[2]);
    for (int k = 0; k < Sym<S, D>::count; ++k) tau.c[k] = k < 3 ? S(2) * mu * tau.c[k] + tr : S(2) * mu * tau.c[k];
  }
};

template <class S, int D> struct Sand {
  S lam, mu, slope, tip, cap, least_b;  // slope: (3 lam + 2 mu) / (2 mu) alpha; cap < 0: no volume correction
  explicit Sand(const S* p) : lam(p[0]), mu(p[1]), slope(p[2]), tip(p[3]), cap(p[4]), least_b(p[5]) {}

  // From the trace and the squared norm of the deviator: how much of the deviator stays, and the trace.
  INLINE void flow(Lane<S>& tr, Lane<S> norm2, Lane<S>& keep, Lane<S>& memory) const {
    Lane<S> trial = tr;
    if (cap >= 0) tr = tr + memory;
    Lane<S> norm = root(norm2 + S(TINY)), over = norm + slope * (tr - tip);
    Yes<S> tension = tr >= tip;
    keep = select<S>(tension, Lane<S>(S(0)), S(1) - largest(over, S(0)) / norm);
    tr = select<S>(tension, Lane<S>(tip), tr);
    if (cap >= 0) memory = smallest(largest(memory + trial - tr, -cap), cap);
  }

  INLINE void operator()(Sym<S, D>& e, Sym<S, D>& tau, Lane<S>& memory) const {
    const int order = terms(e);
    if (order == Series<S>::few) return by_series<Series<S>::few>(e, tau, memory);
    if (order == Series<S>::many) return by_series<Series<S>::many>(e, tau, memory);
    auto r = eigen(e);
    Lane<S> h[3], g[3], keep, norm2(S(0));
    for (int i = 0; i < 3; ++i) h[i] = S(0.5) * log1p(largest(r.value[i], least_b - S(1)));
    Lane<S> tr = h[0] + h[1] + h[2], mean = tr * S(1.0 / 3);
    for (auto& a : h) { a = a - mean; norm2 = norm2 + a * a; }
    flow(tr, norm2, keep, memory);
    mean = tr * S(1.0 / 3);
    for (int i = 0; i < 3; ++i) {
      h[i] = keep * h[i] + mean;
      g[i] = expm1(S(2) * h[i]);
      h[i] = S(2) * mu * h[i] + lam * tr;
    }
    e = compose(r, g);
    tau = compose(r, h);
  }

  template <int ORDER> INLINE void by_series(Sym<S, D>& e, Sym<S, D>& tau, Lane<S>& memory) const {
    Sym<S, D> h = half_log<ORDER>(e);
    Lane<S> tr = h.c[0] + h.c[1] + h.c[2], mean = tr * S(1.0 / 3), keep, norm2(S(0));
    for (int k = 0; k < 3; ++k) { h.c[k] = h.c[k] - mean; norm2 = norm2 + h.c[k] * h.c[k]; }
    for (int k = 3; k < Sym<S, D>::count; ++k) norm2 = norm2 + S(2) * h.c[k] * h.c[k];
    flow(tr, norm2, keep, memory);
    mean = tr * S(1.0 / 3);
    for (int k = 0; k < Sym<S, D>::count; ++k) {
      h.c[k] = keep * h.c[k];
      if (k < 3) h.c[k] = h.c[k] + mean;
      tau.c[k] = S(2) * mu * h.c[k];
      if (k < 3) tau.c[k] = tau.c[k] + lam * tr;
    }
    e = exp_twice<ORDER>(h);
  }
};

template <class S, int D> struct Snow {
  S lam, mu, theta_c, theta_s, xi, least_Jp, most_ln_Jp, least_b;
  explicit Snow(const S* p)
      : lam(p[0]), mu(p[1]), theta_c(p[2]), theta_s(p[3]), xi(p[4]), least_Jp(p[5]), most_ln_Jp(p[6]), least_b(p[7]) {}
  INLINE void operator()(Sym<S, D>& e, Sym<S, D>& tau, Lane<S>& memory) const {
    auto r = eigen(e);
    Lane<S> s[3], g[3], ratio[3], flow(S(1));
    for (int i = 0; i < 3; ++i) {
      Lane<S> b = largest(r.value[i], least_b - S(1)), free = b / (S(1) + root(S(1) + b));  // stretch minus one
      s[i] = smallest(largest(free, -theta_c), theta_s);
      ratio[i] = (free - s[i]) / (S(1) + s[i]);
      flow = flow * (S(1) + ratio[i]);
      g[i] = s[i] * (S(2) + s[i]);
    }
    // (1 + a)(1 + b)(1 + c) - 1 without losing the digits of small a, b, c.
    auto joint = [](const Lane<S>* a) { Lane<S> ab = a[0] + a[1] + a[0] * a[1]; return ab + a[2] + ab * a[2]; };
    memory = smallest(memory + log1p(joint(ratio), flow), most_ln_Jp);
    Lane<S> Jp = largest(exp(memory), least_Jp), harder = exp(xi * (S(1) - Jp)), Jm1 = joint(s);
    Lane<S> volume = lam * Jm1 * (S(1) + Jm1);
    for (auto& a : s) a = harder * (S(2) * mu * a * (S(1) + a) + volume);
    e = compose(r, g);
    tau = compose(r, s);
  }
};

}  // namespace MPM_ISA
