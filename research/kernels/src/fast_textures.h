/* The procedural patterns. */
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

/* Fraction of a feature of size `wavelength` that a picture shows whose pixels are `footprint` wide: none below two
 * pixels, all of it from four. */
static inline double resolved(double wavelength, double footprint) {
    return min_d(max_d(0.5 * wavelength / max_d(footprint, 1e-9) - 1.0, 0.0), 1.0);
}

/* Value noise about 0, faded out where its features of size 1 are smaller than pixels. */
static inline double fine_noise(double x, double y, int64_t seed, double footprint) {
    double part = resolved(1.0, footprint);
    return part > 0.0 ? part * (value_noise(x, y, seed) - 0.5) : 0.0;
}

/* Three octaves of value noise in [0, 1]; `p` is the width of a pixel in the units of x and y. */
static inline double clouds(double x, double y, int64_t seed, double p) {
    return 0.5 + 0.55 * fine_noise(x, y, seed, p) + 0.28 * fine_noise(2.3 * x, 2.3 * y, seed + 1, 2.3 * p) +
           0.17 * fine_noise(5.7 * x, 5.7 * y, seed + 2, 5.7 * p);
}

static inline double clip_unit(double x) { return min_d(max_d(x, 0.0), 1.0); }

/* Sawn wood: year rings that wander along t and bend round knots, fibres on top. */
static inline double grain(double s, double t, int64_t seed, double p) {
    double ring = 0.9 * s + 2.6 * value_noise(0.3 * s, 0.035 * t, seed);
    int64_t i = floor_int(0.12 * s), j = floor_int(0.04 * t);
    double knot = 0.0;
    if (hash_unit(i, j, seed + 3) < 0.45) {
        double dx = (0.12 * s - (double)i - 0.5) * 5.0, dy = (0.04 * t - (double)j - 0.5) * 4.0;
        knot = max_d(0.0, 1.0 - dx * dx - dy * dy);
        ring += 2.0 * knot * knot;
    }
    double r = ring - floor(ring), year = r < 0.75 ? r / 0.75 : (1.0 - r) / 0.25;
    double f = 0.5 + 0.55 * resolved(1.1, p) * (year - 0.5) + 0.5 * fine_noise(5.0 * s, 0.15 * t, seed + 1, 5.0 * p) +
               0.4 * fine_noise(0.2 * s, 0.05 * t, seed + 2, 0.2 * p) + 0.5 * knot * knot;
    return clip_unit(f);
}

/* A printed page: blocks of text, headlines, pictures and blank space; lines are one unit apart. */
static inline double page(double s, double t, int64_t seed, double p, double *third) {
    int64_t column = floor_int(s * 0.09), block = floor_int(t * 0.14 + 3.0 * hash_unit(column, 5, seed));
    double kind = hash_unit(column, block, seed), sharp = resolved(1.6, p);
    if (kind < 0.35) {
        double ink = t - floor(t) < 0.5 && hash_unit(floor_int(1.4 * s), floor_int(t), seed + 1) > 0.2 ? 0.8 : 0.0;
        return 0.3 + sharp * (ink - 0.3);
    }
    if (kind < 0.5) {
        double u = 0.35 * t - floor(0.35 * t);
        return u < 0.5 && hash_unit(floor_int(0.6 * s), floor_int(0.35 * t), seed + 2) > 0.25 ? 1.0 : 0.0;
    }
    if (kind < 0.78) {
        *third = hash_unit(column, block, seed + 3);
        return clip_unit(2.2 * (clouds(0.35 * s, 0.35 * t, seed + 4, 0.35 * p) - 0.5) + 0.5);
    }
    return 0.0;
}

/* What stands outside a window, h from -1 (bottom of the pane) to 1: sky, clouds, trees, houses, ground. */
static inline double outside(double s, double h, int64_t seed, double p, double *third) {
    double horizon = -0.5 + 0.7 * hash_unit(0, 9, seed);
    int64_t i = floor_int(0.8 * s);
    double x = 0.8 * s - (double)i, roof = horizon + 0.15 + 0.9 * hash_unit(i, 1, seed);
    if (hash_unit(i, 2, seed) < 0.45 && x > 0.08 && x < 0.92 && h < roof - 0.35 * fabs(x - 0.5) && h > horizon - 0.1) {
        double u = 5.0 * x - floor(5.0 * x), v = 5.0 * h - floor(5.0 * h);
        *third = 0.85;
        return u > 0.3 && u < 0.75 && v > 0.3 && v < 0.8 ? 1.0 : 0.25;
    }
    double trees = horizon + 0.55 * value_noise(1.7 * s, 0.5, seed + 1) + 0.2 * value_noise(7.0 * s, 0.5, seed + 2);
    if (h < horizon) return 0.8;
    if (h < trees) return clip_unit(0.8 + 0.9 * (clouds(4.0 * s, 4.0 * h, seed + 3, 4.0 * p) - 0.5));
    double cloud = clip_unit(3.0 * (clouds(0.8 * s, 2.0 * h, seed + 4, 2.0 * p) - 0.5));
    return 0.12 * (1.0 - h) * (1.0 - cloud);
}

/* Fraction of the second color at (s, t) of a pattern (materials.Pattern), and of a third one. `p` is the width of a
 * pixel in the same units, `h` the place along the second axis from -1 to 1. What is finer than pixels is faded. */
static inline double blend_at(int64_t pattern, double s, double t, double h, int64_t seed, double p, double *third) {
    double n, sharp;
    *third = 0.0;
    switch (pattern) {
    case 0: return clouds(s, t, seed, p);
    case 1:
        n = 0.7 * fine_noise(s, t * 0.06, seed, p) + 0.3 * fine_noise(s * 3.0, t * 0.2, seed + 1, 3.0 * p);
        return clip_unit(0.5 + n);
    case 2: return 0.5 + resolved(1.0, p) * (s - floor(s) < 0.5 ? 0.5 : -0.5);
    case 3: return 0.5 + resolved(2.0, p) * ((((uint64_t)floor_int(s) + (uint64_t)floor_int(t)) & 1) ? 0.5 : -0.5);
    case 4:
        sharp = resolved(1.0, p), n = 0.3 * hash_unit(floor_int(s), floor_int(t), seed);
        if (s - floor(s) < 0.04 || t - floor(t) < 0.04) n = 1.0;
        return 0.2 + sharp * (n - 0.2) + 0.15 * fine_noise(3.0 * s, 3.0 * t, seed + 1, 3.0 * p);
    case 5: return 0.5 + 0.5 * fine_noise(s, t * 0.25, seed, p) + 0.5 * fine_noise(s * 0.25, t, seed + 1, p);
    case 6:
        n = 0.65 * value_noise(s, t, seed) + 0.35 * value_noise(s * 2.7, t * 2.7, seed + 1);
        *third = 0.44 < n && n < 0.5 ? 1.0 : 0.0;
        return n > 0.5 ? 1.0 : 0.0;
    case 7:
        n = floor(s + 0.35 * hash_unit(floor_int(s), 7, seed));
        *third = hash_unit(to_int(n), 2, seed) * 0.6;
        return 0.5 + resolved(2.0, p) * (hash_unit(to_int(n), 1, seed) - 0.5);
    case 8: return planks(s, t, seed);
    case 9: return grain(s, t, seed, p);
    case 10:
        n = hash_unit(floor_int(6.0 * s), floor_int(6.0 * t), seed + 3), sharp = resolved(0.33, p);
        *third = n > 0.93 ? 0.7 * sharp : 0.0;
        return clip_unit(0.5 + 1.3 * (clouds(s, t, seed, p) - 0.5) + sharp * (n < 0.12 ? 0.45 : 0.0));
    case 11:
        n = 0.4 * fine_noise(4.0 * s, t * 0.04, seed, 4.0 * p);
        n += 0.5 * fine_noise(s * 0.15, t * 0.1, seed + 2, 0.15 * p);
        return 0.5 + n + 0.3 * fine_noise(12.0 * s, t * 0.1, seed + 1, 12.0 * p);
    case 12:
        n = fine_noise(2.5 * s, 0.1 * t, seed, 2.5 * p) + 0.5 * fine_noise(0.4 * s, 0.04 * t, seed + 1, 0.4 * p);
        return clip_unit(0.5 + 1.7 * n + 0.5 * fine_noise(14.0 * s, 14.0 * t, seed + 2, 14.0 * p));
    case 13: return page(s, t, seed, p, third);
    case 14: return outside(s, h, seed, p, third);
    case 17:
        sharp = s - floor(s) > 0.28 && s - floor(s) < 0.72 && t - floor(t) > 0.3 && t - floor(t) < 0.8 ? 1.0 : 0.0;
        return 0.22 + resolved(1.0, p) * (sharp - 0.22);
    default: /* stains, and streaks that run down */
        n = value_noise(2.0 * s, 0.25 * t, seed + 4);
        return clip_unit(clouds(s, t, seed, p) + 0.5 * n * n - 0.12);
    }
}

/* Writes the albedo at the point `local` of a primitive. (s, t) are the two own axes across the normal, which is along
 * `axis`; for what has a grain t is the longer side. `footprint` is the width of a pixel there, metres. Every surface
 * but those of pattern 16 is a little uneven: stains of half a metre, spots of some centimetres. */
static inline void texture(int64_t pattern, const double *color_a, const double *color_b, double scale, int64_t seed,
                           const double *local, const double *half, int axis, double footprint, double *albedo) {
    if (pattern == 16) {
        for (int i = 0; i < 3; i++) albedo[i] = color_a[i];
        return;
    }
    int first = axis == 0 ? 1 : 0, second = axis == 2 ? 1 : 2;
    if ((pattern == 1 || pattern == 8 || pattern == 9 || pattern == 11) && half[first] > half[second]) {
        int longer = first;
        first = second, second = longer;
    }
    double x = local[first], y = local[second], third;
    double f = blend_at(pattern, x / scale, y / scale, y / half[second], seed, footprint / scale, &third);
    double uneven = 1.0 + 0.3 * (value_noise(x / 0.45, y / 0.45, seed + 11) - 0.5) +
                    0.2 * fine_noise(x / 0.05, y / 0.05, seed + 12, footprint / 0.05);
    for (int i = 0; i < 3; i++) {
        double base = color_a[i] * (1 - f) + color_b[i] * f;
        albedo[i] = uneven * (base * (1 - third) + third * (0.5 * color_a[2 - i] + 0.3 * color_b[i]));
    }
}
