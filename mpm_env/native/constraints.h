// Rigid constraints while grains push, in f64. coupling/constraints.py says the same in JAX, with the equations, and
// stays the reference.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

namespace MPM_ISA {

constexpr int STEPS = 4;
constexpr double STEP[STEPS] = {1, 0.5, 0.25, 0.0625}, SOLVED = 4;  // those of constraints.py, as a test sees to
constexpr int SETTLING = 12, NARROWINGS = 16;  // its ITERATIONS and HALVINGS

using Vector = std::vector<double>;

// Solves A X = B for X in place of B (n, columns), by elimination with row exchange; A is used up.
inline void solve(Vector& A, Vector& B, int n, int columns) {
  for (int k = 0; k < n; ++k) {
    int best = k;
    for (int i = k + 1; i < n; ++i) if (std::abs(A[i * n + k]) > std::abs(A[best * n + k])) best = i;
    if (best != k) {
      for (int j = 0; j < n; ++j) std::swap(A[k * n + j], A[best * n + j]);
      for (int j = 0; j < columns; ++j) std::swap(B[k * columns + j], B[best * columns + j]);
    }
    for (int i = k + 1; i < n; ++i) {
      const double share = A[i * n + k] / A[k * n + k];
      for (int j = k + 1; j < n; ++j) A[i * n + j] -= share * A[k * n + j];
      for (int j = 0; j < columns; ++j) B[i * columns + j] -= share * B[k * columns + j];
    }
  }
  for (int i = n; i-- > 0;)
    for (int j = 0; j < columns; ++j) {
      for (int k = i + 1; k < n; ++k) B[i * columns + j] -= A[i * n + k] * B[k * columns + j];
      B[i * columns + j] /= A[i * n + i];
    }
}

inline Vector inverse(Vector A, int n) {
  Vector B(n * n, 0);
  for (int i = 0; i < n; ++i) B[i * n + i] = 1;
  solve(A, B, n, n);
  return B;
}

inline Vector times(const Vector& A, const Vector& x) {
  const size_t n = x.size();
  Vector y(n, 0);
  for (size_t i = 0; i < n; ++i) for (size_t j = 0; j < n; ++j) y[i] += A[i * n + j] * x[j];
  return y;
}

// The length of a generalised impulse in a metric.
inline double length(const Vector& metric, const Vector& R) {
  const Vector half = times(metric, R);
  double square = 0;
  for (size_t a = 0; a < R.size(); ++a) square += R[a] * half[a];
  return std::sqrt(std::max(square, 0.0));
}

struct Settled { Vector change, given; double left; };

struct Constraints {
  int count = 0, nv;
  Vector J, T, D, aim, low, high, given, into;  // see Rows in constraints.py; into = J T
  std::vector<int> row;  // which of all these are

  explicit Constraints(int nv) : nv(nv) {}

  // Takes those of all rows that push along some joint: of limits and contacts that are far, MJX leaves zeros.
  template <class S> void read(int all, const S* rows_J, const S* rows_T, const S* law) {
    for (int i = 0; i < all; ++i)
      if (std::any_of(rows_J + i * nv, rows_J + (i + 1) * nv, [](S j) { return j != 0; })) row.push_back(i);
    count = int(row.size());
    if (count == 0) return;
    T.assign(rows_T, rows_T + nv * nv);
    into.assign(count * nv, 0);
    Vector* of[] = {&D, &aim, &low, &high, &given};
    for (int i : row) {
      J.insert(J.end(), rows_J + i * nv, rows_J + (i + 1) * nv);
      for (int k = 0; k < 5; ++k) of[k]->push_back(law[k * all + i]);
    }
    for (int i = 0; i < count; ++i)
      for (int a = 0; a < nv; ++a) for (int b = 0; b < nv; ++b) into[i * nv + b] += J[i * nv + a] * T[a * nv + b];
  }

  // What row i would give without its bounds, when joints move with q.
  double wish(int i, const double* q) const {
    double w = aim[i];
    for (int a = 0; a < nv; ++a) w -= into[i * nv + a] * q[a];
    return D[i] * w;
  }

  Vector pushes(const Vector& q) const {
    Vector p(count);
    for (int i = 0; i < count; ++i) p[i] = std::min(std::max(wish(i, q.data()), low[i]), high[i]);
    return p;
  }

  // Takes J^T (p - before) off R.
  void take(const Vector& p, const Vector& before, Vector& R) const {
    for (int i = 0; i < count; ++i) {
      const double f = p[i] - before[i];
      if (f != 0) for (int a = 0; a < nv; ++a) R[a] -= f * J[i * nv + a];
    }
  }

  // Adds minus the derivative of the rows' generalised impulse by q to H.
  void stiffen(const Vector& q, Vector& H) const {
    for (int i = 0; i < count; ++i) {
      const double p = wish(i, q.data());
      if (p > low[i] && p < high[i])
        for (int a = 0; a < nv; ++a) for (int b = 0; b < nv; ++b) H[a * nv + b] += D[i] * J[i * nv + a] * into[i * nv + b];
    }
  }

  // The change c of joint velocities q for which M c = load + J^T (p(q + c) - given), from a guess of it.
  // What remains is measured in the metric.
  Settled settled(const Vector& M, const Vector& metric, const Vector& q, const Vector& load, const Vector& guess,
                  double rounding) const {
    Vector H(M), c(guess), at(nv), step(nv), held(nv, 0), all(nv, 0), tried(nv);
    auto remains = [&](const Vector& c) {
      for (int a = 0; a < nv; ++a) at[a] = q[a] + c[a];
      Vector R = times(M, c);
      for (int a = 0; a < nv; ++a) R[a] -= load[a];
      take(pushes(at), given, R);
      return R;
    };
    for (int i = 0; i < count; ++i) for (int a = 0; a < nv; ++a) held[a] += std::abs(given[i] * J[i * nv + a]);
    const double enough = SOLVED * rounding * (length(metric, load) + length(metric, times(M, guess)) + length(metric, held));
    Vector R = remains(c);
    for (int it = 0; it < SETTLING && length(metric, R) > enough; ++it) {
      H = M;
      for (int a = 0; a < nv; ++a) { at[a] = q[a] + c[a]; step[a] = -R[a]; }
      stiffen(at, H);
      solve(H, step, nv, 1);
      const Vector along = times(T, step);
      auto beyond = [&](double share) {  // the minimum along the step, in tried and R
        double part = 0;
        for (int a = 0; a < nv; ++a) tried[a] = c[a] + share * step[a];
        R = remains(tried);
        for (int a = 0; a < nv; ++a) part += along[a] * R[a];
        return part > 0;
      };
      if (beyond(1)) {
        double low = 0, high = 1;
        for (int k = 0; k < NARROWINGS; ++k) { const double middle = (low + high) / 2; (beyond(middle) ? high : low) = middle; }
        beyond(high);
      }
      c = tried;
    }
    for (int a = 0; a < nv; ++a) at[a] = q[a] + c[a];
    Settled out{c, pushes(at), 0};
    take(given, out.given, all);
    const double whole = length(metric, load) + length(metric, all);
    if (whole > enough) out.left = length(metric, R) / whole;
    return out;
  }
};

}  // namespace MPM_ISA
