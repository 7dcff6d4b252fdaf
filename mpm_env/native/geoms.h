// How far sixteen points are from geoms, and which way is out. coupling/geoms.py says the same in JAX, with sources, and
// stays the reference.
#pragma once
#include <algorithm>
#include <limits>
#include <vector>

#include "kernels.h"
#include "pack.h"

namespace MPM_ISA {

constexpr double TINY_SQUARE = 1e-30, NUDGE = 1e-9, FLAT_GRADIENT = 1e-6;  // those of geoms.py, as a test sees to
constexpr int HALVINGS = 10, NEWTON_STEPS = 4;

template <class S> using Rows = Pack<S>[3];

template <class S> INLINE Pack<S> dot(const Rows<S>& a, const Rows<S>& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
template <class S> INLINE Pack<S> largest(Pack<S> a, Pack<S> b) { return select<S>(b > a, b, a); }
template <class S> INLINE Pack<S> sign(Pack<S> a) { return select<S>(a < S(0), Pack<S>(S(-1)), Pack<S>(S(1))); }

// A geom where it is now.
template <class S> struct Geom {
  GeomKind kind;
  S size[3], at[3], axes[3][3], reach;  // axes: columns in world coordinates; reach: of a sphere about `at` that holds it
  int index;                            // among the coupled ones
  const float* value;                   // of a mesh: distances at the nodes of a grid of cubes
  int64_t nodes[3];
  S origin[3], spacing;

  Geom(const GeomTable& t, int64_t g, const float* voxels, const S* pos, const S* mat)
      : kind(GeomKind(t.kind[g])), reach(S(t.reach[g])), index(int(g)), value(voxels + t.first[g]), spacing(S(t.spacing[g])) {
    for (int i = 0; i < 3; ++i) {
      size[i] = S(t.size[3 * g + i]); at[i] = pos[3 * g + i];
      nodes[i] = t.nodes[3 * g + i]; origin[i] = S(t.origin[3 * g + i]);
      for (int j = 0; j < 3; ++j) axes[i][j] = mat[9 * g + 3 * i + j];
    }
  }

  INLINE void inward(const Rows<S>& x, Rows<S>& p) const {
    Rows<S> r = {x[0] - at[0], x[1] - at[1], x[2] - at[2]};
    for (int i = 0; i < 3; ++i) p[i] = r[0] * axes[0][i] + r[1] * axes[1][i] + r[2] * axes[2][i];
  }
  INLINE void outward(const Rows<S>& p, Rows<S>& x) const {
    for (int i = 0; i < 3; ++i) x[i] = p[0] * axes[i][0] + p[1] * axes[i][1] + p[2] * axes[i][2];
  }
};

// The geoms of one environment, at pos (count, 3) with axes mat (count, 3, 3).
template <class S> std::vector<Geom<S>> placed(const GeomTable& t, int64_t environment, const S* pos, const S* mat) {
  std::vector<Geom<S>> out;
  out.reserve(t.count);
  for (int64_t g = 0; g < t.count; ++g) out.emplace_back(t, g, t.voxels.of<float>(environment), pos, mat);
  return out;
}

// The region where q[0], .. q[N - 1] <= 0, seen from one corner: distance, and with `slope` its derivative by q.
template <class S, int N> INLINE Pack<S> corner(const Pack<S>* q, Pack<S>* slope) {
  Pack<S> nearest = q[0], square(S(0)), out[N];
  for (int i = 1; i < N; ++i) nearest = largest(nearest, q[i]);
  for (int i = 0; i < N; ++i) { out[i] = largest(q[i], Pack<S>(S(0))); square = square + out[i] * out[i]; }
  Pack<S> far = root(square);
  Bits<S> outside = square > S(TINY_SQUARE);
  if (slope) {
    Bits<S> free = ~Bits<S>(typename IntOf<S>::type(0));  // no earlier one is nearest
    for (int i = 0; i < N; ++i) {
      Bits<S> first = ~(q[i] < nearest) & free;
      free = free & ~first;
      slope[i] = select<S>(outside, out[i] / far, select<S>(first, Pack<S>(S(1)), Pack<S>(S(0))));
    }
  }
  return select<S>(outside, far, nearest);
}

// Distance from the point p of the axis, with `n` the direction; along x where there is none.
template <class S> INLINE Pack<S> length(const Rows<S>& p, Pack<S>* n) {
  Pack<S> square = dot<S>(p, p), far = root(square);
  Bits<S> some = square > S(TINY_SQUARE);
  if (n) for (int i = 0; i < 3; ++i) n[i] = select<S>(some, p[i] / far, Pack<S>(S(i == 0)));
  return select<S>(some, far, p[0]);
}

template <class S> INLINE Pack<S> ellipsoid(const Geom<S>& g, const Rows<S>& p, Pack<S>* n) {
  const S* r = g.size;
  const S least = std::min(r[0], std::min(r[1], r[2]));
  Rows<S> rp;
  S gap[3];
  for (int i = 0; i < 3; ++i) { rp[i] = r[i] * largest(magnitude(p[i]), S(NUDGE) * least); gap[i] = (r[i] - least) * (r[i] + least); }
  Pack<S> low = largest(largest(rp[0] - gap[0], rp[1] - gap[1]), rp[2] - gap[2]), high = root(dot<S>(rp, rp));
  for (int k = 0; k < HALVINGS; ++k) {
    Pack<S> middle = root(low * high), sum(S(0));
    for (int i = 0; i < 3; ++i) { Pack<S> u = rp[i] / (middle + gap[i]); sum = sum + u * u; }
    Bits<S> below = sum > S(1);
    low = select<S>(below, middle, low); high = select<S>(below, high, middle);
  }
  Pack<S> s = low;
  for (int k = 0; k < NEWTON_STEPS; ++k) {
    Pack<S> sum(S(-1)), slope(S(0));
    for (int i = 0; i < 3; ++i) { Pack<S> q = S(1) / (s + gap[i]), u = rp[i] * q; sum = sum + u * u; slope = slope + S(2) * u * u * q; }
    s = s + sum / slope;
  }
  Rows<S> u, m;
  for (int i = 0; i < 3; ++i) u[i] = sign(p[i]) * rp[i] / (s + gap[i]);
  Pack<S> unit = root(dot<S>(u, u));
  for (int i = 0; i < 3; ++i) { u[i] = u[i] / unit; m[i] = u[i] / r[i]; }
  Pack<S> steep = root(dot<S>(m, m)), phi(S(0));
  for (int i = 0; i < 3; ++i) { m[i] = m[i] / steep; phi = phi + m[i] * (p[i] - r[i] * u[i]); if (n) n[i] = m[i]; }
  return phi;
}

// Lane by lane: its eight values lie anywhere.
template <class S> inline Pack<S> mesh(const Geom<S>& g, const Rows<S>& p, Pack<S>* n) {
  alignas(64) S x[3][W], phi[W], slope[3][W];
  for (int i = 0; i < 3; ++i) p[i].store(x[i]);
  for (int l = 0; l < W; ++l) {
    S part[3], beyond[3], far = 0;
    int64_t first[3];
    for (int i = 0; i < 3; ++i) {
      const S last = S(g.nodes[i] - 1), c = (x[i][l] - g.origin[i]) / g.spacing;
      const S inside = c > 0 ? (c < last ? c : last) : S(0);
      first[i] = std::min<int64_t>(int64_t(inside), g.nodes[i] - 2);
      part[i] = inside - S(first[i]);
      beyond[i] = x[i][l] - (g.origin[i] + g.spacing * inside);
      if (inside == c) beyond[i] = 0;
      far += beyond[i] * beyond[i];
    }
    const float* v = g.value + (first[0] * g.nodes[1] + first[1]) * g.nodes[2] + first[2];
    const int64_t step[3] = {g.nodes[1] * g.nodes[2], g.nodes[2], 1};
    S at[2][2][2], value = 0, d[3] = {0, 0, 0};
    for (int a = 0; a < 2; ++a)
      for (int b = 0; b < 2; ++b)
        for (int c = 0; c < 2; ++c) {
          at[a][b][c] = S(v[a * step[0] + b * step[1] + c * step[2]]);
          const S w[3] = {a ? part[0] : 1 - part[0], b ? part[1] : 1 - part[1], c ? part[2] : 1 - part[2]};
          value += w[0] * w[1] * w[2] * at[a][b][c];
          d[0] += (a ? 1 : -1) * w[1] * w[2] * at[a][b][c];
          d[1] += (b ? 1 : -1) * w[0] * w[2] * at[a][b][c];
          d[2] += (c ? 1 : -1) * w[0] * w[1] * at[a][b][c];
        }
    const bool out = far > S(TINY_SQUARE);
    const S distance = far == far ? (out ? root(far) : S(0)) : far;  // NaN stays
    phi[l] = value + distance;
    for (int i = 0; i < 3; ++i) slope[i][l] = (beyond[i] == 0 ? d[i] / g.spacing : S(0)) + (out ? beyond[i] / distance : S(0));
  }
  if (n) for (int i = 0; i < 3; ++i) n[i] = Pack<S>::load(slope[i]);
  return Pack<S>::load(phi);
}

// Signed distance of points p of the geom's frame, and with `n` its gradient there.
template <class S> INLINE Pack<S> distance(const Geom<S>& g, const Rows<S>& p, Pack<S>* n) {
  const Pack<S> zero(S(0)), one(S(1));
  switch (g.kind) {
    case PLANE:
      if (n) { n[0] = n[1] = zero; n[2] = one; }
      return p[2];
    case SPHERE: return length<S>(p, n) - g.size[0];
    case CAPSULE: {
      Rows<S> q = {p[0], p[1], p[2] - smallest(largest(p[2], -g.size[1]), g.size[1])};
      return length<S>(q, n) - g.size[0];
    }
    case CYLINDER: {
      Rows<S> q = {p[0], p[1], zero}, side;
      Pack<S> d[2] = {length<S>(q, n ? side : nullptr) - g.size[0], magnitude(p[2]) - g.size[1]}, slope[2];
      Pack<S> phi = corner<S, 2>(d, n ? slope : nullptr);
      if (n) { n[0] = slope[0] * side[0]; n[1] = slope[0] * side[1]; n[2] = slope[1] * sign(p[2]); }
      return phi;
    }
    case BOX: {
      Pack<S> d[3];
      for (int i = 0; i < 3; ++i) d[i] = magnitude(p[i]) - g.size[i];
      Pack<S> phi = corner<S, 3>(d, n);
      if (n) for (int i = 0; i < 3; ++i) n[i] = n[i] * sign(p[i]);
      return phi;
    }
    case ELLIPSOID: return ellipsoid<S>(g, p, n);
    case MESH: return mesh<S>(g, p, n);
  }
  return zero;
}

// What sixteen points face: the nearest geom that is nearer than a limit, -1 where there is none.
template <class S> struct Facing {
  Pack<S> phi;
  Bits<S> geom;
};

template <class S> INLINE Facing<S> nearest(const std::vector<const Geom<S>*>& geoms, const Rows<S>& x, Pack<S> limit) {
  typedef typename IntOf<S>::type I;
  Facing<S> f{limit, Bits<S>(I(-1))};
  for (const Geom<S>* g : geoms) {
    Rows<S> p = {x[0] - g->at[0], x[1] - g->at[1], x[2] - g->at[2]};
    const Pack<S> close = largest(f.phi + g->reach, Pack<S>(S(0)));
    if (!any(dot<S>(p, p) < close * close)) continue;
    g->inward(x, p);
    Pack<S> phi = distance<S>(*g, p, nullptr);
    Bits<S> nearer = phi < f.phi;
    f.phi = select<S>(nearer, phi, f.phi);
    f.geom = (nearer & Bits<S>(I(g->index))) | (~nearer & f.geom);
  }
  return f;
}

// Points are looked at a block at a time: most blocks are far from most geoms.
constexpr int BLOCK_PACKS = 8;

// The geoms that may be nearer than `limit` to one of some packs of points, x[pack][row]. Those without a
// place are near nothing.
template <class S>
INLINE void worth_a_look(const std::vector<Geom<S>>& geoms, const Rows<S>* x, int packs, S limit, std::vector<const Geom<S>*>& some) {
  some.clear();
  S low[3], high[3];
  for (int r = 0; r < 3; ++r) {
    Pack<S> least(std::numeric_limits<S>::infinity()), most = -least;
    for (int k = 0; k < packs; ++k) { least = select<S>(x[k][r] < least, x[k][r], least); most = largest(most, x[k][r]); }
    alignas(64) S a[W], b[W];
    least.store(a); most.store(b);
    low[r] = a[0]; high[r] = b[0];
    for (int l = 1; l < W; ++l) { low[r] = a[l] < low[r] ? a[l] : low[r]; high[r] = b[l] > high[r] ? b[l] : high[r]; }
  }
  for (const Geom<S>& g : geoms) {
    S far = 0;
    for (int r = 0; r < 3; ++r) {
      const S beyond = std::max(std::max(low[r] - g.at[r], g.at[r] - high[r]), S(0));
      far += beyond * beyond;
    }
    const S close = limit + g.reach;
    if (!(close < 0) && !(far > close * close)) some.push_back(&g);
  }
}

// Outward unit normals, in the world, of what the points face; zero where that is nothing.
template <class S> INLINE void normals(const std::vector<Geom<S>>& geoms, const Rows<S>& x, const Facing<S>& f, Rows<S>& n) {
  typedef typename IntOf<S>::type I;
  alignas(64) I which[W];
  f.geom.store(which);
  for (int i = 0; i < 3; ++i) n[i] = Pack<S>(S(0));
  for (int l = 0; l < W; ++l) {
    const I k = which[l];
    bool done = k < 0;
    for (int before = 0; before < l; ++before) done |= which[before] == k;
    if (done) continue;
    Rows<S> p, local, world;
    geoms[k].inward(x, p);
    distance<S>(geoms[k], p, local);
    Pack<S> square = dot<S>(local, local);
    Bits<S> steep = square > S(FLAT_GRADIENT);
    Pack<S> size = root(square);
    for (int i = 0; i < 3; ++i) local[i] = select<S>(steep, local[i] / size, Pack<S>(S(i == 0)));
    geoms[k].outward(local, world);
    Bits<S> mine;
    for (int j = 0; j < Bits<S>::K; ++j) mine.p[j] = (typename Bits<S>::Part)(f.geom.p[j] == (typename Bits<S>::Part{} + k));
    for (int i = 0; i < 3; ++i) n[i] = select<S>(mine, world[i], n[i]);
  }
}

}  // namespace MPM_ISA
