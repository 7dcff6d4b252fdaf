// Where grains are on the grid: windows of three nodes along each axis, quadratic B-splines (J16 eq. 123).
//
// A node is four numbers (velocity, mass), so the four nodes of a window's row along the last axis fill one pack, the
// fourth with weight zero.
#pragma once
#include <algorithm>
#include <vector>

#include "kernels.h"
#include "laws.h"
#include "threads.h"

namespace MPM_ISA {

constexpr int EMPTY = -1;   // the cell of a slot without a grain
constexpr int BLOCK = 512;  // grains handed to a thread at a time

template <class S> struct Window {  // of sixteen grains: first node, and the weights of three nodes along each axis
  alignas(64) S f[3][W];            // place in the window, in cells
  alignas(64) S w[3][3][W];         // axis, node
};

template <int D> struct Strides {
  int64_t node[D];   // nodes between neighbours along each axis
  int64_t last[D];   // the last first node of a window
  int64_t nodes;     // of the whole grid
  explicit Strides(const GridShape& g) {
    int64_t s = 1;
    for (int a = D - 1; a >= 0; --a) { node[a] = s; s *= g.shape[a]; last[a] = g.shape[a] - 3; }
    nodes = s;
    last[D - 1] -= 1;  // a row is read and written four nodes wide
  }
};

template <class S, int D> INLINE Bits<S> first_node(Pack<S> x, S per_cell, const Strides<D>& g, int a, Pack<S>& f) {
  typedef typename IntOf<S>::type I;
  Pack<S> s = x * per_cell;
  Bits<S> i = floored(s - S(0.5));
  i = smallest(largest(i, I(0)), I(g.last[a]));
  f = s - number<S>(i);
  return i;
}

// The cells of the grains at x (D rows, n apart): the first nodes of their windows, in the flattened grid.
template <class S, int D> INLINE void cells(const S* x, int64_t n, S per_cell, const Strides<D>& g, int32_t* cell) {
  typedef typename IntOf<S>::type I;
  Bits<S> at{I(0)};
  Pack<S> f;
  for (int a = 0; a < D; ++a) at = at + first_node<S, D>(Pack<S>::load(x + a * n), per_cell, g, a, f) * Bits<S>(I(g.node[a]));
  I c[W];
  at.store(c);
  for (int l = 0; l < W; ++l) cell[l] = int32_t(c[l]);
}

// Weights and places of the grains at x (D rows, n apart).
template <class S, int D> INLINE void look(const S* x, int64_t n, S per_cell, const Strides<D>& g, Window<S>& win) {
  for (int a = 0; a < D; ++a) {
    Pack<S> f;
    first_node<S, D>(Pack<S>::load(x + a * n), per_cell, g, a, f);
    f.store(win.f[a]);
    Pack<S> u = S(1.5) - f, m = f - S(1), d = f - S(0.5);
    (S(0.5) * u * u).store(win.w[a][0]);
    (S(0.75) - m * m).store(win.w[a][1]);
    (S(0.5) * d * d).store(win.w[a][2]);
  }
}

// Along the last axis: each lane's node (0 0 0 0 1 1 1 1 ..) and that node's weight for a grain at f; of a whole pack, or
// of the lanes that one of its parts has.
template <class S, int L = W> struct Row {
  Pack<S, L> node, a, b, c;
  explicit Row(int part = 0) {
    constexpr double poly[4][3] = {{1.125, -1.5, 0.5}, {-0.25, 2, -1}, {0.125, -0.5, 0.5}, {0, 0, 0}};
    S v[4][L];
    for (int l = 0; l < L; ++l) {
      const int i = (part * L + l) / 4;
      v[0][l] = S(i);
      for (int k = 0; k < 3; ++k) v[k + 1][l] = S(poly[i][k]);
    }
    node = Pack<S, L>::load(v[0]); a = Pack<S, L>::load(v[1]); b = Pack<S, L>::load(v[2]); c = Pack<S, L>::load(v[3]);
  }
  INLINE Pack<S, L> weight(Pack<S, L> f) const { return (c * f + b) * f + a; }
};

}  // namespace MPM_ISA
