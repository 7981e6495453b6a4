/* A radiance field on a dense grid, and the samples of a ray in it; see fields/grid/. */
#pragma once

#include "kernels.h"
#include "simd.h"

#define CELL 4 /* intervals between vertices a side of a cell, which is occupied or not */

/* Points are in units of voxels: vertex (0, 0, 0) is at the origin. */
typedef struct {
    F32 values;         /* (X, Y, Z, C) at the vertices; channel 0 is the raw density */
    U8 occupied;        /* (cells in x, in y, in z) */
    double step, bias;  /* length of a sample in voxels; what is added to the raw density */
    double stop_below;  /* a ray ends where less light than this gets through */
} Grid;

typedef struct {
    F32 origin, direction; /* (R, 3) voxels; of a direction a metre of z */
    F32 near, far;         /* (R,) metres of z */
    F32 jitter;            /* (R,) where in its interval a sample lies, 0 to 1 */
} GridRays;

/* The lattice of samples of one ray. */
typedef struct {
    float origin[3], direction[3], first, interval, jitter; /* z of the first interval, and its length */
    int64_t count;
} Lattice;

INLINE int64_t base_of(float p, int64_t n) { return max_i(min_i((int64_t)p, n - 2), 0); }

INLINE float z_of(const Lattice *l, int64_t k) { return l->first + ((float)k + l->jitter) * l->interval; }

/* The part of a ray that is in the grid; without samples where there is none. */
INLINE Lattice lattice_of(const Grid *g, const GridRays *rays, int64_t r) {
    Lattice l = {.jitter = rays->jitter.data[r], .interval = 1};
    float start = rays->near.data[r], end = rays->far.data[r], square = 0;
    for (int i = 0; i < 3; i++) {
        const float o = rays->origin.data[3 * r + i], d = rays->direction.data[3 * r + i];
        const float top = (float)(g->values.shape[i] - 1);
        if (!(fabsf(o) < 1e9f && fabsf(d) < 1e9f)) return l; /* NaN, too */
        l.origin[i] = o, l.direction[i] = d, square += d * d;
        if (fabsf(d) < 1e-9f) {
            if (!(o >= 0 && o <= top)) return l;
            continue;
        }
        const float a = -o / d, b = (top - o) / d;
        start = max_f(start, min_f(a, b)), end = min_f(end, max_f(a, b));
    }
    if (!(end > start) || !(square > 0)) return l;
    l.first = start, l.interval = (float)g->step / sqrtf(square);
    l.count = (int64_t)min_d(ceil((double)(end - start) / l.interval - l.jitter), 1 << 20);
    return l;
}

INLINE void point_of(const Grid *g, const Lattice *l, int64_t k, float *p) {
    const float z = z_of(l, k);
    for (int i = 0; i < 3; i++)
        p[i] = min_f(max_f(l->origin[i] + z * l->direction[i], 0), (float)(g->values.shape[i] - 1));
}

/* The first sample from k on that lies in an occupied cell, and where; -1 = none. */
INLINE int64_t next_sample(const Grid *g, const Lattice *l, int64_t k, float *p) {
    while (k < l->count) {
        int64_t cell[3];
        point_of(g, l, k, p);
        for (int i = 0; i < 3; i++) cell[i] = base_of(p[i], g->values.shape[i]) / CELL;
        if (g->occupied.data[(cell[0] * g->occupied.shape[1] + cell[1]) * g->occupied.shape[2] + cell[2]]) return k;
        float leave = INFINITY;
        for (int i = 0; i < 3; i++) {
            if (fabsf(l->direction[i]) < 1e-9f) continue;
            const float side = (float)(CELL * (cell[i] + (l->direction[i] > 0)));
            leave = min_f(leave, (side - l->origin[i]) / l->direction[i]);
        }
        const float last = floorf((leave - l->first) / l->interval - l->jitter);
        k = last > (float)k && last < (float)l->count ? (int64_t)last : k + 1;
    }
    return -1;
}

/* Trilinear: the vertex before a point, and the weights of the 8 vertices round it, z fastest. */
INLINE int64_t corners_of(const F32 *values, const float *p, float *weight) {
    int64_t base[3];
    float f[3];
    for (int i = 0; i < 3; i++) base[i] = base_of(p[i], values->shape[i]), f[i] = p[i] - (float)base[i];
    for (int c = 0; c < 8; c++)
        weight[c] = (c & 4 ? f[0] : 1 - f[0]) * (c & 2 ? f[1] : 1 - f[1]) * (c & 1 ? f[2] : 1 - f[2]);
    return (base[0] * values->shape[1] + base[1]) * values->shape[2] + base[2];
}

/* Vertex of a corner, from that of the first. */
INLINE int64_t corner(const F32 *values, int64_t first, int c) {
    return first + ((c >> 2) * values->shape[1] + (c >> 1 & 1)) * values->shape[2] + (c & 1);
}
