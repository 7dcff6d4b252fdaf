// Grains to nodes: APIC momentum and MLS-MPM forces, as transfer.p2g, then substep.node_velocities and walls.
//
// Successive grains of one cell add into the same rows, which go to memory when the cell changes. Several threads own a
// part of the nodes each and add in the order of the slots, so the sums do not depend on how many threads there are.
#pragma once
#include "window.h"

namespace MPM_ISA {

constexpr double LEAST_SPEED2 = 1e-30;  // (m/s)^2, guards the direction of sliding at rest, as in substep.py

// Which columns of nodes grains reach: per first column of a window, lowest and highest first node along the last axis.
struct Reach { int32_t low = INT32_MAX, high = -1; };

struct Plan {  // of one environment
  std::vector<int32_t> cell;               // of each slot
  std::vector<int32_t> first, last;        // per block: lowest and highest first plane of its windows
  std::vector<Reach> reach;                // per column
  std::vector<int64_t> at_plane;           // grains whose window starts at each plane
  int64_t low_row, high_row;               // lowest and highest first row of windows, the columns of a plane
};

template <class S, int D> void survey(const ToNodes& t, const S* x, const S* m, Plan& plan) {
  const int64_t n = t.grains, planes = t.grid.shape[0], tall = t.grid.shape[D - 1];
  const int64_t columns = D == 3 ? planes * t.grid.shape[1] : planes, per_plane = columns / planes;
  const Strides<D> g(t.grid);
  plan.cell.resize(n);
  plan.first.assign((n + BLOCK - 1) / BLOCK, INT32_MAX);
  plan.last.assign(plan.first.size(), -1);
  plan.reach.assign(columns, Reach{});
  plan.at_plane.assign(planes, 0);
  plan.low_row = per_plane;
  plan.high_row = -1;
  int32_t before = EMPTY;
  int64_t run = 0, plane = 0;
  for (int64_t p = 0; p < n; p += W) {
    cells<S, D>(x + p, n, S(1 / t.grid.cell_size), g, &plan.cell[p]);
    int32_t &first = plan.first[p / BLOCK], &last = plan.last[p / BLOCK];
    for (int l = 0; l < W; ++l) {
      if (!(m[p + l] > 0)) { plan.cell[p + l] = EMPTY; continue; }
      int32_t c = plan.cell[p + l];
      if (c != before) {
        before = c;
        plan.at_plane[plane] += run;
        run = 0;
        int32_t column = c / int32_t(tall), z = c - column * int32_t(tall);
        Reach& r = plan.reach[column];
        r.low = std::min(r.low, z);
        r.high = std::max(r.high, z);
        plane = column / per_plane;
        const int64_t row = column - plane * per_plane;
        plan.low_row = std::min(plan.low_row, row);
        plan.high_row = std::max(plan.high_row, row);
      }
      first = std::min(first, int32_t(plane));
      last = std::max(last, int32_t(plane));
      ++run;
    }
  }
  plan.at_plane[plane] += run;
}

template <class S, int D> struct Scatter {
  const ToNodes& t;
  const Plan& plan;
  const S *x, *v, *C, *tau, *m, *V0, *gravity, dt;
  S* nodes;
  const Strides<D> g;
  static constexpr int ROWS = D == 3 ? 9 : 3, STRESSES = D == 3 ? 6 : 4;

  Scatter(const ToNodes& t, const Plan& plan, int64_t b)
      : t(t), plan(plan), x(at(t.x, b, D)), v(at(t.v, b, D)), C(at(t.C, b, D * D)), tau(at(t.tau, b, STRESSES)),
        m(at(t.m, b, 1)), V0(at(t.V0, b, 1)), gravity((const S*)t.step + b * (D + 1) + 1), dt(gravity[-1]), g(t.grid) {
    nodes = (S*)t.nodes + 4 * b * g.nodes;
  }
  const S* at(const void* p, int64_t b, int rows) const { return (const S*)p + b * rows * t.grains; }

  // The planes [from, to) of nodes: cleared where grains reach, filled, and made velocities.
  void planes(int64_t from, int64_t to) const {
    columns(from, to, [&](int64_t, int64_t, S* q, int64_t count) { std::fill(q, q + 4 * count, S(0)); });
    fill(from, to, std::make_integer_sequence<int, W / LANES<S>>());
    columns(from, to, [&](int64_t i, int64_t low, S* q, int64_t count) { velocities(i, low, q, count); });
  }

  // Every column that grains reach: its number, lowest node, where that lies, and how many nodes follow.
  template <class F> void columns(int64_t from, int64_t to, F what) const {
    const int64_t wide = D == 3 ? t.grid.shape[1] : 1, tall = t.grid.shape[D - 1];
    for (int64_t i = from; i < to; ++i) {
      const int64_t* here = &plan.at_plane[i];
      if (!(*here || (i > 0 && here[-1]) || (i > 1 && here[-2]))) continue;  // an empty box costs little
      for (int64_t j = plan.low_row; j < std::min(plan.high_row + 3, wide); ++j) {
        Reach r;
        for (int64_t a = std::max<int64_t>(i - 2, 0); a <= i; ++a)
          for (int64_t b = D == 3 ? std::max<int64_t>(j - 2, 0) : 0; b <= j; ++b) {
            const Reach& one = plan.reach[a * wide + b];
            r.low = std::min(r.low, one.low);
            r.high = std::max(r.high, one.high);
          }
        if (r.high >= 0) what(i * wide + j, r.low, nodes + 4 * ((i * wide + j) * tall + r.low), r.high - r.low + 4);
      }
    }
  }

  // One record per grain, four numbers each: momentum and mass, and how momentum grows by one cell along each axis.
  INLINE void records(int64_t p, S* record) const {
    constexpr int L = LANES<S>;
    const int64_t n = t.grains;
    const S cell = S(t.grid.cell_size), push = dt * S(4 / (t.grid.cell_size * t.grid.cell_size));
    for (int64_t q = p; q < p + W; q += L, record += W * L) {
      Pack<S, L> out[16], mass = Pack<S, L>::load(m + q), force = push * Pack<S, L>::load(V0 + q);
      Sym<S, D> stress;
#pragma GCC unroll 6
      for (int k = 0; k < STRESSES; ++k) stress.c[k] = Pack<S, L>::load(tau + k * n + q);
#pragma GCC unroll 16
      for (int k = 0; k < 16; ++k) out[k] = Pack<S, L>(S(0));
      out[3] = mass;
#pragma GCC unroll 3
      for (int i = 0; i < D; ++i) {
        out[i] = mass * Pack<S, L>::load(v + i * n + q);
#pragma GCC unroll 3
        for (int j = 0; j < D; ++j)
          out[4 + 4 * j + i] = cell * (mass * Pack<S, L>::load(C + (i * D + j) * n + q) - force * stress.at(i, j));
      }
#pragma GCC unroll 8
      for (int k = 0; k < 16; k += L) {
        transpose_block<S>(out + k);
#pragma GCC unroll 16
        for (int l = 0; l < L; ++l) out[k + l].store(record + W * l + k);
      }
    }
  }

  // What successive grains of one cell add to its window: of every row of four nodes, the lanes of one register, so that
  // all rows together fit into the machine's.
  struct Sums {
    static constexpr int L = LANES<S>;
    const Scatter& of;
    const int64_t from, to, plane;
    const int part;
    const Row<S, L> row;
    Pack<S, L> sum[ROWS];
    int32_t before = EMPTY, now = EMPTY;  // the cell of the slot before, ours or not, and the one summed for, if any
    int i0 = 0, i1 = 0;                   // which of the window's planes are ours

    Sums(const Scatter& of, int64_t from, int64_t to, int part)
        : of(of), from(from), to(to), plane(of.g.node[0]), part(part), row(part) {
      for (auto& a : sum) a = Pack<S, L>(S(0));
    }

    void flush() { flush(sum); }

    INLINE void flush(Pack<S, L>* sum) {
      if (now == EMPTY) return;
      S* q = of.nodes + 4 * int64_t(now) + part * L;
      constexpr int per = ROWS / 3;
#pragma GCC unroll 3
      for (int i = 0; i < 3; ++i)
        if (i >= i0 && i < i1)
#pragma GCC unroll 3
          for (int j = 0; j < per; ++j) {
            S* r = q + 4 * (i * plane + j * (D == 3 ? of.g.node[1] : 0));
            (Pack<S, L>::load(r) + sum[i * per + j]).store(r);
          }
#pragma GCC unroll 9
      for (int r = 0; r < ROWS; ++r) sum[r] = Pack<S, L>(S(0));
      now = EMPTY;
    }

    void skip() { flush(); before = EMPTY; }

    // Sixteen grains. Sums are cut where the cell changes, whoever works.
    void add(const int32_t* cell, const S* record, const Window<S>& win) {
      Pack<S, L> sum[ROWS];  // these stay in registers
#pragma GCC unroll 9
      for (int r = 0; r < ROWS; ++r) sum[r] = this->sum[r];
      for (int l = 0; l < W; ++l) {
        const int32_t c = cell[l];
        if (c != before) {
          flush(sum);
          before = now = c;
          if (c != EMPTY) {
            const int64_t i = c / plane;
            i0 = int(std::max<int64_t>(from - i, 0));
            i1 = int(std::min<int64_t>(to - i, 3));
            if (i0 >= i1) now = EMPTY;
          }
        }
        if (now == EMPTY) continue;
        const S* q = record + W * l;
        Pack<S, L> f(win.f[D - 1][l]), w = row.weight(f), M = repeated(q, part), X = repeated(q + 4, part);
        if constexpr (D == 2) {
          Pack<S, L> Z = repeated(q + 8, part), T = w * (M + Z * (row.node - f) - X * win.f[0][l]);
          X = w * X;
          sum[0] = sum[0] + T * win.w[0][0][l]; T = T + X;
          sum[1] = sum[1] + T * win.w[0][1][l]; T = T + X;
          sum[2] = sum[2] + T * win.w[0][2][l];
        } else {
          Pack<S, L> Y = repeated(q + 8, part), Z = repeated(q + 12, part);
          Pack<S, L> T = w * (M + Z * (row.node - f) - X * win.f[0][l] - Y * win.f[1][l]);
          X = w * X; Y = w * Y;
#pragma GCC unroll 3
          for (int j = 0; j < 3; ++j) {
            Pack<S, L> wy(win.w[1][j][l]), U = wy * T, UX = wy * X;
            sum[j] = sum[j] + U * win.w[0][0][l]; U = U + UX;
            sum[3 + j] = sum[3 + j] + U * win.w[0][1][l]; U = U + UX;
            sum[6 + j] = sum[6 + j] + U * win.w[0][2][l];
            T = T + Y;
          }
        }
      }
#pragma GCC unroll 9
      for (int r = 0; r < ROWS; ++r) this->sum[r] = sum[r];
    }
  };

  template <int... PART> void fill(int64_t from, int64_t to, std::integer_sequence<int, PART...>) const {
    Window<S> win;
    alignas(64) S record[W * W];
    Sums sums[] = {Sums(*this, from, to, PART)...};
    for (int64_t block = 0; block * BLOCK < t.grains; ++block) {
      if (plan.last[block] < from - 2 || plan.first[block] >= to) { for (auto& s : sums) s.skip(); continue; }
      for (int64_t p = block * BLOCK; p < std::min((block + 1) * BLOCK, t.grains); p += W) {
        const int32_t* cell = &plan.cell[p];
        if (std::all_of(cell, cell + W, [](int32_t c) { return c == EMPTY; })) { for (auto& s : sums) s.skip(); continue; }
        records(p, record);
        look<S, D>(x + p, t.grains, S(1 / t.grid.cell_size), g, win);
        for (auto& s : sums) s.add(cell, record, win);
      }
    }
    for (auto& s : sums) s.flush();
  }

  // Momenta become velocities: forces have acted, gravity acts, walls answer. As substep.node_velocities and walls.
  void velocities(int64_t column, int64_t low, S* q, int64_t count) const {
    const int64_t wide = D == 3 ? t.grid.shape[1] : 1;
    int64_t at[D];
    at[0] = column / wide;
    if constexpr (D == 3) at[1] = column % wide;
    for (int64_t k = 0; k < count; ++k, q += 4) {
      at[D - 1] = low + k;
      const S mass = q[3];
      const bool present = mass > S(t.least_mass);
      const S per_mass = present ? S(1) / mass : S(0);
      for (int a = 0; a < D; ++a) q[a] = present ? q[a] * per_mass + dt * gravity[a] : S(0);
      if constexpr (D == 2) q[2] = S(0);
      for (int a = 0; a < D; ++a)
        for (int side = 0; side < 2; ++side) wall(a, side, at, q);
    }
  }

  INLINE void wall(int a, int side, const int64_t* at, S* q) const {
    const int64_t kind = t.grid.wall_kind[2 * a + side], margin = t.grid.margin;
    if (kind == OPEN || !(side == 0 ? at[a] <= margin : at[a] >= t.grid.shape[a] - 1 - margin)) return;
    if (kind == SLIP) q[a] = S(0);
    else if (kind == STICK) for (int i = 0; i < D; ++i) q[i] = S(0);
    else {
      const S inward = side == 0 ? S(1) : S(-1), into = std::max(-inward * q[a], S(0));
      S speed2 = S(LEAST_SPEED2);
      for (int i = 0; i < D; ++i) if (i != a) speed2 += q[i] * q[i];
      const S keep = std::max(S(1) - S(t.grid.wall_friction[2 * a + side]) * into / root(speed2), S(0));
      for (int i = 0; i < D; ++i) q[i] = i == a ? q[i] + inward * into : q[i] * keep;
    }
  }
};

template <class S, int D> void scatter(const ToNodes& t, int64_t b, int parts) {
  static thread_local Plan plan;
  const int64_t planes = t.grid.shape[0];
  survey<S, D>(t, (const S*)t.x + b * D * t.grains, (const S*)t.m + b * t.grains, plan);
  const Scatter<S, D> s(t, plan, b);
  for (int64_t k = 0; k < t.watch; ++k) {
    int32_t i = t.watched[b * t.watch + k];
    if (i >= 0 && i < s.g.nodes) std::fill(s.nodes + 4 * i, s.nodes + 4 * i + 4, S(0));
  }
  if (parts == 1) return s.planes(0, planes);
  // Each part owns planes, with about as many grains as the others; what reaches over a border is computed by both.
  std::vector<int64_t> cut(parts + 1, planes);
  cut[0] = 0;
  int64_t total = 0, seen = 0;
  for (int64_t c : plan.at_plane) total += c;
  for (int64_t i = 0, part = 1; i < planes && part < parts; ++i) {
    seen += plan.at_plane[i];
    if (seen * parts >= total * part) cut[part++] = std::min(i + 2, planes);
  }
  each(parts, [&](int k) { if (cut[k] < cut[k + 1]) s.planes(cut[k], cut[k + 1]); });
}

}  // namespace MPM_ISA
