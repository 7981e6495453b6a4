/* The procedural patterns; tests/scenes/torch_textures.py holds their twins in torch. */
#pragma once

#include "kernels.h"

/* Two integers and a seed -> [0, 1), the same on every machine. */
static inline double hash_unit(int64_t i, int64_t j, int64_t seed) {
    uint64_t h = ((uint64_t)i * 374761393u + (uint64_t)j * 668265263u + (uint64_t)seed * 974634777u) & 0xFFFFFFFFu;
    h = ((h ^ (h >> 13)) * 1274126177u) & 0xFFFFFFFFu;
    h = ((h ^ (h >> 16)) * 1911520717u) & 0xFFFFFFFFu;
    return (double)((h ^ (h >> 15)) & 0xFFFFFFu) / 16777216.0;
}

static inline double smooth_step(double x) { return x * x * (3 - 2 * x); }

/* Smooth value noise in [0, 1]. */
static inline double value_noise(double x, double y, int64_t seed) {
    int64_t i = floor_int(x), j = floor_int(y);
    double a = smooth_step(x - floor(x)), b = smooth_step(y - floor(y));
    double top = hash_unit(i, j, seed) * (1 - a) + hash_unit(i + 1, j, seed) * a;
    double low = hash_unit(i, j + 1, seed) * (1 - a) + hash_unit(i + 1, j + 1, seed) * a;
    return top * (1 - b) + low * b;
}

/* Boards one unit wide and eight long, each of its own shade, with grain and dark joints. */
static inline double planks(double s, double t, int64_t seed) {
    int64_t row = floor_int(s);
    double along = t * 0.125 + hash_unit(row, 3, seed);
    if (s - floor(s) < 0.03 || along - floor(along) < 0.004) return 1.0;
    return 0.55 * hash_unit(row, floor_int(along), seed) + 0.3 * value_noise(s * 8.0, t * 0.5, seed + 1);
}

/* Fraction of the second color at (s, t) of a pattern (materials.Pattern), and of a third one. */
static inline double blend_at(int64_t pattern, double s, double t, int64_t seed, double *third) {
    double n;
    *third = 0.0;
    switch (pattern) {
    case 0: return value_noise(s, t, seed);
    case 1: return 0.7 * value_noise(s, t * 0.06, seed) + 0.3 * value_noise(s * 3.0, t * 0.2, seed + 1);
    case 2: return s - floor(s) < 0.5 ? 1.0 : 0.0;
    case 3: return (double)(((uint64_t)floor_int(s) + (uint64_t)floor_int(t)) & 1);
    case 4:
        if (s - floor(s) < 0.04 || t - floor(t) < 0.04) return 1.0;
        return 0.3 * hash_unit(floor_int(s), floor_int(t), seed);
    case 5: return 0.5 * value_noise(s, t * 0.25, seed) + 0.5 * value_noise(s * 0.25, t, seed + 1);
    case 6:
        n = 0.65 * value_noise(s, t, seed) + 0.35 * value_noise(s * 2.7, t * 2.7, seed + 1);
        *third = 0.44 < n && n < 0.5 ? 1.0 : 0.0;
        return n > 0.5 ? 1.0 : 0.0;
    case 7:
        n = floor(s + 0.35 * hash_unit(floor_int(s), 7, seed));
        *third = hash_unit(to_int(n), 2, seed) * 0.6;
        return hash_unit(to_int(n), 1, seed);
    default: return planks(s, t, seed);
    }
}

/* Writes the albedo at the point `local` of a primitive. (s, t) are the two own axes across the normal, which is along
 * `axis`; for wood and planks t is the longer side. */
static inline void texture(int64_t pattern, const double *color_a, const double *color_b, double scale, int64_t seed,
                           const double *local, const double *half, int axis, double *albedo) {
    int first = axis == 0 ? 1 : 0, second = axis == 2 ? 1 : 2;
    if ((pattern == 1 || pattern == 8) && half[first] > half[second]) {
        int longer = first;
        first = second, second = longer;
    }
    double third, f = blend_at(pattern, local[first] / scale, local[second] / scale, seed, &third);
    for (int i = 0; i < 3; i++) {
        double base = color_a[i] * (1 - f) + color_b[i] * f;
        albedo[i] = base * (1 - third) + third * (0.5 * color_a[2 - i] + 0.3 * color_b[i]);
    }
}
