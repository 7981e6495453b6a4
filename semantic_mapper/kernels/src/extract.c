/* Surface points at the zero crossings of the TSDF; see mapping/surface.py. */
#include "grid_buffers.h"

/* Where along the edge from `voxel` to the next along `axis` the TSDF is zero, in [0, 1); -1 = nowhere. `neighbours`
 * are the buffer indices of the blocks at +x, +y, +z, -1 where there is none. */
static double crossing(const GridBuffers *buffers, int64_t block, int voxel, int axis, const int64_t *neighbours,
                       double min_weight) {
    int step = 1 << (3 * axis), position = (voxel >> (3 * axis)) & 7;
    int64_t other_block = position < 7 ? block : neighbours[axis];
    if (other_block < 0) return -1.0;
    int64_t at = block * BLOCK_VOXELS + voxel;
    int64_t other = other_block * BLOCK_VOXELS + (position < 7 ? voxel + step : voxel - 7 * step);
    if (buffers->weight.data[other] < min_weight) return -1.0;
    float here = buffers->tsdf.data[at], there = buffers->tsdf.data[other];
    if ((here > 0) == (there > 0) || fabsf(here - there) > LARGEST_STEP) return -1.0;
    return (double)here / ((double)here - (double)there);
}

typedef struct {
    I32 keys, blocks; /* (B, 3) coordinates and (B,) buffer indices of the blocks to look at */
    BlockIndex index;
    GridBuffers buffers;
    double min_weight; /* both ends of an edge need it */
} Surface;

/* Crossings of the block `n` to look at; writes at most `room` of them to `points`. Returns how many there are. */
static int64_t block_crossings(const Surface *a, int64_t n, int64_t room, double *points) {
    const int32_t *key = a->keys.data + 3 * n;
    int64_t block = a->blocks.data[n], x = key[0], y = key[1], z = key[2], count = 0;
    int64_t neighbours[3] = {
        find_block(&a->index, pack_key(x + 1, y, z)),
        find_block(&a->index, pack_key(x, y + 1, z)),
        find_block(&a->index, pack_key(x, y, z + 1)),
    };
    for (int voxel = 0; voxel < BLOCK_VOXELS; voxel++) {
        int64_t at = block * BLOCK_VOXELS + voxel;
        if (a->buffers.weight.data[at] < a->min_weight || fabsf(a->buffers.tsdf.data[at]) > LARGEST_STEP) continue;
        for (int axis = 0; axis < 3; axis++) {
            double along = crossing(&a->buffers, block, voxel, axis, neighbours, a->min_weight);
            if (along < 0) continue;
            if (count < room) {
                double *point = points + 3 * count;
                for (int i = 0; i < 3; i++)
                    point[i] = (double)((int64_t)key[i] * BLOCK_SIDE + ((voxel >> (3 * i)) & 7)) +
                               (i == axis ? along : 0.0);
            }
            count++;
        }
    }
    return count;
}

typedef struct {
    Surface surface;
    I64 counts; /* (B,) crossings of each block, to fill */
} CountCrossingsArguments;

KERNEL(count_crossings, CountCrossingsArguments) {
    for (int64_t n = start; n < stop; n++) a->counts.data[n] = block_crossings(&a->surface, n, 0, 0);
    return 0;
}

typedef struct {
    Surface surface;
    I64 starts; /* (B + 1,) where the crossings of each block begin in `points` */
    F64 points; /* (N, 3) in voxels, to fill */
} WriteCrossingsArguments;

KERNEL(write_crossings, WriteCrossingsArguments) {
    for (int64_t n = start; n < stop; n++) {
        int64_t first = a->starts.data[n];
        block_crossings(&a->surface, n, a->starts.data[n + 1] - first, a->points.data + 3 * first);
    }
    return 0;
}
