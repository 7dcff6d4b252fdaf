// The sand column in hand-vectorised C++ (AVX-512, f32): near what one core can do, the yardstick for all others.
//
//   g++ -O3 -march=native -ffast-math -fno-finite-math-only -fopenmp -std=c++17 sand_column.cpp -o sand_column
//   ./sand_column --n 20 --tend 0.05 --reps 1 --stress series|eigen --threads 1
//
// Prints the JSON lines of benchmarks/job.py. A grain is its position x in cells, its strain e = b - I (six numbers, no
// SVD ever), the volume it gained, and one 64-byte record [v, 1 | Qx | Qy | Qz] that the scatter reads.
// What makes it fast: grains sorted by cell every K substeps; P2G sums a cell's grains in registers (nine vectors of
// four nodes times four channels) and writes them when the cell changes; G2P keeps the cell's nodes in registers;
// stress for sixteen grains at once; only the columns of the grid that hold grains are touched.
#include <immintrin.h>
#include <omp.h>
#include <sys/resource.h>
#include <time.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>
using namespace std;
typedef float vf __attribute__((vector_size(64)));  // sixteen grains
typedef int vi __attribute__((vector_size(64)));

static inline double now() { return chrono::duration<double>(chrono::steady_clock::now().time_since_epoch()).count(); }
static inline double thread_cpu() {
  timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}
static inline double process_cpu() {
  timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}
static inline vf S(float a) { return (vf)_mm512_set1_ps(a); }
static inline vf vmax(vf a, vf b) { return (vf)_mm512_max_ps((__m512)a, (__m512)b); }
static inline vf vmin(vf a, vf b) { return (vf)_mm512_min_ps((__m512)a, (__m512)b); }
static inline vf vrsqrt(vf a) {
  vf r = (vf)_mm512_rsqrt14_ps((__m512)a);
  return r * (S(1.5f) - S(0.5f) * a * r * r);
}
static inline vf vrcp(vf a) {
  vf r = (vf)_mm512_rcp14_ps((__m512)a);
  return r * (S(2.f) - a * r);
}
static inline vf vabs(vf a) { return (vf)_mm512_abs_ps((__m512)a); }
static inline vf sel(vi m, vf a, vf b) { return m ? a : b; }
// log1p for x>-1 (f32, ~1-2 ulp): 1+x = 2^k * (1+r), exact small-x path through k=0
static inline vf vlog1p(vf x) {
  vf y = x + 1.f;
  __m512 k = _mm512_getexp_ps(_mm512_mul_ps((__m512)y, _mm512_set1_ps(1.41421356f)));  // y in [0.707,1.414) -> k=0
  vf kk = (vf)k;
  vf sc = (vf)_mm512_scalef_ps(_mm512_set1_ps(1.f), _mm512_sub_ps(_mm512_setzero_ps(), k));
  vf r = x * sc + (sc - 1.f);  // exact-ish (1+x)*2^-k - 1, equals x when k=0
  vf s = r * vrcp(r + 2.f), s2 = s * s;
  vf p = S(2.f / 9) * s2 + 2.f / 7;
  p = p * s2 + 2.f / 5;
  p = p * s2 + 2.f / 3;
  p = p * s2;
  return s * p + 2.f * s + kk * 0.69314718056f;
}
static inline vf vexpm1(vf x) {
  vf k = (vf)_mm512_roundscale_ps((__m512)(x * 1.44269504f), _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  vf r = x - k * 0.693145751953125f;
  r = r - k * 1.42860677e-6f;
  vf p = S(1.f / 720) * r + 1.f / 120;
  p = p * r + 1.f / 24;
  p = p * r + 1.f / 6;
  p = p * r + 0.5f;
  p = p * r * r + r;  // expm1(r)
  vf sc = (vf)_mm512_scalef_ps(_mm512_set1_ps(1.f), (__m512)k);
  return p * sc + (sc - 1.f);
}
// 16x16 transpose, in place
static inline void tr16(__m512* r) {
  __m512 t[16];
  for (int i = 0; i < 8; i++) {
    t[2 * i] = _mm512_unpacklo_ps(r[2 * i], r[2 * i + 1]);
    t[2 * i + 1] = _mm512_unpackhi_ps(r[2 * i], r[2 * i + 1]);
  }
  for (int i = 0; i < 4; i++) {
    __m512d a = _mm512_castps_pd(t[4 * i]), b = _mm512_castps_pd(t[4 * i + 1]), c = _mm512_castps_pd(t[4 * i + 2]),
            d = _mm512_castps_pd(t[4 * i + 3]);
    r[4 * i] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, c));
    r[4 * i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, c));
    r[4 * i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(b, d));
    r[4 * i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(b, d));
  }
  for (int i = 0; i < 4; i++) {
    t[i] = _mm512_shuffle_f32x4(r[i], r[4 + i], 0x88);
    t[4 + i] = _mm512_shuffle_f32x4(r[i], r[4 + i], 0xdd);
    t[8 + i] = _mm512_shuffle_f32x4(r[8 + i], r[12 + i], 0x88);
    t[12 + i] = _mm512_shuffle_f32x4(r[8 + i], r[12 + i], 0xdd);
  }
  for (int i = 0; i < 4; i++) {
    r[i] = _mm512_shuffle_f32x4(t[i], t[8 + i], 0x88);
    r[8 + i] = _mm512_shuffle_f32x4(t[i], t[8 + i], 0xdd);
    r[4 + i] = _mm512_shuffle_f32x4(t[4 + i], t[12 + i], 0x88);
    r[12 + i] = _mm512_shuffle_f32x4(t[4 + i], t[12 + i], 0xdd);
  }
}
template <class T>
T* alloc(size_t n) {
  void* p = aligned_alloc(64, ((n * sizeof(T) + 63) / 64) * 64 + 4096);
  memset(p, 0, ((n * sizeof(T) + 63) / 64) * 64 + 4096);
  return (T*)p;
}

struct Sym {
  vf xx, yy, zz, xy, xz, yz;
};
static inline Sym mul(const Sym& a, const Sym& b) {  // product of commuting symmetric matrices (symmetric)
  return {a.xx * b.xx + a.xy * b.xy + a.xz * b.xz, a.xy * b.xy + a.yy * b.yy + a.yz * b.yz,
          a.xz * b.xz + a.yz * b.yz + a.zz * b.zz, a.xx * b.xy + a.xy * b.yy + a.xz * b.yz,
          a.xx * b.xz + a.xy * b.yz + a.xz * b.zz, a.xy * b.xz + a.yy * b.yz + a.yz * b.zz};
}
struct Par {
  float lam, mu, alpha, k3;
};
// cyclic Jacobi
static inline void jrot(vf& app, vf& aqq, vf& apq, vf& apr, vf& aqr, vf* vp, vf* vq) {
  vf d = aqq - app;
  vf h2 = d * d + 4.f * apq * apq + 1e-36f;
  vf h = h2 * vrsqrt(h2);
  vf sg = (vf)_mm512_or_ps(_mm512_and_ps((__m512)d, _mm512_set1_ps(-0.f)), (__m512)h);
  vf t = 2.f * apq * vrcp(d + sg);
  vf c = vrsqrt(1.f + t * t), s = t * c;
  app = app - t * apq;
  aqq = aqq + t * apq;
  apq = S(0.f);
  vf x = apr;
  apr = c * x - s * aqr;
  aqr = s * x + c * aqr;
  for (int i = 0; i < 3; i++) {
    vf y = vp[i];
    vp[i] = c * y - s * vq[i];
    vq[i] = s * y + c * vq[i];
  }
}
// in: e trial, vc ; out: e new, Hencky-stress tau (Kirchhoff), vc
static inline void plast_eig(Sym& e, vf& vc, Sym& tau, const Par& P) {
  vf V[3][3];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) V[i][j] = S(i == j ? 1.f : 0.f);  // V[k]= k-th eigenvector
  Sym a = e;
  for (int sw = 0; sw < 3; sw++) {
    jrot(a.xx, a.yy, a.xy, a.xz, a.yz, V[0], V[1]);
    jrot(a.xx, a.zz, a.xz, a.xy, a.yz, V[0], V[2]);
    jrot(a.yy, a.zz, a.yz, a.xy, a.xz, V[1], V[2]);
  }
  vf h[3];
  h[0] = 0.5f * vlog1p(vmax(a.xx, S(-0.9999f)));
  h[1] = 0.5f * vlog1p(vmax(a.yy, S(-0.9999f)));
  h[2] = 0.5f * vlog1p(vmax(a.zz, S(-0.9999f)));
  vf tr = h[0] + h[1] + h[2] + vc;
  vf m = tr * (1.f / 3);
  vf d0 = h[0] - m, d1 = h[1] - m, d2 = h[2] - m;
  vf n2 = d0 * d0 + d1 * d1 + d2 * d2 + 1e-30f;
  vf rn = vrsqrt(n2), nn = n2 * rn;
  vf dg = vmax(nn + P.k3 * tr, S(0.f)) * rn;
  vi ex = tr >= 0.f;
  vc = sel(ex, tr, S(0.f));
  h[0] = sel(ex, S(0.f), h[0] - dg * d0);
  h[1] = sel(ex, S(0.f), h[1] - dg * d1);
  h[2] = sel(ex, S(0.f), h[2] - dg * d2);
  vf t3 = h[0] + h[1] + h[2];
  vf t[3], g[3];
  for (int i = 0; i < 3; i++) {
    t[i] = 2.f * P.mu * h[i] + P.lam * t3;
    g[i] = vexpm1(2.f * h[i]);
  }
  auto rec = [&](vf* g) -> Sym {
    Sym o;
    vf w0[3], w1[3], w2[3];
    for (int i = 0; i < 3; i++) {
      w0[i] = g[0] * V[0][i];
      w1[i] = g[1] * V[1][i];
      w2[i] = g[2] * V[2][i];
    }
    o.xx = w0[0] * V[0][0] + w1[0] * V[1][0] + w2[0] * V[2][0];
    o.yy = w0[1] * V[0][1] + w1[1] * V[1][1] + w2[1] * V[2][1];
    o.zz = w0[2] * V[0][2] + w1[2] * V[1][2] + w2[2] * V[2][2];
    o.xy = w0[0] * V[0][1] + w1[0] * V[1][1] + w2[0] * V[2][1];
    o.xz = w0[0] * V[0][2] + w1[0] * V[1][2] + w2[0] * V[2][2];
    o.yz = w0[1] * V[0][2] + w1[1] * V[1][2] + w2[1] * V[2][2];
    return o;
  };
  e = rec(g);
  tau = rec(t);
}
static inline bool plast_series(Sym& e, vf& vc, Sym& tau, const Par& P) {
  vf mx = vmax(vmax(vmax(vabs(e.xx), vabs(e.yy)), vabs(e.zz)), vmax(vmax(vabs(e.xy), vabs(e.xz)), vabs(e.yz)));
  if (_mm512_cmp_ps_mask((__m512)mx, _mm512_set1_ps(0.03f), _CMP_NLT_UQ)) return false;
  Sym e2 = mul(e, e);
  Sym t;
#define EACH(M) M(xx) M(yy) M(zz) M(xy) M(xz) M(yz)
#define Q(c) t.c = e.c * (1.f / 3) - 0.25f * e2.c;
  EACH(Q)
#undef Q
  Sym u = mul(e2, t);
  Sym h;
#define Q(c) h.c = 0.5f * (e.c - 0.5f * e2.c + u.c);
  EACH(Q)
#undef Q
  vf tr = h.xx + h.yy + h.zz + vc, m = tr * (1.f / 3);
  vf d0 = h.xx - m, d1 = h.yy - m, d2 = h.zz - m;
  vf n2 = d0 * d0 + d1 * d1 + d2 * d2 + 2.f * (h.xy * h.xy + h.xz * h.xz + h.yz * h.yz) + 1e-30f;
  vf rn = vrsqrt(n2), nn = n2 * rn;
  vf dg = vmax(nn + P.k3 * tr, S(0.f)) * rn;
  vi ex = tr >= 0.f;
  vc = sel(ex, tr, S(0.f));
  vf k = sel(ex, S(0.f), S(1.f)), o = k * (1.f - dg);
  h.xx = k * (h.xx - dg * d0);
  h.yy = k * (h.yy - dg * d1);
  h.zz = k * (h.zz - dg * d2);
  h.xy *= o;
  h.xz *= o;
  h.yz *= o;
  vf l3 = P.lam * (h.xx + h.yy + h.zz);
  tau = {2.f * P.mu * h.xx + l3, 2.f * P.mu * h.yy + l3, 2.f * P.mu * h.zz + l3,
         2.f * P.mu * h.xy,      2.f * P.mu * h.xz,      2.f * P.mu * h.yz};
  Sym h2 = mul(h, h);
#define Q(c) t.c = (4.f / 3) * h.c + (2.f / 3) * h2.c;
  EACH(Q)
#undef Q
  u = mul(h2, t);
#define Q(c) e.c = 2.f * h.c + 2.f * h2.c + u.c;
  EACH(Q)
#undef Q
  return true;
}

int NX, NY, NZ;
const int FLOOR = 3;  // the node layer of the floor
struct Col {
  int col;
  short lo, hi;
};

struct Sim {
  int np = 0, npad = 0, T = 1;  // grains; padded to whole vectors; threads
  bool series = false;
  float dx, dt, E = 1e6f, nu = 0.3f, rho = 1500, phi = 35, g = 9.81f, fmu = 0.5f;
  Par P;
  float sig;                      // dt 4 / (rho dx): what a unit of stress adds to a grain's Q
  float *x[3], *b[6], *vc, *rec;  // positions in cells, strain, gained volume, records
  int* cell;
  float *x2[3], *b2[6], *vc2, *rec2;  // where the sort writes to
  vector<float*> gt;                  // momentum and mass on the nodes, per thread
  float* gv;                          // node velocities
  vector<int> hist, r0, r1;           // of the sort; first and last grain of each thread
  vector<Col> cols;                   // columns of the grid that hold grains, and the threads that write to each
  vector<unsigned char> cmask, tm;
  vector<short> zlo, zhi;
  double tP = 0, tG = 0, tQ = 0, tS = 0;  // s in P2G, grid, G2P with stress, sort
  long nfall = 0;                         // vectors whose strain is too large for the series

  void allocate(int n) {
    const float side = 0.2f, width = 0.8f, height = 0.3f;  // m
    dx = side / n;
    dt = 0.01f * dx;
    NX = NY = int(lround(width / dx)) + 8;
    NZ = ((int)lround(height / dx) + FLOOR + 8 + 3) / 4 * 4;
    sig = 4 * dt / (rho * dx);
    float lam = E * nu / ((1 + nu) * (1 - 2 * nu)), mu = E / (2 * (1 + nu));
    float sp = sinf(phi * M_PI / 180);
    P.lam = lam;
    P.mu = mu;
    P.alpha = sqrtf(2.f / 3) * 2 * sp / (3 - sp);
    P.k3 = (3 * lam + 2 * mu) / (2 * mu) * P.alpha;
    np = 8 * n * n * n;
    npad = (np + 15) / 16 * 16;
    size_t M = npad + 64;
    for (auto& p : x) p = alloc<float>(M);
    for (auto& p : b) p = alloc<float>(M);
    vc = alloc<float>(M);
    rec = alloc<float>(M * 16);
    cell = alloc<int>(M);
    for (auto& p : x2) p = alloc<float>(M);
    for (auto& p : b2) p = alloc<float>(M);
    vc2 = alloc<float>(M);
    rec2 = alloc<float>(M * 16);
    gt.resize(T);
    for (auto& p : gt) p = alloc<float>((size_t)NX * NY * NZ * 4);
    gv = alloc<float>((size_t)NX * NY * NZ * 4);
    hist.resize((size_t)NX * NY * NZ + 1);
  }

  // Everything as at t = 0: the cube on its lattice, at rest and without strain.
  void place(int n) {
    memset(rec, 0, sizeof(float) * 16 * npad);
    memset(vc, 0, sizeof(float) * npad);
    for (auto& p : b) memset(p, 0, sizeof(float) * npad);
    for (auto p : gt) memset(p, 0, sizeof(float) * 4 * (size_t)NX * NY * NZ);
    tP = tG = tQ = tS = nfall = 0;
    int k = 0;
    float ox = (NX - n) / 2, oy = (NY - n) / 2;
    for (int i = 0; i < 2 * n; i++)
      for (int j = 0; j < 2 * n; j++)
        for (int l = 0; l < 2 * n; l++) {
          x[0][k] = ox + (i + .5f) * .5f;
          x[1][k] = oy + (j + .5f) * .5f;
          x[2][k] = FLOOR + (l + .5f) * .5f;
          rec[16 * k + 3] = 1.f;
          k++;
        }
    for (; k < npad; k++) {
      x[0][k] = 2.5f;
      x[1][k] = 2.5f;
      x[2][k] = 2.5f;
    }  // padding particles have mass 0
    for (int i = 0; i < npad; i++) rec[16 * i + 3] = i < np ? 1.f : 0.f;
  }
  int cellof(int i) {
    int a = (int)floorf(x[0][i] - .5f), bq = (int)floorf(x[1][i] - .5f), c = (int)floorf(x[2][i] - .5f);
    if (a < 1 || bq < 1 || c < 1 || a > NX - 5 || bq > NY - 5 || c > NZ - 6) {
      fprintf(stderr, "escape %d %g %g %g\n", i, x[0][i], x[1][i], x[2][i]);
      exit(3);
    }
    return (a * NY + bq) * NZ + c;
  }
  void sort() {
    fill(hist.begin(), hist.end(), 0);
    for (int i = 0; i < np; i++) {
      cell[i] = cellof(i);
      hist[cell[i] + 1]++;
    }
    for (size_t i = 1; i < hist.size(); i++) hist[i] += hist[i - 1];
    for (int i = 0; i < np; i++) {
      int o = hist[cell[i]]++;
      for (int d = 0; d < 3; d++) x2[d][o] = x[d][i];
      for (int d = 0; d < 6; d++) b2[d][o] = b[d][i];
      vc2[o] = vc[i];
      memcpy(rec2 + 16 * o, rec + 16 * i, 64);
    }
    for (int i = np; i < npad; i++) {
      for (int d = 0; d < 3; d++) x2[d][i] = x[d][i];
      for (int d = 0; d < 6; d++) b2[d][i] = 0;
      vc2[i] = 0;
      memset(rec2 + 16 * i, 0, 64);
    }
    for (int d = 0; d < 3; d++) swap(x[d], x2[d]);
    for (int d = 0; d < 6; d++) swap(b[d], b2[d]);
    swap(vc, vc2);
    swap(rec, rec2);
    for (int i = 0; i < npad; i++) {
      cell[i] = i < np ? cellof(i) : (2 * NY + 2) * NZ + 2;
    }
    // thread ranges & active columns (stencil + 1 cell drift)
    r0.assign(T, 0);
    r1.assign(T, 0);
    int ch = npad / 16;
    for (int t = 0; t < T; t++) {
      r0[t] = (long)ch * t / T * 16;
      r1[t] = (long)ch * (t + 1) / T * 16;
    }
    size_t NC = (size_t)NX * NY;
    zlo.assign(NC, 30000);
    zhi.assign(NC, -1);
    tm.assign(NC, 0);
    vector<short> lo(NC), hi(NC);
    for (int t = 0; t < T; t++) {
      int last = -1;
      for (int i = r0[t]; i < r1[t]; i++) {
        if (cell[i] == last) continue;
        last = cell[i];
        int c = last % NZ, xy = last / NZ;
        int X = xy / NY, Y = xy % NY;
        int a = max(0, c - 1), bb = min(NZ - 1, c + 4);
        for (int p = max(0, X - 1); p <= min(NX - 1, X + 3); p++)
          for (int q = max(0, Y - 1); q <= min(NY - 1, Y + 3); q++) {
            int k = p * NY + q;
            if (a < zlo[k]) zlo[k] = a;
            if (bb > zhi[k]) zhi[k] = bb;
            tm[k] |= 1 << t;
          }
      }
    }
    cols.clear();
    cmask.clear();
    for (size_t k = 0; k < NC; k++)
      if (zhi[k] >= 0) {
        cols.push_back({(int)k, zlo[k], zhi[k]});
        cmask.push_back(tm[k]);
      }
  }
  void p2g(int t) {
    float* G = gt[t];
    const int sx = NY * NZ * 4, sy = NZ * 4;
    const __m512 kz = _mm512_setr_ps(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
    const __m512 A = _mm512_setr_ps(1.125f, 1.125f, 1.125f, 1.125f, -.25f, -.25f, -.25f, -.25f, .125f, .125f, .125f,
                                    .125f, 0, 0, 0, 0);
    const __m512 B = _mm512_setr_ps(-1.5f, -1.5f, -1.5f, -1.5f, 2, 2, 2, 2, -.5f, -.5f, -.5f, -.5f, 0, 0, 0, 0);
    const __m512 C = _mm512_setr_ps(.5f, .5f, .5f, .5f, -1, -1, -1, -1, .5f, .5f, .5f, .5f, 0, 0, 0, 0);
    __m512 acc[9];
    for (auto& a : acc) a = _mm512_setzero_ps();
    int cur = cell[r0[t]];
    auto flush = [&]() {
      float* p = G + (size_t)cur * 4;
#pragma GCC unroll 9
      for (int i = 0; i < 9; i++) {
        float* q = p + (i / 3) * sx + (i % 3) * sy;
        _mm512_storeu_ps(q, _mm512_add_ps(_mm512_loadu_ps(q), acc[i]));
        acc[i] = _mm512_setzero_ps();
      }
    };
    for (int p = r0[t]; p < r1[t]; p++) {
      int c = cell[p];
      if (c != cur) {
        flush();
        cur = c;
      }
      float X = x[0][p], Y = x[1][p], Z = x[2][p];
      float fx = X - floorf(X - .5f), fy = Y - floorf(Y - .5f), fz = Z - floorf(Z - .5f);
      const float* r = rec + 16 * (size_t)p;
      __m512 M = _mm512_broadcast_f32x4(_mm_load_ps(r)), QX = _mm512_broadcast_f32x4(_mm_load_ps(r + 4)),
             QY = _mm512_broadcast_f32x4(_mm_load_ps(r + 8)), QZ = _mm512_broadcast_f32x4(_mm_load_ps(r + 12));
      __m512 f = _mm512_set1_ps(fz);
      __m512 wz = _mm512_fmadd_ps(_mm512_fmadd_ps(C, f, B), f, A);
      __m512 Tv = _mm512_fmadd_ps(QZ, _mm512_sub_ps(kz, f), M);
      Tv = _mm512_fnmadd_ps(QX, _mm512_set1_ps(fx), Tv);
      Tv = _mm512_fnmadd_ps(QY, _mm512_set1_ps(fy), Tv);
      Tv = _mm512_mul_ps(Tv, wz);
      QX = _mm512_mul_ps(QX, wz);
      QY = _mm512_mul_ps(QY, wz);
      float a = 1.5f - fx, b_ = fx - 1.f, c_ = fx - .5f;
      __m512 wx[3] = {_mm512_set1_ps(.5f * a * a), _mm512_set1_ps(.75f - b_ * b_), _mm512_set1_ps(.5f * c_ * c_)};
      a = 1.5f - fy;
      b_ = fy - 1.f;
      c_ = fy - .5f;
      float wyv[3] = {.5f * a * a, .75f - b_ * b_, .5f * c_ * c_};
#pragma GCC unroll 3
      for (int j = 0; j < 3; j++) {
        __m512 wy = _mm512_set1_ps(wyv[j]);
        __m512 U = _mm512_mul_ps(wy, Tv), UX = _mm512_mul_ps(wy, QX);
        acc[j] = _mm512_fmadd_ps(wx[0], U, acc[j]);
        U = _mm512_add_ps(U, UX);
        acc[3 + j] = _mm512_fmadd_ps(wx[1], U, acc[3 + j]);
        U = _mm512_add_ps(U, UX);
        acc[6 + j] = _mm512_fmadd_ps(wx[2], U, acc[6 + j]);
        Tv = _mm512_add_ps(Tv, QY);
      }
    }
    flush();
  }
  void grid(int t) {
    int nc = cols.size();
    int c0 = (long)nc * t / T, c1 = (long)nc * (t + 1) / T;
    const __m128 z = _mm_setzero_ps();
    const float gd = g * dt;
    for (int ci = c0; ci < c1; ci++) {
      size_t o = ((size_t)cols[ci].col * NZ) * 4;
      unsigned m = cmask[ci];
      int lo = cols[ci].lo, hi = cols[ci].hi;
      for (int k = lo; k <= hi; k++) {
        __m128 s = z;
        for (int q = 0; q < T; q++)
          if (m >> q & 1) {
            float* p = gt[q] + o + 4 * k;
            s = _mm_add_ps(s, _mm_load_ps(p));
            _mm_store_ps(p, z);
          }
        float mass = _mm_cvtss_f32(_mm_shuffle_ps(s, s, 0xff));
        if (mass <= 1e-12f) {
          _mm_store_ps(gv + o + 4 * k, z);
          continue;
        }
        float im = 1.f / mass;
        alignas(16) float v[4];
        _mm_store_ps(v, _mm_mul_ps(s, _mm_set1_ps(im)));
        v[2] -= gd;
        v[3] = 0;
        if (k <= FLOOR && v[2] < 0) {
          float vt = sqrtf(v[0] * v[0] + v[1] * v[1]) + 1e-20f;
          float sc = max(0.f, 1.f + fmu * v[2] / vt);
          v[0] *= sc;
          v[1] *= sc;
          v[2] = 0;
        }
        _mm_store_ps(gv + o + 4 * k, _mm_load_ps(v));
      }
    }
  }
  template <bool SER>
  void g2p_(int t) {
    const int sx = NY * NZ * 4, sy = NZ * 4;
    long fb = 0;
    const __m512 kz = _mm512_setr_ps(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
    const __m512 A = _mm512_setr_ps(1.125f, 1.125f, 1.125f, 1.125f, -.25f, -.25f, -.25f, -.25f, .125f, .125f, .125f,
                                    .125f, 0, 0, 0, 0);
    const __m512 B = _mm512_setr_ps(-1.5f, -1.5f, -1.5f, -1.5f, 2, 2, 2, 2, -.5f, -.5f, -.5f, -.5f, 0, 0, 0, 0);
    const __m512 C = _mm512_setr_ps(.5f, .5f, .5f, .5f, -1, -1, -1, -1, .5f, .5f, .5f, .5f, 0, 0, 0, 0);
    int cur = -1;
    __m512 g9[9];
    for (auto& a : g9) a = _mm512_setzero_ps();
    alignas(64) float buf[256];
    const float cD = 4.f * dt / dx;  // dt*C = cD * sum w v dpos(grid)
    for (int p0 = r0[t]; p0 < r1[t]; p0 += 16) {
      for (int l = 0; l < 16; l++) {
        int p = p0 + l;
        int c = cell[p];
        if (c != cur) {
          cur = c;
          const float* q = gv + (size_t)c * 4;
#pragma GCC unroll 9
          for (int i = 0; i < 9; i++) g9[i] = _mm512_loadu_ps(q + (i / 3) * sx + (i % 3) * sy);
        }
        float X = x[0][p], Y = x[1][p], Z = x[2][p];
        float fx = X - floorf(X - .5f), fy = Y - floorf(Y - .5f), fz = Z - floorf(Z - .5f);
        __m512 f = _mm512_set1_ps(fz);
        __m512 wz = _mm512_fmadd_ps(_mm512_fmadd_ps(C, f, B), f, A);
        float a = 1.5f - fx, b_ = fx - 1.f, c_ = fx - .5f;
        __m512 wx0 = _mm512_set1_ps(.5f * a * a), wx1 = _mm512_set1_ps(.75f - b_ * b_),
               wx2 = _mm512_set1_ps(.5f * c_ * c_);
        a = 1.5f - fy;
        b_ = fy - 1.f;
        c_ = fy - .5f;
        __m512 wy0 = _mm512_set1_ps(.5f * a * a), wy1 = _mm512_set1_ps(.75f - b_ * b_),
               wy2 = _mm512_set1_ps(.5f * c_ * c_);
#define ROW(i, R, RY)                                 \
  __m512 RY = _mm512_mul_ps(wy2, g9[3 * i + 2]);      \
  __m512 R = _mm512_fmadd_ps(wy1, g9[3 * i + 1], RY); \
  RY = _mm512_add_ps(RY, R);                          \
  R = _mm512_fmadd_ps(wy0, g9[3 * i], R);
        ROW(0, R0, Y0) ROW(1, R1, Y1) ROW(2, R2, Y2) __m512 SX = _mm512_mul_ps(wx2, R2);
        __m512 S0 = _mm512_fmadd_ps(wx1, R1, SX);
        SX = _mm512_add_ps(SX, S0);
        S0 = _mm512_fmadd_ps(wx0, R0, S0);
        __m512 SY = _mm512_fmadd_ps(wx2, Y2, _mm512_fmadd_ps(wx1, Y1, _mm512_mul_ps(wx0, Y0)));
        S0 = _mm512_mul_ps(S0, wz);
        SX = _mm512_mul_ps(SX, wz);
        SY = _mm512_mul_ps(SY, wz);
        __m512 SZ = _mm512_mul_ps(S0, kz);
        __m512 u = _mm512_add_ps(_mm512_shuffle_f32x4(S0, SX, 0x44), _mm512_shuffle_f32x4(S0, SX, 0xee));
        __m512 w = _mm512_add_ps(_mm512_shuffle_f32x4(SY, SZ, 0x44), _mm512_shuffle_f32x4(SY, SZ, 0xee));
        _mm512_store_ps(buf + 16 * l,
                        _mm512_add_ps(_mm512_shuffle_f32x4(u, w, 0x88), _mm512_shuffle_f32x4(u, w, 0xdd)));
      }
      __m512 m[16];
      for (int i = 0; i < 16; i++) m[i] = _mm512_load_ps(buf + 16 * i);
      tr16(m);
      vf X = (vf)_mm512_load_ps(x[0] + p0), Y = (vf)_mm512_load_ps(x[1] + p0), Z = (vf)_mm512_load_ps(x[2] + p0);
      auto fr = [](vf a) {
        return (vf)_mm512_sub_ps((__m512)a,
                                 _mm512_roundscale_ps((__m512)(a - .5f), _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC));
      };
      vf fx = fr(X), fy = fr(Y), fz = fr(Z);
      vf v[3];
      vf D[3][3];
      for (int i = 0; i < 3; i++) {
        v[i] = (vf)m[i];
        D[i][0] = cD * ((vf)m[4 + i] - fx * v[i]);
        D[i][1] = cD * ((vf)m[8 + i] - fy * v[i]);
        D[i][2] = cD * ((vf)m[12 + i] - fz * v[i]);
      }
      // e_tr = M + D^T + M D^T, M = D + e + D e
      Sym e = {(vf)_mm512_load_ps(b[0] + p0), (vf)_mm512_load_ps(b[1] + p0), (vf)_mm512_load_ps(b[2] + p0),
               (vf)_mm512_load_ps(b[3] + p0), (vf)_mm512_load_ps(b[4] + p0), (vf)_mm512_load_ps(b[5] + p0)};
      vf ee[3][3] = {{e.xx, e.xy, e.xz}, {e.xy, e.yy, e.yz}, {e.xz, e.yz, e.zz}}, Mm[3][3];
      for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
          Mm[i][j] = D[i][j] + ee[i][j] + D[i][0] * ee[0][j] + D[i][1] * ee[1][j] + D[i][2] * ee[2][j];
      auto et = [&](int i, int j) {
        return Mm[i][j] + D[j][i] + Mm[i][0] * D[j][0] + Mm[i][1] * D[j][1] + Mm[i][2] * D[j][2];
      };
      e = {et(0, 0), et(1, 1), et(2, 2), et(0, 1), et(0, 2), et(1, 2)};
      vf VC = (vf)_mm512_load_ps(vc + p0);
      Sym tau;

      if (SER) {
        if (!plast_series(e, VC, tau, P)) {
          fb++;
          plast_eig(e, VC, tau, P);
        }
      } else
        plast_eig(e, VC, tau, P);
      _mm512_store_ps(b[0] + p0, (__m512)e.xx);
      _mm512_store_ps(b[1] + p0, (__m512)e.yy);
      _mm512_store_ps(b[2] + p0, (__m512)e.zz);
      _mm512_store_ps(b[3] + p0, (__m512)e.xy);
      _mm512_store_ps(b[4] + p0, (__m512)e.xz);
      _mm512_store_ps(b[5] + p0, (__m512)e.yz);
      _mm512_store_ps(vc + p0, (__m512)VC);
      float ad = dt / dx;
      X += ad * v[0];
      Y += ad * v[1];
      Z += ad * v[2];
      _mm512_store_ps(x[0] + p0, (__m512)X);
      _mm512_store_ps(x[1] + p0, (__m512)Y);
      _mm512_store_ps(x[2] + p0, (__m512)Z);
      {
        auto fl = [](vf a) {
          return _mm512_cvtps_epi32(_mm512_roundscale_ps((__m512)(a - .5f), _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC));
        };
        __m512i c = _mm512_add_epi32(
            _mm512_mullo_epi32(_mm512_add_epi32(_mm512_mullo_epi32(fl(X), _mm512_set1_epi32(NY)), fl(Y)),
                               _mm512_set1_epi32(NZ)),
            fl(Z));
        _mm512_store_si512(cell + p0, c);
      }
      // record: Q = dx*C - sig*tau ; dx*C = D*dx/dt
      float k = dx / dt;
      vf tt[3][3] = {{tau.xx, tau.xy, tau.xz}, {tau.xy, tau.yy, tau.yz}, {tau.xz, tau.yz, tau.zz}};
      for (int i = 0; i < 3; i++) {
        m[i] = (__m512)v[i];
        for (int j = 0; j < 3; j++) m[4 + 4 * j + i] = (__m512)(k * D[i][j] - sig * tt[i][j]);
      }
      m[3] = _mm512_set1_ps(1.f);
      m[7] = m[11] = m[15] = _mm512_setzero_ps();
      if (p0 + 16 > np) {
        alignas(64) float one[16];
        for (int l = 0; l < 16; l++) one[l] = p0 + l < np ? 1.f : 0.f;
        m[3] = _mm512_load_ps(one);
      }
      tr16(m);
      for (int i = 0; i < 16; i++) _mm512_store_ps(rec + 16 * (size_t)(p0 + i), m[i]);
    }
    if (fb) {
#pragma omp atomic
      nfall += fb;
    }
  }
  void steps(int ns, int K) {
    auto tk = [&] { return T == 1 ? thread_cpu() : now(); };  // phase clock: thread CPU time when single-threaded
    double a[4] = {0, 0, 0, 0};
#pragma omp parallel num_threads(T)
    {
      int t = omp_get_thread_num();
      double q0, q1;
      for (int s = 0; s < ns; s++) {
        if (s % K == 0) {
#pragma omp master
          {
            q0 = tk();
            sort();
            a[3] += tk() - q0;
          }
#pragma omp barrier
        }
        q0 = tk();
        p2g(t);
#pragma omp barrier
        q1 = tk();
        if (t == 0) a[0] += q1 - q0;
        grid(t);
#pragma omp barrier
        q0 = tk();
        if (t == 0) a[1] += q0 - q1;
        if (series)
          g2p_<true>(t);
        else
          g2p_<false>(t);
#pragma omp barrier
        q1 = tk();
        if (t == 0) a[2] += q1 - q0;
      }
    }
    tP += a[0];
    tG += a[1];
    tQ += a[2];
    tS += a[3];
  }
  // Whether it is the same job: 99th percentiles of radius and height, mean height (m), and speed (m/s).
  string heap() {
    vector<float> r(np), z(np);
    double square = 0, height = 0;
    for (int i = 0; i < np; i++) {
      float X = (x[0][i] - NX / 2.f) * dx, Y = (x[1][i] - NY / 2.f) * dx, *v = rec + 16 * i;
      r[i] = sqrtf(X * X + Y * Y);
      z[i] = (x[2][i] - FLOOR) * dx;
      square += v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
      height += z[i];
    }
    std::sort(r.begin(), r.end());
    std::sort(z.begin(), z.end());
    char line[200];
    snprintf(line, sizeof line, "\"r99\": %.4f, \"z99\": %.4f, \"zcom\": %.5f, \"vrms\": %.5f", r[(int)(.99 * np)],
             z[(int)(.99 * np)], height / np, sqrt(square / np));
    return line;
  }
};

int main(int c, char** v) {
  double started = now();
  int n = 20, threads = 1, sort_every = 20, reps = 1;
  double tend = 0.05;
  string stress = "series";
  for (int i = 1; i < c - 1; i += 2) {
    string k = v[i];
    if (k == "--n") n = atoi(v[i + 1]);
    if (k == "--tend") tend = atof(v[i + 1]);
    if (k == "--reps") reps = atoi(v[i + 1]);
    if (k == "--stress") stress = v[i + 1];
    if (k == "--threads") threads = atoi(v[i + 1]);
    if (k == "--sort-every") sort_every = atoi(v[i + 1]);
  }
  Sim s;
  s.T = threads;
  s.series = stress == "series";
  s.allocate(n);
  s.place(n);
  s.steps(1, sort_every);
  double first = now() - started, first_cpu = process_cpu();
  int substeps = (int)lround(tend / s.dt);
  for (int rep = 0; rep < reps; rep++) {
    s.place(n);
    double w0 = now(), c0 = process_cpu();
    s.steps(substeps, sort_every);
    double wall = now() - w0, cpu = process_cpu() - c0, t = substeps * s.dt, done = (double)s.np * substeps;
    struct rusage use;
    getrusage(RUSAGE_SELF, &use);
    printf(
        "{\"code\": \"c++ %s\", \"n\": %d, \"grains\": %d, \"dt\": %.9f, \"substeps\": %d, \"t_sim\": %.6f, "
        "\"wall\": %.4f, \"cpu\": %.4f, \"Mpss_cpu\": %.4f, \"Mpss\": %.4f, \"cpu_per_sim_s\": %.3f, "
        "\"t_first\": %.3f, \"t_first_cpu\": %.3f, \"rss_mb\": %.1f, \"ns_per_grain\": {\"p2g\": %.2f, "
        "\"grid\": %.2f, \"g2p and stress\": %.2f, \"sort\": %.2f}, \"eigen_share\": %.4f, %s}\n",
        stress.c_str(), n, s.np, s.dt, substeps, t, wall, cpu, done / cpu / 1e6, done / wall / 1e6, cpu / t, first,
        first_cpu, use.ru_maxrss / 1024., s.tP / done * 1e9, s.tG / done * 1e9, s.tQ / done * 1e9, s.tS / done * 1e9,
        s.nfall * 16. / done, s.heap().c_str());
    fflush(stdout);
  }
}
