/* Which voxels of a block a frame says something of; shared by fusion.c, clearing.c and virtual_votes.c. */
#pragma once

#include "camera.h"
#include "evidence.h"

/* Lengths in metres, and the cap of weights and votes: FusionLimits of mapping/fusion.py. */
typedef struct {
    double voxel_size, truncation, depth_max, vote_band, max_weight;
} FusionLimits;

/* What a frame says of classes: Votes of mapping/fusion.py. */
typedef struct {
    U16 evidence; /* (K, L) */
    I32 rows;     /* (H, W) which of them a pixel takes, where its weight is > 0 */
    F32 weights;  /* (H, W) 0 to 1 */
} Votes;

/* Camera coordinates of the voxels of a block from its first one, metres. */
typedef struct {
    float x[BLOCK_VOXELS], y[BLOCK_VOXELS], z[BLOCK_VOXELS];
} VoxelOffsets;

/* The voxels that were found: of each, which one it is, its pixel, and its signed distance along z in metres, positive
 * in front of the surface. */
typedef struct {
    int32_t voxel[BLOCK_VOXELS], pixel[BLOCK_VOXELS];
    float distance[BLOCK_VOXELS];
} VoxelsInView;

static inline void find_offsets(const Camera *camera, double voxel_size, VoxelOffsets *offsets) {
    const double *R = camera->R.data;
    for (int n = 0; n < BLOCK_VOXELS; n++) {
        double x = (n & 7) * voxel_size, y = ((n >> 3) & 7) * voxel_size, z = (n >> 6) * voxel_size;
        offsets->x[n] = (float)(R[0] * x + R[3] * y + R[6] * z);
        offsets->y[n] = (float)(R[1] * x + R[4] * y + R[7] * z);
        offsets->z[n] = (float)(R[2] * x + R[5] * y + R[8] * z);
    }
}

/* Voxels inside the image, where there is depth up to `depth_max`, and at most `behind` metres behind it. `key` is the
 * block's, `depth` (H, W) float32 metres. Returns how many. */
static inline int64_t look_up_voxels(const int32_t *key, const VoxelOffsets *offsets, const Camera *camera,
                                     double voxel_size, const F32 *depth, float behind, float depth_max,
                                     VoxelsInView *found) {
    const double *R = camera->R.data, *t = camera->t.data;
    double side = BLOCK_SIDE * voxel_size;
    double x = key[0] * side - t[0], y = key[1] * side - t[1], z = key[2] * side - t[2];
    float x0 = (float)(R[0] * x + R[3] * y + R[6] * z);
    float y0 = (float)(R[1] * x + R[4] * y + R[7] * z);
    float z0 = (float)(R[2] * x + R[5] * y + R[8] * z);
    float fx = (float)camera->fx, fy = (float)camera->fy;
    float cx = (float)camera->cx + 0.5f, cy = (float)camera->cy + 0.5f; /* truncation then rounds to the pixel */
    float right = (float)depth->shape[1], bottom = (float)depth->shape[0];
    int32_t width = (int32_t)depth->shape[1], at[BLOCK_VOXELS];
    float depths[BLOCK_VOXELS];
    for (int n = 0; n < BLOCK_VOXELS; n++) { /* without branches, for eight at a time */
        float zc = z0 + offsets->z[n], inverse = 1.0f / zc;
        float u = fx * (x0 + offsets->x[n]) * inverse + cx, v = fy * (y0 + offsets->y[n]) * inverse + cy;
        bool inside = (zc > 0) & (u >= 0) & (v >= 0) & (u < right) & (v < bottom);
        at[n] = inside ? (int32_t)v * width + (int32_t)u : -1;
        depths[n] = zc;
    }
    int64_t count = 0;
    for (int n = 0; n < BLOCK_VOXELS; n++) { /* what counts stays, what does not is written over by the next */
        float d = depth->data[at[n] > 0 ? at[n] : 0], distance = d - depths[n];
        found->voxel[count] = n, found->pixel[count] = at[n], found->distance[count] = distance;
        count += (at[n] >= 0) & (d > 0) & (d <= depth_max) & (distance >= -behind);
    }
    return count;
}
