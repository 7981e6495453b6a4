/* Packing of blocks; see mapping/blocks.py. */
#include "packed_blocks.h"

typedef struct {
    F32 weight, votes; /* (capacity, 512) */
    I32 rows;          /* (B,) blocks to pack */
    I64 ends;          /* (B + 1,) to fill: where packed blocks begin and end, in float32 */
    int64_t classes;
} PackedEndsArguments;

KERNEL(packed_block_ends, PackedEndsArguments) {
    a->ends.data[0] = 0;
    for (int64_t n = 0; n < a->rows.shape[0]; n++) {
        const float *weight = a->weight.data + (int64_t)a->rows.data[n] * BLOCK_VOXELS;
        const float *votes = a->votes.data + (int64_t)a->rows.data[n] * BLOCK_VOXELS;
        int32_t measured = 0, voted = 0;
        for (int voxel = 0; voxel < BLOCK_VOXELS; voxel++) {
            measured += weight[voxel] > 0;
            voted += votes[voxel] > 0;
        }
        a->ends.data[n + 1] = a->ends.data[n] + packed_floats(measured, voted, a->classes);
    }
    return 0;
}

/* Bit masks (64,) of the voxels whose value is positive; returns how many. */
static int64_t write_mask(const float *values, uint8_t *mask) {
    for (int byte = 0; byte < MASK_BYTES; byte++) {
        uint8_t bits = 0;
        for (int bit = 0; bit < 8; bit++) bits = (uint8_t)(bits << 1 | (values[8 * byte + bit] > 0));
        mask[byte] = bits;
    }
    return count_mask(mask);
}

typedef struct {
    BlockValues values;
    I32 rows; /* (B,) blocks to pack */
    I64 ends; /* (B + 1,) of packed_block_ends */
    F32 data; /* (N,) zeros, to fill */
} PackArguments;

KERNEL(pack_block_values, PackArguments) {
    const BlockValues *values = &a->values;
    int64_t classes = values->evidence.shape[2];
    for (int64_t n = 0; n < a->rows.shape[0]; n++) {
        int64_t first = (int64_t)a->rows.data[n] * BLOCK_VOXELS;
        float *data = a->data.data + a->ends.data[n];
        int64_t measured = write_mask(values->weight.data + first, (uint8_t *)data);
        int64_t voted = write_mask(values->votes.data + first, (uint8_t *)data + MASK_BYTES);
        PackedBlock block = packed_parts(data, measured, voted);
        for (int64_t voxel = 0; voxel < BLOCK_VOXELS; voxel++) {
            int64_t at = first + voxel;
            if (in_mask(block.measured, voxel)) {
                *block.tsdf++ = values->tsdf.data[at];
                *block.weight++ = values->weight.data[at];
                for (int c = 0; c < 3; c++) *block.color++ = values->color.data[3 * at + c];
            }
            if (in_mask(block.voted, voxel)) {
                memcpy(block.evidence, values->evidence.data + at * classes, (size_t)classes * sizeof(uint16_t));
                *block.votes++ = values->votes.data[at];
                block.evidence += classes;
            }
        }
    }
    return 0;
}

typedef struct {
    F32 data; /* (N,) packed blocks */
    I64 ends; /* (B + 1,) where they begin and end */
    BlockValues values;
    I64 rows; /* (B,) of the blocks to fill, whose voxels are all zero */
} UnpackArguments;

/* Returns how many were unpacked: fewer than B where the data of the next are no packed block of this many classes. */
KERNEL(unpack_block_values, UnpackArguments) {
    const BlockValues *values = &a->values;
    int64_t classes = values->evidence.shape[2];
    for (int64_t n = 0; n < a->rows.shape[0]; n++) {
        PackedBlock block;
        int64_t begin = a->ends.data[n], end = a->ends.data[n + 1];
        if (!open_packed(a->data.data + begin, end - begin, classes, &block)) return n;
        for (int64_t voxel = 0; voxel < BLOCK_VOXELS; voxel++) {
            int64_t at = a->rows.data[n] * BLOCK_VOXELS + voxel;
            if (in_mask(block.measured, voxel)) {
                values->tsdf.data[at] = *block.tsdf++;
                values->weight.data[at] = *block.weight++;
                for (int c = 0; c < 3; c++) values->color.data[3 * at + c] = *block.color++;
            }
            if (in_mask(block.voted, voxel)) {
                memcpy(values->evidence.data + at * classes, block.evidence, (size_t)classes * sizeof(uint16_t));
                values->votes.data[at] = *block.votes++;
                block.evidence += classes;
            }
        }
    }
    return a->rows.shape[0];
}
