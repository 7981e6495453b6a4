/* Free, occupied or unknown voxels; see queries/occupancy.py. */
#include "snapshot.h"

typedef enum { UNKNOWN, FREE, OCCUPIED } State;

static State state_of(const BlockVoxels *voxels, double voxels_per_step, int64_t slot, int64_t x, int64_t y,
                      int64_t z) {
    if (slot < 0) return UNKNOWN;
    int64_t at = slot * BLOCK_VOXELS + voxel_in_block(x, y, z);
    if (!voxels->weight.data[at]) return UNKNOWN;
    return voxels->tsdf.data[at] * voxels_per_step <= 0.5 ? OCCUPIED : FREE;
}

typedef struct {
    I64 places; /* (N, 3) coordinates of voxels */
    BlockIndex index;
    BlockVoxels voxels;
    double voxels_per_step; /* length of one step of the TSDF */
    U8 states;              /* (N,) out */
} ReadStatesArguments;

KERNEL(read_voxel_states, ReadStatesArguments) {
    for (int64_t n = 0; n < a->places.shape[0]; n++) {
        int64_t x = a->places.data[3 * n], y = a->places.data[3 * n + 1], z = a->places.data[3 * n + 2];
        int64_t slot = find_block(&a->index, key_of_voxel(x, y, z));
        a->states.data[n] = (uint8_t)state_of(&a->voxels, a->voxels_per_step, slot, x, y, z);
    }
    return 0;
}

typedef struct {
    I64 first; /* (3,) voxel [0, 0, 0] of the box */
    BlockIndex index;
    BlockVoxels voxels;
    double voxels_per_step;
    U8 states; /* (X, Y, Z) out */
} FillBoxArguments;

KERNEL(fill_box_states, FillBoxArguments) {
    for (int64_t i = 0; i < a->states.shape[0]; i++) {
        for (int64_t j = 0; j < a->states.shape[1]; j++) {
            int64_t x = a->first.data[0] + i, y = a->first.data[1] + j, depth = a->states.shape[2], last = 0, slot = -1;
            uint8_t *states = a->states.data + (i * a->states.shape[1] + j) * depth;
            for (int64_t k = 0; k < depth; k++) {
                int64_t z = a->first.data[2] + k;
                if (k == 0 || z >> 3 != last) last = z >> 3, slot = find_block(&a->index, key_of_voxel(x, y, z));
                states[k] = (uint8_t)state_of(&a->voxels, a->voxels_per_step, slot, x, y, z);
            }
        }
    }
    return 0;
}
