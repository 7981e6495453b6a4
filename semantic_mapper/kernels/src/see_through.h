/* Which voxels of a surface a frame sees through, and what becomes of them; see mapping/fusion/clearing.py. */
#pragma once

#include <string.h>

#include "voxel_lookup.h"

#define LARGEST_CLEARED_TSDF 0.5f /* of a voxel that is part of a surface; of mapping/fusion/clearing.py, as the next */
#define MARGIN_VOXELS 2.0f
#define MARGIN_PER_M 0.015f
#define ASIDE_VOXELS 1.4f
#define ASIDE_PER_M 0.005f
#define MOST_HOLES 2
#define MOST_KEPT 3.5f

/* Least and greatest depths of a frame: DepthBounds of mapping/fusion/clearing.py. */
typedef struct {
    F32 nearest;  /* (levels, h, w) metres, of 2^level x 2^level cells from each one on; inf = no depth */
    F32 farthest; /* (h / 8, w / 8), rounded up: of 8 x 8 cells */
    int64_t cell; /* pixels a side */
} DepthBounds;

static inline float least_margin(float voxel_size) { return MARGIN_VOXELS * voxel_size; }

/* Whether of a pixel, not at the edge of the image, and the eight around it at most MOST_HOLES were not measured. */
static inline bool is_surely_measured(const F32 *depth, int64_t pixel, float depth_max) {
    int64_t width = depth->shape[1];
    int holes = 0;
    for (int64_t v = -1; v <= 1; v++)
        for (int64_t u = -1; u <= 1; u++) {
            float z = depth->data[pixel + v * width + u];
            holes += !((z > 0) & (z <= depth_max)); /* NaN, too */
        }
    return holes <= MOST_HOLES;
}

/* Whether the thing that a voxel is part of, at depth `z` (metres) and seen at a pixel, cannot be there: all that is
 * seen around it, as far as voxel and pose may be off, lies well behind. */
static inline bool sees_through(const DepthBounds *bounds, const F32 *depth, float depth_max, float focal,
                                float voxel_size, float truncation, int64_t pixel, float z, float tsdf) {
    int64_t width = depth->shape[1];
    float cell = (float)bounds->cell, y = (float)(pixel / width), x = (float)(pixel % width);
    float aside = focal * (ASIDE_VOXELS * voxel_size / z + ASIDE_PER_M);
    int64_t height_cells = bounds->nearest.shape[1], width_cells = bounds->nearest.shape[2];
    float left = x - aside, top = y - aside;
    if (!(left >= 1 && top >= 1 && x + aside < cell * (float)width_cells - 1 && y + aside < cell * (float)height_cells - 1))
        return false;
    int64_t u0 = (int64_t)(left / cell), u1 = (int64_t)((x + aside) / cell);
    int64_t v0 = (int64_t)(top / cell), v1 = (int64_t)((y + aside) / cell);
    int level = 63 - __builtin_clzll((unsigned long long)(min_i(u1 - u0, v1 - v0) + 1));
    if (level >= bounds->nearest.shape[0]) return false;
    u1 = max_i(u1 + 1 - ((int64_t)1 << level), u0), v1 = max_i(v1 + 1 - ((int64_t)1 << level), v0);
    const float *nearest = bounds->nearest.data + level * height_cells * width_cells;
    float least = min_f(min_f(nearest[v0 * width_cells + u0], nearest[v0 * width_cells + u1]),
                        min_f(nearest[v1 * width_cells + u0], nearest[v1 * width_cells + u1]));
    float limit = z + max_f(tsdf, 0.0f) * truncation + least_margin(voxel_size) + MARGIN_PER_M * z;
    return least > limit && is_surely_measured(depth, pixel, depth_max);
}

/* Halves the weight of a voxel that is seen through; true where nothing is left: it is free then, and has no class. */
static inline bool weaken(const GridBuffers *buffers, int64_t at, const uint8_t *rgb) {
    float kept = min_f(0.5f * buffers->weight.data[at], MOST_KEPT);
    if (kept >= MEASURED) {
        buffers->weight.data[at] = kept;
        return false;
    }
    int64_t classes = buffers->evidence.shape[2], bytes = classes * buffers->evidence.itemsize;
    buffers->tsdf.data[at] = 1.0f;
    buffers->weight.data[at] = MEASURED;
    for (int c = 0; c < 3; c++) buffers->color.data[3 * at + c] = rgb[c];
    buffers->votes.data[at] = 0.0f;
    memset((uint8_t *)buffers->evidence.data + at * bytes, 0, (size_t)bytes);
    return true;
}
