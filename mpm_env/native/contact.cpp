// Points against rigid geoms, for one width of registers, which MPM_ISA names. coupling/meeting.py says the same in JAX
// and stays the reference.
#include "exchange.h"
#include "geoms.h"
#include "threads.h"

namespace MPM_ISA {
namespace {

constexpr double LEAST_NORMAL = 1e-6, LEAST_FILL = 1e-6, NO_GAP = 0.25, CLOSED = 0.1;  // those of meeting.py and contact.py

// Rows (3, count) from point i on, a pack; beyond the last point, that one again.
template <class S> INLINE void load(const S* a, int64_t count, int64_t i, Rows<S>& x) {
  for (int r = 0; r < 3; ++r) {
    const S* row = a + r * count;
    if (i + W <= count) { x[r] = Pack<S>::load(row + i); continue; }
    alignas(64) S lane[W];
    for (int64_t l = 0; l < W; ++l) lane[l] = row[std::min(i + l, count - 1)];
    x[r] = Pack<S>::load(lane);
  }
}

// Walks through points (3, count) in packs: visit(first point of the pack, how many, the pack, the geoms worth a look).
// Packs that are farther than `limit(first, last)` from every geom are passed over.
template <class S, class L, class F> INLINE void walk(const std::vector<Geom<S>>& geoms, const S* x, int64_t count, L limit, F visit) {
  std::vector<const Geom<S>*> some;
  some.reserve(geoms.size());
  for (int64_t i = 0; i < count; i += BLOCK_PACKS * W) {
    Rows<S> at[BLOCK_PACKS];
    const int64_t end = std::min<int64_t>(count, i + BLOCK_PACKS * W);
    const int packs = int((end - i + W - 1) / W);
    for (int k = 0; k < packs; ++k) load<S>(x, count, i + k * W, at[k]);
    worth_a_look<S>(geoms, at, packs, limit(i, end), some);
    if (some.empty()) continue;
    for (int k = 0; k < packs; ++k) visit(i + k * W, std::min<int64_t>(W, end - i - k * W), at[k], some);
  }
}

// How deep in cells a node lies in a half space of material that gives it this share of its full mass.
template <class S> inline S depth_of(S fill) {
  const S most = std::max(std::min(fill, S(1 - LEAST_FILL)), S(LEAST_FILL));
  if (most < S(1.0 / 6)) return std::cbrt(6 * most) - S(1.5);
  if (most > S(5.0 / 6)) return S(1.5) - std::cbrt(6 * (1 - most));
  S s = S(1.4) * (most - S(0.5));
  for (int i = 0; i < 2; ++i) s -= (S(0.75) * s - s * s * s / 3 - (most - S(0.5))) / (S(0.75) - s * s);
  return s;
}

template <class S> void run(const Near& t, int64_t b) {
  const int64_t N = t.points;
  const S *x = t.x.of<S>(b), *high = t.high.of<S>(b), low = S(t.low);
  const auto geoms = placed<S>(t.geoms, b, t.pos.of<S>(b), t.mat.of<S>(b));
  int32_t *index = t.index + b * t.room, found = 0;
  walk<S>(
      geoms, x, N, [&](int64_t i, int64_t end) { return *std::max_element(high + i, high + end); },
      [&](int64_t i, int64_t count, const Rows<S>& at, const auto& some) {
        alignas(64) S most[W], phi[W];
        for (int64_t l = 0; l < W; ++l) most[l] = high[i + std::min(l, count - 1)];
        nearest<S>(some, at, Pack<S>::load(most)).phi.store(phi);
        for (int64_t l = 0; l < count; ++l)
          if (phi[l] < most[l] && phi[l] > low && found++ < t.room) index[found - 1] = int32_t(i + l);
      });
  for (int64_t k = found; k < t.room; ++k) index[k] = int32_t(N);
  t.found[b] = found;
}

template <class S> void run(const Meet& t, int64_t b) {
  typedef typename IntOf<S>::type I;
  const int64_t K = t.points, G = t.geoms.count, nv = t.nv;
  const S *at_x = t.x.of<S>(b), *v = t.v.of<S>(b), *m = t.m.of<S>(b);
  const S *centre = t.centre.of<S>(b), *J = t.J.of<S>(b), *d = t.d.of<S>(b), *M = t.M.of<S>(b);
  const S *mu = t.mu.of<S>(b), *hold_most = t.hold.of<S>(b), *shares = t.shares.of<S>(b), *q_free = t.q_free.of<S>(b);
  S *phi = (S*)t.phi + b * K, *n = (S*)t.n + b * 3 * K, *impulse = (S*)t.impulse + b * 3 * K;
  const auto geoms = placed<S>(t.geoms, b, t.pos.of<S>(b), t.mat.of<S>(b));
  std::fill_n(phi, K, S(t.reach));
  std::fill_n(n, 3 * K, S(0));
  std::fill_n(impulse, 3 * K, S(0));

  // Those with mass, and of them those near enough, with the geom that each faces.
  std::vector<int32_t> heavy, who, faces;
  for (auto* list : {&heavy, &who, &faces}) list->reserve(K);
  for (int64_t i = 0; i < K; ++i) if (m[i] > 0) heavy.push_back(int32_t(i));
  const int64_t some = int64_t(heavy.size());
  std::vector<S> x(3 * some);
  for (int r = 0; r < 3; ++r) for (int64_t a = 0; a < some; ++a) x[r * some + a] = at_x[r * K + heavy[a]];
  const Pack<S> limit = Pack<S>(S(t.reach));
  walk<S>(
      geoms, x.data(), some, [&](int64_t, int64_t) { return S(t.reach); },
      [&](int64_t a, int64_t count, const Rows<S>& at, const auto& few) {
        const Facing<S> f = nearest<S>(few, at, limit);
        if (!any(f.phi < limit)) return;
        Rows<S> normal;
        normals<S>(geoms, at, f, normal);
        if (t.plane_strain) {
          normal[1] = Pack<S>(S(0));
          Pack<S> size = largest(root(dot<S>(normal, normal)), S(LEAST_NORMAL));
          for (int r = 0; r < 3; ++r) normal[r] = normal[r] / size;
        }
        alignas(64) S way[4][W];
        alignas(64) I which[W];
        f.geom.store(which);
        f.phi.store(way[3]);
        for (int r = 0; r < 3; ++r) normal[r].store(way[r]);
        for (int64_t l = 0; l < count; ++l) {
          if (which[l] < 0) continue;
          const int32_t i = heavy[a + l];
          phi[i] = way[3][l];
          for (int r = 0; r < 3; ++r) n[r * K + i] = way[r][l];
          who.push_back(int32_t(a + l));
          faces.push_back(int32_t(which[l]));
        }
      });

  const int64_t active = int64_t(who.size());
  double energy = 0;  // twice the kinetic one
  Crowd<S> crowd(int((active + W - 1) / W), int(nv));
  for (int64_t a = 0; a < active; ++a) {
    const int64_t i = heavy[who[a]], g = faces[a], body = t.body_of[g];
    const S *c0 = centre + 3 * body, *Jb = J + 6 * nv * body, *db = d + 6 * body;
    const S r[3] = {x[who[a]] - c0[0], x[some + who[a]] - c0[1], x[2 * some + who[a]] - c0[2]};
    S* mine = crowd.at(a);  // rows are W apart
    for (int c = 0; c < 3; ++c) {
      const int p = c == 2 ? 0 : c + 1, q = c == 0 ? 2 : c - 1;
      S w = v[c * K + i] - (db[c] + (db[3 + p] * r[q] - db[3 + q] * r[p]));
      energy += double(m[i]) * v[c * K + i] * v[c * K + i];
      for (int64_t j = 0; j < nv; ++j) {
        const S lever = Jb[c * nv + j] + (Jb[(3 + p) * nv + j] * r[q] - Jb[(3 + q) * nv + j] * r[p]);
        mine[(LEVER + 3 * j + c) * W] = lever;
        w -= lever * q_free[j];
      }
      mine[(NORMAL + c) * W] = n[c * K + i];
      mine[(SPEED + c) * W] = w;
    }
    mine[MASS * W] = m[i];
    const S weight = std::max(S(1) - std::abs(phi[i] - S(t.reach - t.layer)) / S(t.layer), S(0));
    S friction = 0, hold = 0;
    for (int64_t k = 0; k < t.materials; ++k) {
      const S share = t.materials == 1 ? S(1) : shares[k * K + i];
      friction += share * mu[g * t.materials + k];
      hold += share * weight * hold_most[k];
    }
    mine[FRICTION * W] = friction;
    mine[HOLD * W] = hold;
    const S gap = t.gaps ? phi[i] - S(t.layer) * (depth_of(m[i] / t.full.of<S>(b)[i]) + S(NO_GAP)) : S(0);
    mine[SLACK * W] = std::max(gap, S(0)) * S(CLOSED / t.dt);
  }

  Constraints rows{int(nv)};
  const S* law = t.rows_law.of<S>(b);
  rows.read(int(t.rows), t.rows_J.of<S>(b), t.rows_T.of<S>(b), law);
  const Outcome done = exchange<S>(crowd, Vector(M, M + nv * nv), rows, Vector(q_free, q_free + nv), energy, int(t.iterations));
  for (int64_t j = 0; j < nv; ++j) ((S*)t.q)[b * nv + j] = S(q_free[j] + done.change[j]);
  S* given = (S*)t.given + b * t.rows;
  for (int64_t j = 0; j < t.rows; ++j)  // what rows give that push nothing is their law alone
    given[j] = std::min(std::max(law[j] * law[t.rows + j], law[2 * t.rows + j]), law[3 * t.rows + j]);
  for (int j = 0; j < rows.count; ++j) given[rows.row[j]] = S(done.given[j]);
  ((S*)t.residual)[b] = S(done.residual);
  ((S*)t.scale)[b] = S(done.scale);

  std::vector<double> wrench(6 * G, 0);
  for (int64_t a = 0; a < active; a += W) {
    Pack<S>* p = crowd.of(int(a / W));
    Rows<S> w = {p[SPEED], p[SPEED + 1], p[SPEED + 2]}, f;
    impulses<S>(p, w, f);
    alignas(64) S lane[3][W];
    for (int c = 0; c < 3; ++c) (f[c] * S(done.scale)).store(lane[c]);
    for (int64_t l = 0; l < W && a + l < active; ++l) {
      if (lane[0][l] == 0 && lane[1][l] == 0 && lane[2][l] == 0) continue;
      const int64_t i = heavy[who[a + l]], g = faces[a + l];
      const S* c0 = centre + 3 * t.body_of[g];
      const S r[3] = {x[who[a + l]] - c0[0], x[some + who[a + l]] - c0[1], x[2 * some + who[a + l]] - c0[2]};
      for (int c = 0; c < 3; ++c) {
        const int e = (c + 1) % 3, h = (c + 2) % 3;
        impulse[c * K + i] = lane[c][l];
        wrench[6 * g + c] -= lane[c][l];
        wrench[6 * g + 3 + c] -= double(r[e]) * lane[h][l] - double(r[h]) * lane[e][l];
      }
    }
  }
  for (int64_t k = 0; k < 6 * G; ++k) ((S*)t.wrench)[b * 6 * G + k] = S(wrench[k]);
}

template <class T> void pick(const T& t, bool f64) {
  each(int(t.batch), [&](int b) { f64 ? run<double>(t, b) : run<float>(t, b); });
}

}  // namespace

void near(const Near& t, bool f64) { pick(t, f64); }
void meet(const Meet& t, bool f64) { pick(t, f64); }

}  // namespace MPM_ISA
