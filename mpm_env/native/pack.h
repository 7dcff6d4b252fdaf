// Sixteen numbers at once, in as many machine registers as that takes: what the kernels are written in.
// NATIVE_BYTES is the width of a register; the same source serves AVX-512, AVX2 and everything else.
#pragma once
#include <cstdint>
#include <cstring>
#include <utility>
#if defined(__AVX512F__) && defined(__AVX512DQ__)
#include <immintrin.h>
#define NATIVE_BYTES 64
#elif defined(__AVX2__)
#include <immintrin.h>
#define NATIVE_BYTES 32
#else
#define NATIVE_BYTES 16
#endif
#define INLINE inline __attribute__((always_inline))

namespace MPM_ISA {

constexpr int W = 16;  // lanes of a pack
template <class S> constexpr int LANES = NATIVE_BYTES / sizeof(S);  // of a register: what keeps many packs uses these

template <class S> struct IntOf;
template <> struct IntOf<float> { typedef int32_t type; static constexpr int mantissa = 23, bias = 127; };
template <> struct IntOf<double> { typedef int64_t type; static constexpr int mantissa = 52, bias = 1023; };

template <> struct IntOf<int32_t> { typedef int32_t type; };
template <> struct IntOf<int64_t> { typedef int64_t type; };

// T is float, double, or the integer of the same size (then also a mask: 0 or all bits per lane).
template <class T, int L = W> struct Pack {
  typedef T Part __attribute__((vector_size(NATIVE_BYTES)));
  static constexpr int N = NATIVE_BYTES / sizeof(T);  // lanes of a part
  static constexpr int K = L / N;                     // parts
  Part p[K];
  INLINE Pack() {}
  INLINE Pack(T a) { for (int k = 0; k < K; ++k) p[k] = Part{} + a; }
  static INLINE Pack load(const T* a) { Pack r; std::memcpy(r.p, a, sizeof r.p); return r; }
  INLINE void store(T* a) const { std::memcpy(a, p, sizeof p); }
};

#define ON_PARTS(T, expr) Pack<T, L> r; for (int k = 0; k < Pack<T, L>::K; ++k) r.p[k] = (expr); return r
#define OPERATOR(op) \
  template <class T, int L> INLINE Pack<T, L> operator op(Pack<T, L> a, Pack<T, L> b) { ON_PARTS(T, a.p[k] op b.p[k]); } \
  template <class T, int L> INLINE Pack<T, L> operator op(Pack<T, L> a, T b) { return a op Pack<T, L>(b); } \
  template <class T, int L> INLINE Pack<T, L> operator op(T a, Pack<T, L> b) { return Pack<T, L>(a) op b; }
OPERATOR(+) OPERATOR(-) OPERATOR(*) OPERATOR(/) OPERATOR(&) OPERATOR(|) OPERATOR(>>) OPERATOR(<<)
#undef OPERATOR
template <class T, int L> INLINE Pack<T, L> operator-(Pack<T, L> a) { ON_PARTS(T, -a.p[k]); }
template <class T, int L> INLINE Pack<T, L> operator~(Pack<T, L> a) { ON_PARTS(T, ~a.p[k]); }

template <class S, int L = W> using Bits = Pack<typename IntOf<S>::type, L>;
#define COMPARE(op) \
  template <class S, int L> INLINE Bits<S, L> operator op(Pack<S, L> a, Pack<S, L> b) { \
    Bits<S, L> r; for (int k = 0; k < Pack<S, L>::K; ++k) r.p[k] = (typename Bits<S, L>::Part)(a.p[k] op b.p[k]); return r; } \
  template <class S, int L> INLINE Bits<S, L> operator op(Pack<S, L> a, S b) { return a op Pack<S, L>(b); }
COMPARE(<) COMPARE(>) COMPARE(>=)
#undef COMPARE
template <class S, int L> INLINE Pack<S, L> select(Bits<S, L> mask, Pack<S, L> a, Pack<S, L> b) { ON_PARTS(S, mask.p[k] ? a.p[k] : b.p[k]); }
template <class S, int L> INLINE Bits<S, L> bits(Pack<S, L> a) { Bits<S, L> r; std::memcpy(r.p, a.p, sizeof r.p); return r; }
template <class S, int L> INLINE Pack<S, L> floats(Bits<S, L> a) { Pack<S, L> r; std::memcpy(r.p, a.p, sizeof r.p); return r; }
template <class S, int L> INLINE Pack<S, L> number(Bits<S, L> a) { ON_PARTS(S, __builtin_convertvector(a.p[k], typename Pack<S, L>::Part)); }
template <class S, int L> INLINE Bits<S, L> whole(Pack<S, L> a) {  // towards zero
  Bits<S, L> r; for (int k = 0; k < Pack<S, L>::K; ++k) r.p[k] = __builtin_convertvector(a.p[k], typename Bits<S, L>::Part); return r; }
template <class S, int L> INLINE Bits<S, L> floored(Pack<S, L> a) { Bits<S, L> i = whole(a); return i + (a < number<S>(i)); }
template <class T, int L> INLINE bool any(Pack<T, L> mask) {
  for (int k = 0; k < Pack<T, L>::K; ++k)
#if NATIVE_BYTES == 64
    if (sizeof(T) == 4 ? _mm512_movepi32_mask((__m512i)mask.p[k]) : _mm512_movepi64_mask((__m512i)mask.p[k])) return true;
#elif NATIVE_BYTES == 32
    if (_mm256_movemask_epi8((__m256i)mask.p[k])) return true;
#else
    for (int l = 0; l < Pack<T, L>::N; ++l) if (mask.p[k][l]) return true;
#endif
  return false;
}

// These keep a NaN in their first argument, so that a sick grain stays visible.
template <class S, int L> INLINE Pack<S, L> largest(Pack<S, L> a, S b) { return select<S>(a < b, Pack<S, L>(b), a); }
template <class S, int L> INLINE Pack<S, L> smallest(Pack<S, L> a, S b) { return select<S>(a > b, Pack<S, L>(b), a); }
template <class S, int L> INLINE Pack<S, L> magnitude(Pack<S, L> a) { return floats<S>(bits(a) & Pack<typename IntOf<S>::type, L>(~(typename IntOf<S>::type(1) << (8 * sizeof(S) - 1)))); }
template <class S, int L> INLINE Pack<S, L> with_sign(Pack<S, L> size, Pack<S, L> sign) {  // size >= 0
  typedef typename IntOf<S>::type I;
  return floats<S>(bits(size) | (bits(sign) & Pack<I, L>(I(1) << (8 * sizeof(S) - 1)))); }

INLINE float root(float a) { return __builtin_sqrtf(a); }
INLINE double root(double a) { return __builtin_sqrt(a); }
template <class S, int L> INLINE Pack<S, L> root(Pack<S, L> a) {
  Pack<S, L> r;
#if NATIVE_BYTES == 64
  for (int k = 0; k < Pack<S, L>::K; ++k)
    if constexpr (sizeof(S) == 4) r.p[k] = (typename Pack<S, L>::Part)_mm512_sqrt_ps((__m512)a.p[k]);
    else r.p[k] = (typename Pack<S, L>::Part)_mm512_sqrt_pd((__m512d)a.p[k]);
#elif NATIVE_BYTES == 32
  for (int k = 0; k < Pack<S, L>::K; ++k)
    if constexpr (sizeof(S) == 4) r.p[k] = (typename Pack<S, L>::Part)_mm256_sqrt_ps((__m256)a.p[k]);
    else r.p[k] = (typename Pack<S, L>::Part)_mm256_sqrt_pd((__m256d)a.p[k]);
#else
  for (int k = 0; k < Pack<S, L>::K; ++k) for (int l = 0; l < Pack<S, L>::N; ++l) r.p[k][l] = root(a.p[k][l]);
#endif
  return r;
}
template <class S, int L> INLINE Pack<S, L> per_root(Pack<S, L> a) {  // 1 / sqrt(a) for a > 0
#if NATIVE_BYTES == 64
  if constexpr (sizeof(S) == 4) {
    Pack<S, L> r; r.p[0] = (typename Pack<S, L>::Part)_mm512_rsqrt14_ps((__m512)a.p[0]);
    return r * (S(1.5) - S(0.5) * a * r * r);  // one Newton step: 14 bits become 24
  } else {
    Pack<S, L> r; for (int k = 0; k < Pack<S, L>::K; ++k) r.p[k] = (typename Pack<S, L>::Part)_mm512_rsqrt14_pd((__m512d)a.p[k]);
    for (int i = 0; i < 2; ++i) r = r * (S(1.5) - S(0.5) * a * r * r);
    return r;
  }
#endif
  return S(1) / root(a);
}

// ln(1 + x), x > -1, to the last digits also for small x: 1 + x = 2^k (1 + r), then ln(1 + r) = 2 artanh(r / (2 + r)).
// y is 1 + x as one knows it: near zero it holds digits that x has lost.
template <class S, int L> INLINE Pack<S, L> log1p(Pack<S, L> x, Pack<S, L> y) {
  typedef typename IntOf<S>::type I;
  constexpr int terms = sizeof(S) == 4 ? 4 : 10;
  Bits<S, L> k = (bits(y * S(1.41421356237309504880)) >> I(IntOf<S>::mantissa)) - I(IntOf<S>::bias);
  Pack<S, L> scale = floats<S>((I(IntOf<S>::bias) - k) << I(IntOf<S>::mantissa));  // 2^-k
  Pack<S, L> r = select<S>(x < S(-0.5), y * scale - S(1), x * scale + (scale - S(1)));
  Pack<S, L> s = r / (r + S(2)), s2 = s * s, sum(S(2) / S(2 * terms + 1));
  for (int i = terms - 1; i >= 0; --i) sum = sum * s2 + S(2) / S(2 * i + 1);
  return s * sum + number<S>(k) * S(0.69314718055994530942);
}
template <class S, int L> INLINE Pack<S, L> log1p(Pack<S, L> x) { return log1p(x, x + S(1)); }

// exp(x) as 2^k (1 + part): part = exp(r) - 1 for a small r. Beyond the range of exponents, as far as that goes.
template <class S, int L> INLINE Pack<S, L> exp_part(Pack<S, L> x, Pack<S, L>& power) {
  typedef typename IntOf<S>::type I;
  constexpr int order = sizeof(S) == 4 ? 7 : 14;
  constexpr S most = sizeof(S) == 4 ? S(87) : S(708);
  x = smallest(largest(x, -most), most);
  Bits<S, L> k = floored(x * S(1.44269504088896340736) + S(0.5));
  Pack<S, L> n = number<S>(k);
  Pack<S, L> r = sizeof(S) == 4 ? (x - n * S(0.693145751953125)) - n * S(1.42860682030941723212e-6)
                             : (x - n * S(6.93147180369123816490e-01)) - n * S(1.90821492927058770002e-10);
  Pack<S, L> sum(S(1));  // r + r^2/2! + ... as r (1 + r/2 (1 + r/3 (...)))
  for (int i = order; i >= 2; --i) sum = sum * r * (S(1) / S(i)) + S(1);
  power = floats<S>((k + I(IntOf<S>::bias)) << I(IntOf<S>::mantissa));
  return sum * r;
}

template <class S, int L> INLINE Pack<S, L> exp(Pack<S, L> x) {
  Pack<S, L> power, part = exp_part(x, power);
  return part * power + power;
}

// exp(x) - 1 to the last digits also for small x.
template <class S, int L> INLINE Pack<S, L> expm1(Pack<S, L> x) {
  Pack<S, L> power, part = exp_part(x, power);
  return part * power + (power - S(1));
}

// Rows x and y of a matrix, of which every other group of H lanes changes places; their new values by FROM_Y.
template <bool FROM_Y, int H, class V, int... L> INLINE V exchanged(V x, V y, std::integer_sequence<int, L...>) {
  constexpr int N = sizeof...(L);
  return __builtin_shufflevector(x, y, (FROM_Y ? (L & H ? N + L : L + H) : (L & H ? N + L - H : L))...);
}

// As many registers as each has lanes, the rows of a matrix, transposed in place by halving.
template <class S, int H = LANES<S> / 2> INLINE void transpose_block(Pack<S, LANES<S>>* r) {
  constexpr int N = LANES<S>;
  constexpr std::make_integer_sequence<int, N> lanes;
#pragma GCC unroll 16
  for (int i = 0; i < N; ++i)
    if (!(i & H)) {
      auto x = r[i].p[0], y = r[i + H].p[0];
      r[i].p[0] = exchanged<false, H>(x, y, lanes);
      r[i + H].p[0] = exchanged<true, H>(x, y, lanes);
    }
  if constexpr (H > 1) transpose_block<S, H / 2>(r);
}

// Sixteen packs as the rows of a matrix, transposed in place.
template <class S> INLINE void transpose(Pack<S>* r) {
  constexpr int N = Pack<S>::N, K = Pack<S>::K;
  Pack<S, N> block[K][K][N];
#pragma GCC unroll 8
  for (int a = 0; a < K; ++a)
#pragma GCC unroll 8
    for (int b = 0; b < K; ++b) {
#pragma GCC unroll 16
      for (int i = 0; i < N; ++i) block[a][b][i].p[0] = r[a * N + i].p[b];
      transpose_block<S>(block[a][b]);
    }
#pragma GCC unroll 8
  for (int a = 0; a < K; ++a)
#pragma GCC unroll 8
    for (int b = 0; b < K; ++b)
#pragma GCC unroll 16
      for (int i = 0; i < N; ++i) r[b * N + i].p[a] = block[a][b][i].p[0];
}

// Four numbers, repeated over the lanes of the register that is a pack's part.
template <class S> INLINE Pack<S, LANES<S>> repeated(const S* four, int part) {
  constexpr int L = LANES<S>;
  Pack<S, L> r;
#if NATIVE_BYTES == 64
  if constexpr (sizeof(S) == 4) r.p[0] = (typename Pack<S, L>::Part)_mm512_broadcast_f32x4(_mm_loadu_ps(four));
  else r.p[0] = (typename Pack<S, L>::Part)_mm512_broadcast_f64x4(_mm256_loadu_pd(four));
#else
  for (int l = 0; l < L; l += 4) std::memcpy((S*)&r + l, four + part * L % 4, sizeof(S) * (L < 4 ? L : 4));
#endif
  return r;
}

// Sums over each pack's four groups of four lanes, the sums of a, b, c and d behind each other.
template <class S> INLINE Pack<S> group_sums(Pack<S> a, Pack<S> b, Pack<S> c, Pack<S> d) {
#if NATIVE_BYTES == 64
  if constexpr (sizeof(S) == 4) {
    __m512 A = (__m512)a.p[0], B = (__m512)b.p[0], C = (__m512)c.p[0], D = (__m512)d.p[0];
    __m512 u = _mm512_shuffle_f32x4(A, B, 0x44) + _mm512_shuffle_f32x4(A, B, 0xee);
    __m512 w = _mm512_shuffle_f32x4(C, D, 0x44) + _mm512_shuffle_f32x4(C, D, 0xee);
    Pack<S> r;
    r.p[0] = (typename Pack<S>::Part)(_mm512_shuffle_f32x4(u, w, 0x88) + _mm512_shuffle_f32x4(u, w, 0xdd));
    return r;
  } else {
    auto pair = [](const Pack<S>& a, const Pack<S>& b) {
      __m512d A = (__m512d)(a.p[0] + a.p[1]), B = (__m512d)(b.p[0] + b.p[1]);
      return (typename Pack<S>::Part)(_mm512_shuffle_f64x2(A, B, 0x44) + _mm512_shuffle_f64x2(A, B, 0xee));
    };
    Pack<S> r;
    r.p[0] = pair(a, b); r.p[1] = pair(c, d);
    return r;
  }
#endif
  typedef S Quad __attribute__((vector_size(4 * sizeof(S))));
  Quad in[16], out[4];
  std::memcpy(in, &a, sizeof a); std::memcpy(in + 4, &b, sizeof b);
  std::memcpy(in + 8, &c, sizeof c); std::memcpy(in + 12, &d, sizeof d);
  for (int i = 0; i < 4; ++i) out[i] = (in[4 * i] + in[4 * i + 1]) + (in[4 * i + 2] + in[4 * i + 3]);
  return Pack<S>::load((const S*)out);
}

}  // namespace MPM_ISA
