// Nodes to grains: velocities as transfer.g2p, then the grains move, strain, and their material answers.
#pragma once
#include <type_traits>

#include "window.h"

namespace MPM_ISA {

struct NoLaw {};

// Strain grains, as many as the law takes at once, by their velocity gradient, and ask the law. Rows of the arrays are n apart. Not inlined: the
// law needs every register.
template <class S, int D, class L>
__attribute__((noinline)) void answer(const L& law, S dt, const S* C, S* e, S* tau, S* history, int64_t n) {
  Sym<S, D> old, stress;
  Lane<S> G[D][D], M[D][D];  // dt grad v, and G b: b_trial - I = e + M + M^T + M G^T
  for (int k = 0; k < Sym<S, D>::count; ++k) old.c[k] = Lane<S>::load(e + k * n);
  for (int i = 0; i < D; ++i)
    for (int j = 0; j < D; ++j) G[i][j] = dt * Lane<S>::load(C + (i * D + j) * n);
  for (int i = 0; i < D; ++i)
    for (int j = 0; j < D; ++j) {
      M[i][j] = G[i][j];
      for (int k = 0; k < D; ++k) M[i][j] = M[i][j] + G[i][k] * old.at(k, j);
    }
  Sym<S, D> trial = symmetric<S, D>(old.c[2], [&](int i, int j) {
    Lane<S> sum = old.at(i, j) + M[i][j] + M[j][i];
    for (int k = 0; k < D; ++k) sum = sum + M[i][k] * G[j][k];
    return sum;
  });
  Lane<S> memory = history ? Lane<S>::load(history) : Lane<S>(S(0));
  law(trial, stress, memory);
  for (int k = 0; k < Sym<S, D>::count; ++k) { trial.c[k].store(e + k * n); stress.c[k].store(tau + k * n); }
  if (history) memory.store(history);
}

template <class S, int D, class L> void gather(const ToGrains& t, int64_t b, int64_t from, int64_t to) {
  constexpr int ROWS = D == 3 ? 9 : 3, STRESSES = D == 3 ? 6 : 4;
  constexpr bool strains = !std::is_same<L, NoLaw>::value;
  const int64_t n = t.grains;
  const Strides<D> g(t.grid);
  auto rows = [&](void* p, int count) { return (S*)p + b * count * n; };
  S *x = rows(t.x, D), *v = rows(t.v, D), *C = rows(t.C, D * D), *e = rows(t.e, STRESSES), *tau = rows(t.tau, STRESSES);
  S* history = rows(t.history, int(t.memory));
  const S* m = (const S*)t.m + b * n;
  const S* nodes = (const S*)t.nodes + 4 * b * g.nodes;
  const S* parameter = (const S*)t.parameter + b * t.parameters;
  const L law = [&] { if constexpr (strains) return L(parameter + 1); else return L{}; }();
  const S per_cell = S(1 / t.grid.cell_size), dt = parameter[0], per_D = S(4 / t.grid.cell_size);
  const Row<S> row;
  Window<S> win;
  int32_t cell[W], now = EMPTY;
  Pack<S> node[ROWS], sums[16];
  for (auto& a : node) a = Pack<S>(S(0));
  for (int64_t p = from; p < to; p += W) {
    Bits<S> here = Pack<S>::load(m + p) > S(0);
    if (!any(here)) {  // slots without grains, which left or never were
      for (int i = 0; i < D; ++i) Pack<S>(S(0)).store(v + i * n + p);
      for (int i = 0; i < D * D; ++i) Pack<S>(S(0)).store(C + i * n + p);
      continue;
    }
    cells<S, D>(x + p, n, per_cell, g, cell);
    look<S, D>(x + p, n, per_cell, g, win);
    for (int l = 0; l < W; ++l) {
      if (cell[l] != now) {
        now = cell[l];
        const S* q = nodes + 4 * int64_t(now);
#pragma GCC unroll 9
        for (int r = 0; r < ROWS; ++r)
          node[r] = Pack<S>::load(q + 4 * (D == 3 ? (r / 3) * g.node[0] + (r % 3) * g.node[D == 3 ? 1 : 0] : r * g.node[0]));
      }
      // Velocity, and its first moments about the window's first node: sum w v, sum w v i, sum w v j, sum w v k.
      Pack<S> w = row.weight(Pack<S>(win.f[D - 1][l])), V, X, Y(S(0));
      if constexpr (D == 2) {
        X = node[2] * win.w[0][2][l];
        V = node[1] * win.w[0][1][l] + X;
        X = X + V;
        V = node[0] * win.w[0][0][l] + V;
      } else {
        Pack<S> line[3], slope[3];
        Pack<S> w0(win.w[1][0][l]), w1(win.w[1][1][l]), w2(win.w[1][2][l]);
#pragma GCC unroll 3
        for (int i = 0; i < 3; ++i) {
          slope[i] = w2 * node[3 * i + 2];
          line[i] = w1 * node[3 * i + 1] + slope[i];
          slope[i] = slope[i] + line[i];
          line[i] = w0 * node[3 * i] + line[i];
        }
        X = line[2] * win.w[0][2][l];
        V = line[1] * win.w[0][1][l] + X;
        X = X + V;
        V = line[0] * win.w[0][0][l] + V;
        Y = w * (slope[2] * win.w[0][2][l] + slope[1] * win.w[0][1][l] + slope[0] * win.w[0][0][l]);
      }
      V = w * V;
      if constexpr (D == 2) sums[l] = group_sums(V, w * X, V * row.node, Y);
      else sums[l] = group_sums(V, w * X, Y, V * row.node);
    }
    transpose(sums);
    for (int i = 0; i < D; ++i) {
      Pack<S> vi = select<S>(here, sums[i], Pack<S>(S(0)));
      for (int j = 0; j < D; ++j) {
        Pack<S> c = per_D * (sums[4 + 4 * j + i] - Pack<S>::load(win.f[j]) * sums[i]);
        select<S>(here, c, Pack<S>(S(0))).store(C + (i * D + j) * n + p);
      }
      vi.store(v + i * n + p);
      (Pack<S>::load(x + i * n + p) + dt * vi).store(x + i * n + p);
    }
    if constexpr (strains)
      for (int64_t q = p; q < p + W; q += LANES<S>)
        answer<S, D>(law, dt, C + q, e + q, tau + q, t.memory ? history + q : nullptr, n);
  }
}

template <class S, int D> void gather(const ToGrains& t, int64_t b, int64_t from, int64_t to) {
  switch (t.law) {
    case ELASTIC: return gather<S, D, Elastic<S, D>>(t, b, from, to);
    case SAND: return gather<S, D, Sand<S, D>>(t, b, from, to);
    case SNOW: return gather<S, D, Snow<S, D>>(t, b, from, to);
    default: return gather<S, D, NoLaw>(t, b, from, to);
  }
}

}  // namespace MPM_ISA
