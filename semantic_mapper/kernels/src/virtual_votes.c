/* Class votes of virtual views, which measure nothing; see mapping/virtual_views.py. */
#include "voxel_lookup.h"

typedef struct {
    I32 indices; /* (B,) buffer indices of blocks, each once */
    GridBuffers buffers;
    Camera camera;
    FusionLimits limits;
    F32 depth; /* (H, W) metres */
    Votes votes;
    double max_votes; /* voxels with this many take none */
} VoteArguments;

/* As fuse_block of fusion.c votes, at voxels that a frame has measured before. */
static void vote_block(const VoteArguments *a, int64_t block, const VoxelOffsets *offsets) {
    const GridBuffers *buffers = &a->buffers;
    const int32_t *key = buffers->keys.data + 3 * block;
    float band = (float)a->limits.vote_band, cap = (float)a->limits.max_weight, max_votes = (float)a->max_votes;
    int64_t classes = a->votes.evidence.shape[1];
    VoxelsInView found;
    int64_t count = look_up_voxels(key, offsets, &a->camera, a->limits.voxel_size, &a->depth, band,
                                   (float)a->limits.depth_max, &found);
    for (int64_t k = 0; k < count; k++) {
        int64_t voxel = found.voxel[k], pixel = found.pixel[k], at = block * BLOCK_VOXELS + voxel;
        float weight = a->votes.weights.data[pixel];
        if (weight <= 0 || fabsf(found.distance[k]) > band) continue;
        if (buffers->weight.data[at] > 0 && buffers->votes.data[at] < max_votes)
            add_vote(buffers, at, a->votes.evidence.data + a->votes.rows.data[pixel] * classes, weight, cap);
    }
}

KERNEL(vote_into_blocks, VoteArguments) {
    VoxelOffsets offsets;
    find_offsets(&a->camera, a->limits.voxel_size, &offsets);
    for (int64_t i = start; i < stop; i++) vote_block(a, a->indices.data[i], &offsets);
    return 0;
}
