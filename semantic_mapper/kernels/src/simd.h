/* Eight floats as one value, in the compiler's vector extensions: AVX2 has an instruction for each operation; without
 * it the compiler splits them. Left to itself it keeps short sums in memory and short softmaxes scalar.
 *
 * `a * b + c` becomes one fused operation where the file that includes this allows it: #pragma clang fp contract(fast).
 */
#pragma once

#include <stdint.h>
#include <string.h>

#pragma clang diagnostic ignored "-Wpsabi" /* how vectors are passed: all of these are inlined */

#define LANES 8
#define INLINE static inline __attribute__((always_inline))

typedef float Lanes __attribute__((ext_vector_type(LANES)));
typedef int32_t IntLanes __attribute__((ext_vector_type(LANES)));

static inline int64_t round_up(int64_t n, int64_t multiple) { return (n + multiple - 1) / multiple * multiple; }

INLINE Lanes load(const float *from) {
    Lanes value;
    memcpy(&value, from, sizeof value); /* at any address */
    return value;
}

INLINE void store(float *to, Lanes value) { memcpy(to, &value, sizeof value); }

INLINE Lanes splat(float x) { return (Lanes)x; }

/* The larger of each two; a where b is NaN. */
INLINE Lanes larger(Lanes a, Lanes b) { return a < b ? b : a; }

INLINE Lanes swap_halves(Lanes x) { return __builtin_shufflevector(x, x, 4, 5, 6, 7, 0, 1, 2, 3); }

/* Sum of the lanes. */
INLINE float total(Lanes x) {
    x += swap_halves(x);
    x += __builtin_shufflevector(x, x, 2, 3, 0, 1, 6, 7, 4, 5);
    return x[0] + x[1];
}

/* The largest lane. */
INLINE float largest(Lanes x) {
    x = larger(x, swap_halves(x));
    x = larger(x, __builtin_shufflevector(x, x, 2, 3, 0, 1, 6, 7, 4, 5));
    return x[0] > x[1] ? x[0] : x[1];
}

/* Sums of neighbours: a0 + a1, a2 + a3, b0 + b1, b2 + b3, then the same of the upper four lanes. */
INLINE Lanes add_pairs(Lanes a, Lanes b) {
    return __builtin_shufflevector(a, b, 0, 2, 8, 10, 4, 6, 12, 14) +
           __builtin_shufflevector(a, b, 1, 3, 9, 11, 5, 7, 13, 15);
}

/* Eight sums, one of each argument's lanes. */
INLINE Lanes totals(Lanes a, Lanes b, Lanes c, Lanes d, Lanes e, Lanes f, Lanes g, Lanes h) {
    Lanes near = add_pairs(add_pairs(a, b), add_pairs(c, d)), far = add_pairs(add_pairs(e, f), add_pairs(g, h));
    return __builtin_shufflevector(near, far, 0, 1, 2, 3, 8, 9, 10, 11) +
           __builtin_shufflevector(near, far, 4, 5, 6, 7, 12, 13, 14, 15);
}

/* exp of each lane, for values <= 0, relative error below 1e-6. Values under -87 give e^-87; NaN stays. */
INLINE Lanes exp_below(Lanes value) {
    const Lanes least = splat(-87.0f);
    Lanes x = value < least ? least : value;
    Lanes finite = x > least ? x : least; /* not even NaN may become an integer that has no meaning */
    IntLanes k = __builtin_convertvector(finite * 1.4426950408889634f - 0.5f, IntLanes);
    Lanes whole = __builtin_convertvector(k, Lanes);
    Lanes r = x - whole * 0.693359375f + whole * 2.12194440e-4f; /* ln 2 in two parts: the first product is exact */
    Lanes p = splat(1.0f / 720);
    p = p * r + 1.0f / 120;
    p = p * r + 1.0f / 24;
    p = p * r + 1.0f / 6;
    p = p * r + 0.5f;
    p = p * r + 1.0f;
    p = p * r + 1.0f;
    IntLanes bits = (k + 127) << 23;
    Lanes power;
    memcpy(&power, &bits, sizeof power);
    return p * power;
}

/* log of each lane, for normal numbers above 0, error below 1e-7 of its size or of 1; NaN gives what has no meaning. */
INLINE Lanes log_of(Lanes x) {
    IntLanes bits;
    memcpy(&bits, &x, sizeof bits);
    IntLanes power = (bits - 0x3f3504f3) >> 23; /* x = m * 2^power, m from sqrt(1/2) to sqrt(2) */
    IntLanes rest = bits - (power << 23);
    Lanes m, k = __builtin_convertvector(power, Lanes);
    memcpy(&m, &rest, sizeof m);
    Lanes s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
    Lanes series = 1.0f / 3 + s2 * (1.0f / 5 + s2 * (1.0f / 7 + s2 * (1.0f / 9)));
    return k * 0.693359375f + (2.0f * s + 2.0f * s * s2 * series - k * 2.12194440e-4f);
}

/* 1 / (1 + exp(-x)) of each lane. */
INLINE Lanes logistic(Lanes x) {
    Lanes e = exp_below(x < 0 ? x : -x), large = 1.0f / (1.0f + e);
    return x < 0 ? e * large : large;
}
