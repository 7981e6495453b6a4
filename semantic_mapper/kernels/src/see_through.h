/* Which voxels of a surface a frame sees through, and what becomes of them; see mapping/clearing.py. */
#pragma once

#include <string.h>

#include "voxel_lookup.h"

#define LARGEST_CLEARED_TSDF 0.5f /* of a voxel that is part of a surface */
#define MARGIN_VOXELS 2.0f
#define MARGIN_PER_M 0.015f
#define ASIDE_VOXELS 1.4f
#define ASIDE_PER_M 0.005f
#define MOST_HOLES 2
#define MOST_KEPT 3.5f

/* Least and greatest depths of a frame: DepthBounds of mapping/clearing.py. */
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
    float right = cell * (float)width_cells - 1, bottom = cell * (float)height_cells - 1;
    float border = focal * ASIDE_PER_M + 1; /* nearer to the edge of the image it may as well be outside */
    if (!(x >= border && y >= border && x <= right - border && y <= bottom - border)) return false;
    int64_t u0 = (int64_t)(max_f(x - aside, 0.0f) / cell), u1 = (int64_t)(min_f(x + aside, right) / cell);
    int64_t v0 = (int64_t)(max_f(y - aside, 0.0f) / cell), v1 = (int64_t)(min_f(y + aside, bottom) / cell);
    int level = 63 - __builtin_clzll((unsigned long long)(min_i(u1 - u0, v1 - v0) + 1));
    if (level >= bounds->nearest.shape[0]) return false;
    int64_t side = (int64_t)1 << level;
    const float *nearest = bounds->nearest.data + level * height_cells * width_cells;
    float least = INFINITY; /* two by two squares, or three along the edge of the image, which overlap */
    for (int64_t v = v0; v <= v1; v += side)
        for (int64_t u = u0; u <= u1; u += side)
            least = min_f(least, nearest[min_i(v, v1 + 1 - side) * width_cells + min_i(u, u1 + 1 - side)]);
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
    int64_t classes = buffers->evidence.shape[2];
    buffers->tsdf.data[at] = 1.0f;
    buffers->weight.data[at] = MEASURED;
    for (int c = 0; c < 3; c++) buffers->color.data[3 * at + c] = rgb[c];
    buffers->votes.data[at] = 0.0f;
    memset(buffers->evidence.data + at * classes, 0, (size_t)classes * sizeof(uint16_t));
    return true;
}
