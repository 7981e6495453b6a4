/* Blocks without the voxels that hold nothing, one behind the other; see PackedBlocks of mapping/blocks.py. */
#pragma once

#include <string.h>

#include "grid_buffers.h"

#define MASK_BYTES (BLOCK_VOXELS / 8)
#define MASK_FLOATS (2 * MASK_BYTES / 4) /* both masks, in units of float32 */

/* The voxels of B blocks: BlockValues of mapping/blocks.py. */
typedef struct {
    F32 tsdf, weight;  /* (B, 512) */
    F32 color;         /* (B, 512, 3) */
    U16 evidence;      /* (B, 512, L) */
    F32 votes;         /* (B, 512) */
} BlockValues;

/* Where the parts of one packed block lie. */
typedef struct {
    uint8_t *measured, *voted;     /* bit masks of 512 bits, of a byte the highest first */
    float *tsdf, *weight, *color;  /* of the voxels that were measured */
    float *votes;                  /* of those with votes */
    uint16_t *evidence;            /* of these, too, the last one padded */
} PackedBlock;

static inline bool in_mask(const uint8_t *mask, int64_t voxel) { return mask[voxel >> 3] >> (7 - (voxel & 7)) & 1; }

static inline int64_t count_mask(const uint8_t *mask) {
    int64_t count = 0;
    for (int i = 0; i < MASK_BYTES; i++) count += __builtin_popcount(mask[i]);
    return count;
}

/* How many float32 a packed block with this many measured and voted voxels takes. */
static inline int64_t packed_floats(int64_t measured, int64_t voted, int64_t classes) {
    return MASK_FLOATS + 5 * measured + voted + (voted * classes + 1) / 2;
}

/* The parts of a packed block with this many measured and voted voxels. */
static inline PackedBlock packed_parts(float *data, int64_t measured, int64_t voted) {
    float *tsdf = data + MASK_FLOATS, *votes = tsdf + 5 * measured;
    uint8_t *masks = (uint8_t *)data;
    return (PackedBlock){masks, masks + MASK_BYTES, tsdf, tsdf + measured, tsdf + 2 * measured,
                         votes, (uint16_t *)(votes + voted)};
}

/* The parts of a packed block as its masks say; false where it has not the size that they ask for. */
static inline bool open_packed(float *data, int64_t floats, int64_t classes, PackedBlock *block) {
    if (floats < MASK_FLOATS) return false;
    int64_t measured = count_mask((uint8_t *)data), voted = count_mask((uint8_t *)data + MASK_BYTES);
    *block = packed_parts(data, measured, voted);
    return floats == packed_floats(measured, voted, classes);
}
