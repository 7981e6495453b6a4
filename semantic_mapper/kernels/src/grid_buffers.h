/* The memory of the voxel grid; see mapping/block_grid.py. */
#pragma once

#include "block_index.h"

#define BLOCK_SIDE 8
#define BLOCK_VOXELS 512
#define MAX_CLASSES 256   /* class ids are bytes */
#define LARGEST_STEP 0.95 /* of the TSDF: two neighbours that differ by more straddle a depth edge, not a surface */

/* Weights of mapping/fusion.py: from the first on a surface was measured, up to the second computed. */
#define MEASURED 1.0f
#define COMPUTED_CAP (31.0f / 32.0f)

typedef struct {
    I32 keys;          /* (capacity, 3) block coordinates */
    F32 tsdf;          /* (capacity, 512) signed distance over truncation, -1 to 1 */
    F32 weight;        /* (capacity, 512) */
    F32 color;         /* (capacity, 512, 3) 0 to 255 */
    U16 evidence;      /* (capacity, 512, L) mean of what votes say; see evidence.h */
    F32 votes;         /* (capacity, 512) */
} GridBuffers;

/* Key of the block that a voxel of the world lies in, and which one of the block it is. */
static inline int64_t key_of_voxel(int64_t x, int64_t y, int64_t z) { return pack_key(x >> 3, y >> 3, z >> 3); }
static inline int64_t voxel_in_block(int64_t x, int64_t y, int64_t z) {
    return ((z & 7) << 6) | ((y & 7) << 3) | (x & 7);
}
