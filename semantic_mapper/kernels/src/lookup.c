/* The surface nearest to points, where it is near; see queries/nearest.py. */
#include "surface.h"

typedef struct {
    F64 points;    /* (N, 3) units of voxels */
    double radius; /* how far to look, voxels */
    BlockIndex index;
    BlockVoxels voxels;
    I64 slots;     /* (N,) out: -1 = no surface near */
    I64 chosen;    /* (N,) out: voxel of the block */
    F64 distances; /* (N,) out: voxels; infinity = no surface near */
} NearestArguments;

static double square(double x) { return x * x; }

static void find_nearest(const NearestArguments *a, int64_t n) {
    const double *p = a->points.data + 3 * n;
    double reach = a->radius + 0.5; /* a surface point is at most half a voxel from its voxel's centre */
    double best = a->radius * a->radius, offset[3];
    int64_t last_key = EMPTY_KEY, slot = -1, near[6], low[3], high[3];
    a->slots.data[n] = -1, a->chosen.data[n] = 0, a->distances.data[n] = INFINITY;
    for (int axis = 0; axis < 3; axis++) {
        low[axis] = to_int(ceil(p[axis] - reach));
        high[axis] = floor_int(p[axis] + reach);
    }
    for (int64_t z = low[2]; z <= high[2]; z++) {
        for (int64_t y = low[1]; y <= high[1]; y++) {
            for (int64_t x = low[0]; x <= high[0]; x++) {
                int64_t key = key_of_voxel(x, y, z);
                if (key != last_key) {
                    last_key = key, slot = find_block(&a->index, key);
                    if (slot >= 0) neighbour_slots(&a->index, x >> 3, y >> 3, z >> 3, near);
                }
                if (slot < 0) continue;
                int64_t voxel = voxel_in_block(x, y, z);
                if (!surface_offset(&a->voxels, slot, voxel, near, offset)) continue;
                double d = square((double)x + offset[0] - p[0]) + square((double)y + offset[1] - p[1]) +
                           square((double)z + offset[2] - p[2]);
                if (d < best || (d == best && a->slots.data[n] < 0)) {
                    best = d;
                    a->slots.data[n] = slot, a->chosen.data[n] = voxel, a->distances.data[n] = sqrt(d);
                }
            }
        }
    }
}

KERNEL(find_nearest_voxels, NearestArguments) {
    for (int64_t n = 0; n < a->points.shape[0]; n++) find_nearest(a, n);
    return 0;
}
