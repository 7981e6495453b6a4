/* The surface of a map in patches of one block; see mapping/virtual_views.py. */
#include "readout.h"

typedef struct {
    I32 keys, blocks; /* (B, 3) coordinates and (B,) buffer indices */
    GridBuffers buffers;
    double near; /* |TSDF| of the voxels that belong to the surface, at most */
    double vote_discount;
    double max_votes; /* voxels with this many need none */
    F64 total;        /* (B, 3) zeros; sum of positions in voxels */
    F64 need;         /* (B,) zeros */
    I64 count;        /* (B,) zeros; surface voxels */
} SumPatchesArguments;

KERNEL(sum_surface_patches, SumPatchesArguments) {
    const GridBuffers *buffers = &a->buffers;
    int64_t classes = buffers->evidence.shape[2];
    for (int64_t n = start; n < stop; n++) {
        for (int64_t voxel = 0; voxel < BLOCK_VOXELS; voxel++) {
            int64_t at = a->blocks.data[n] * (int64_t)BLOCK_VOXELS + voxel;
            if (buffers->weight.data[at] <= 0 || fabsf(buffers->tsdf.data[at]) > a->near) continue;
            double votes = buffers->votes.data[at], confidence;
            if (votes < a->max_votes) {
                decide_stored(buffers->evidence.data + at * classes, classes, votes, a->vote_discount, 0.0, &confidence);
                a->need.data[n] += (1.0 - confidence) / (1.0 + votes);
            }
            for (int axis = 0; axis < 3; axis++)
                a->total.data[3 * n + axis] +=
                    (double)((int64_t)a->keys.data[3 * n + axis] * BLOCK_SIDE + ((voxel >> (3 * axis)) & 7));
            a->count.data[n]++;
        }
    }
    return 0;
}
