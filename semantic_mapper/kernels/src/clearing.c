/* Blocks that a frame sees through; see mapping/clearing.py. */
#include <string.h>

#include "see_through.h"

#define COARSE 8   /* cells a side of those of `farthest` */
#define CHUNK 1024 /* pixels of a row at a time */

typedef struct {
    F32 depth; /* (H, W) metres */
    double depth_max;
    DepthBounds bounds; /* to fill */
} BoundsArguments;

/* Least and greatest depth of each column of `count` pixels over `rows` rows. */
static void bound_columns(const float *from, int64_t width, int64_t rows, int64_t count, float far, float *restrict least,
                          float *restrict most) {
    for (int64_t x = 0; x < count; x++) least[x] = INFINITY, most[x] = 0.0f;
    for (int64_t y = 0; y < rows; y++) {
        const float *restrict row = from + y * width;
        for (int64_t x = 0; x < count; x++) {
            float z = row[x];
            bool measured = (z > 0) & (z <= far); /* not NaN */
            least[x] = min_f(least[x], measured ? z : INFINITY);
            most[x] = max_f(most[x], measured ? z : 0.0f);
        }
    }
}

/* The first level of `nearest`, and `farthest`. */
static void bound_cells(const BoundsArguments *a) {
    int64_t width = a->depth.shape[1], cell = a->bounds.cell, coarse_columns = a->bounds.farthest.shape[1];
    int64_t rows = a->bounds.nearest.shape[1], columns = a->bounds.nearest.shape[2], at_once = CHUNK / cell;
    float least[CHUNK], most[CHUNK];
    memset(a->bounds.farthest.data, 0, (size_t)(a->bounds.farthest.shape[0] * coarse_columns) * sizeof(float));
    for (int64_t v = 0; v < rows; v++)
        for (int64_t first = 0; first < columns; first += at_once) {
            int64_t count = min_i(at_once, columns - first);
            const float *from = a->depth.data + v * cell * width + first * cell;
            bound_columns(from, width, cell, count * cell, (float)a->depth_max, least, most);
            float *nearest = a->bounds.nearest.data + v * columns + first;
            float *farthest = a->bounds.farthest.data + v / COARSE * coarse_columns;
            for (int64_t u = 0; u < count; u++) {
                float low = least[u * cell], high = most[u * cell];
                for (int64_t x = 1; x < cell; x++)
                    low = min_f(low, least[u * cell + x]), high = max_f(high, most[u * cell + x]);
                int64_t coarse = (first + u) / COARSE;
                nearest[u] = low, farthest[coarse] = max_f(farthest[coarse], high);
            }
        }
}

/* Then each level from the one before. What reaches beyond the last row or column stays: nobody looks at it. */
KERNEL(bound_depth, BoundsArguments) {
    int64_t levels = a->bounds.nearest.shape[0], rows = a->bounds.nearest.shape[1];
    int64_t columns = a->bounds.nearest.shape[2];
    bound_cells(a);
    for (int64_t level = 1; level < levels; level++) {
        int64_t step = (int64_t)1 << (level - 1);
        const float *from = a->bounds.nearest.data + (level - 1) * rows * columns;
        for (int64_t v = 0; v + 2 * step <= rows; v++) {
            const float *up = from + v * columns, *down = up + step * columns;
            float *restrict to = a->bounds.nearest.data + (level * rows + v) * columns;
            for (int64_t u = 0; u + 2 * step <= columns; u++)
                to[u] = min_f(min_f(up[u], up[u + step]), min_f(down[u], down[u + step]));
        }
    }
    return 0;
}

typedef struct {
    I32 keys;      /* (B, 3) */
    U8 considered; /* (B,) 0 = not */
    Camera camera;
    double voxel_size;
    DepthBounds bounds;
    U8 found; /* (B,) to fill */
} BeforeArguments;

/* Pixels from `low` to `high` as cells of `farthest`, clipped; false where there are none. */
static bool to_cells(double low, double high, int64_t pixels, int64_t cells, int64_t *first, int64_t *last) {
    if (!(high >= 0 && low <= (double)(cells * pixels))) return false;
    *first = (int64_t)max_d(low, 0.0) / pixels;
    *last = min_i((int64_t)min_d(high, (double)(cells * pixels)) / pixels, cells - 1);
    return *first <= *last;
}

static bool is_before_depth(const BeforeArguments *a, const int32_t *key) {
    const double *R = a->camera.R.data, *t = a->camera.t.data;
    double side = BLOCK_SIDE * a->voxel_size, middle = 0.5 * (BLOCK_SIDE - 1) * a->voxel_size;
    double x = key[0] * side + middle - t[0], y = key[1] * side + middle - t[1], z = key[2] * side + middle - t[2];
    double depth = R[2] * x + R[5] * y + R[8] * z, radius = 1.7321 * middle;
    if (depth <= -radius) return false;
    double near = depth - radius;
    if (near < a->voxel_size) return true; /* at the camera itself */
    double across = (R[0] * x + R[3] * y + R[6] * z) / depth, down = (R[1] * x + R[4] * y + R[7] * z) / depth;
    double u = a->camera.fx * across + a->camera.cx, v = a->camera.fy * down + a->camera.cy;
    double du = a->camera.fx * radius * (1 + fabs(across)) / near + 1;
    double dv = a->camera.fy * radius * (1 + fabs(down)) / near + 1;
    int64_t pixels = a->bounds.cell * COARSE, width = a->bounds.farthest.shape[1], u0, u1, v0, v1;
    if (!to_cells(u - du, u + du, pixels, width, &u0, &u1)) return false;
    if (!to_cells(v - dv, v + dv, pixels, a->bounds.farthest.shape[0], &v0, &v1)) return false;
    float limit = (float)near + least_margin((float)a->voxel_size), most = 0.0f;
    for (int64_t row = v0; row <= v1; row++)
        for (int64_t column = u0; column <= u1; column++)
            most = max_f(most, a->bounds.farthest.data[row * width + column]);
    return most > limit;
}

KERNEL(blocks_before_depth, BeforeArguments) {
    for (int64_t i = start; i < stop; i++)
        a->found.data[i] = a->considered.data[i] && is_before_depth(a, a->keys.data + 3 * i);
    return 0;
}

typedef struct {
    I32 indices;
    F32 tsdf, weight; /* (capacity, 512) */
    U8 holds;         /* (B,) to fill */
} HoldsArguments;

KERNEL(blocks_hold_surface, HoldsArguments) {
    for (int64_t i = 0; i < a->indices.shape[0]; i++) {
        const float *tsdf = a->tsdf.data + (int64_t)a->indices.data[i] * BLOCK_VOXELS;
        const float *weight = a->weight.data + (int64_t)a->indices.data[i] * BLOCK_VOXELS;
        int32_t count = 0;
        for (int n = 0; n < BLOCK_VOXELS; n++) count += (weight[n] > 0) & (tsdf[n] < LARGEST_CLEARED_TSDF);
        a->holds.data[i] = count > 0;
    }
    return 0;
}

typedef struct {
    I32 indices; /* (B,) buffer indices of blocks, each once */
    GridBuffers buffers;
    Camera camera;
    FusionLimits limits;
    F32 depth; /* (H, W) metres */
    U8 rgb;    /* (H, W, 3) */
    DepthBounds bounds;
    int64_t changes; /* whether to weaken voxels; else they are only counted */
    I64 seen;        /* (B,) to fill: voxels of a surface that are seen through */
    I64 cleared;     /* (B,) to fill: those of them that were cleared */
} ClearArguments;

KERNEL(clear_blocks, ClearArguments) {
    const GridBuffers *buffers = &a->buffers;
    float voxel_size = (float)a->limits.voxel_size, truncation = (float)a->limits.truncation;
    float focal = (float)max_d(a->camera.fx, a->camera.fy), depth_max = (float)a->limits.depth_max;
    VoxelOffsets offsets;
    find_offsets(&a->camera, a->limits.voxel_size, &offsets);
    for (int64_t i = start; i < stop; i++) {
        int64_t block = a->indices.data[i];
        VoxelsInView found;
        int64_t count = look_up_voxels(buffers->keys.data + 3 * block, &offsets, &a->camera, a->limits.voxel_size,
                                       &a->depth, -least_margin(voxel_size), depth_max, &found);
        a->seen.data[i] = a->cleared.data[i] = 0;
        for (int64_t k = 0; k < count; k++) {
            int64_t at = block * BLOCK_VOXELS + found.voxel[k], pixel = found.pixel[k];
            float tsdf = buffers->tsdf.data[at];
            if (!(tsdf < LARGEST_CLEARED_TSDF && buffers->weight.data[at] > 0)) continue;
            float z = a->depth.data[pixel] - found.distance[k];
            if (!sees_through(&a->bounds, &a->depth, depth_max, focal, voxel_size, truncation, pixel, z, tsdf)) continue;
            a->seen.data[i]++;
            if (a->changes) a->cleared.data[i] += weaken(buffers, at, a->rgb.data + 3 * pixel);
        }
    }
    return 0;
}
