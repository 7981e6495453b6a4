/* Which voxels the surface passes, and where; see queries/surface.py. */
#pragma once

#include "snapshot.h"

#define LARGEST_STEPS 120 /* two neighbours that differ by more straddle a depth edge */
#define NEAREST_STEPS 60  /* half of it: farther from zero, a voxel is the nearer end of no crossing */

/* Slots of the blocks at -x, +x, -y, +y, -z, +z of a block, -1 where there is none. */
static inline void neighbour_slots(const BlockIndex *index, int64_t x, int64_t y, int64_t z, int64_t *near) {
    near[0] = find_block(index, pack_key(x - 1, y, z)), near[1] = find_block(index, pack_key(x + 1, y, z));
    near[2] = find_block(index, pack_key(x, y - 1, z)), near[3] = find_block(index, pack_key(x, y + 1, z));
    near[4] = find_block(index, pack_key(x, y, z - 1)), near[5] = find_block(index, pack_key(x, y, z + 1));
}

/* Whether a voxel is one of the surface; `offset` (3,) then leads from its centre to its surface point, in units of
 * voxels. `near` (6,) comes from neighbour_slots of its block. */
static inline bool surface_offset(const BlockVoxels *voxels, int64_t slot, int64_t voxel, const int64_t *near,
                                  double *offset) {
    const int8_t *tsdf = voxels->tsdf.data;
    const uint8_t *weight = voxels->weight.data;
    int64_t a = tsdf[slot * BLOCK_VOXELS + voxel];
    if (weight[slot * BLOCK_VOXELS + voxel] == 0 || a > NEAREST_STEPS || a < -NEAREST_STEPS) return false;
    int crossings = 0;
    offset[0] = offset[1] = offset[2] = 0.0;
    for (int face = 0; face < 6; face++) {
        int axis = face >> 1, upper = face & 1;
        int64_t position = (voxel >> 3 * axis) & 7, step = upper ? 1 << 3 * axis : -(1 << 3 * axis);
        bool inside = upper ? position < 7 : position > 0;
        int64_t block = inside ? slot : near[face];
        if (block < 0) continue;
        int64_t other = block * BLOCK_VOXELS + (inside ? voxel + step : voxel - 7 * step);
        if (weight[other] == 0) continue;
        int64_t b = tsdf[other];
        if ((a > 0) == (b > 0) || a - b > LARGEST_STEPS || b - a > LARGEST_STEPS) continue;
        double along = (double)a / (double)(a - b);
        if (along < 0.5 || (along == 0.5 && upper)) {
            offset[axis] += upper ? along : -along;
            crossings++;
        }
    }
    if (crossings == 0) return false;
    for (int axis = 0; axis < 3; axis++) offset[axis] /= crossings;
    return true;
}

/* Surface point (3,) of a voxel of block (x, y, z), units of voxels. */
static inline void surface_point(int64_t x, int64_t y, int64_t z, int64_t voxel, const double *offset, double *point) {
    point[0] = (double)(x * 8 + (voxel & 7)) + offset[0];
    point[1] = (double)(y * 8 + ((voxel >> 3) & 7)) + offset[1];
    point[2] = (double)(z * 8 + (voxel >> 6)) + offset[2];
}
