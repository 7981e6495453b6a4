/* Fusion of one frame: TSDF, color and class evidence in one pass; see mapping/fusion.py. */
#include <string.h>

#include "see_through.h"

#define PROBABILITY_FLOOR 1e-4f /* of mapping/fusion.py */
#define FULL_TRUST_RANGE_M 2.0f /* of mapping/fusion.py, as the next */
#define LEAST_COSINE 0.2f
#define AHEAD 16 /* voxels */
#define CACHE_LINE 64

typedef struct {
    F32 probabilities; /* (K, L) */
    U16 evidence;      /* (K, L) to fill */
    U8 proper;         /* (K,) bool to fill */
} EvidenceArguments;

/* What rows say as evidence, and whether each is of numbers that are not negative and sum to 1. */
KERNEL(evidence_of_rows, EvidenceArguments) {
    int64_t classes = a->probabilities.shape[1];
    float all[MOST_CLASSES + LANES] = {0};
    uint16_t steps[MOST_CLASSES + LANES];
    for (int64_t n = start; n < stop; n++) {
        const float *row = a->probabilities.data + n * classes;
        float least = 0.0f;
        double total = 0.0;
        for (int64_t c = 0; c < classes; c++) total += row[c], least = min_f(least, row[c]);
        memcpy(all, row, (size_t)classes * sizeof *all);
        for (int64_t c = 0; c < classes; c += LANES) {
            Lanes p = larger(splat(PROBABILITY_FLOOR), load(all + c));
            Lanes logs = EVIDENCE_STEPS * log_of(p > 1.0f ? splat(1) : p);
            ShortLanes said = __builtin_convertvector(__builtin_convertvector(0.5f - logs, IntLanes), ShortLanes);
            memcpy(steps + c, &said, sizeof said);
        }
        memcpy(a->evidence.data + n * classes, steps, (size_t)classes * sizeof *steps);
        a->proper.data[n] = fabs(total - 1.0) < 1e-2 && least >= 0;
    }
    return 0;
}

/* Nearness of a look, 0 where the depth is no measurement. */
static inline float near_weight(float z, float far) {
    float near = FULL_TRUST_RANGE_M / z, weight = min_f(near * near, 1.0f);
    return ((z > 0) & (z <= far)) ? weight : 0.0f;
}

/* Vote weights of row v (W,): |cos| between ray and surface normal, from four neighbours, and nearness. */
static void weigh_row(const F32 *depth, int64_t v, const Camera *camera, float far, float *restrict weights) {
    int64_t height = depth->shape[0], width = depth->shape[1], last = width - 1;
    const float *row = depth->data + v * width;
    const float *up = depth->data + max_i(v - 1, 0) * width, *down = depth->data + min_i(v + 1, height - 1) * width;
    float least_known = 0 < v && v < height - 1 ? LEAST_COSINE : INFINITY; /* the first and last row lack a neighbour */
    float fx = (float)camera->fx, fy = (float)camera->fy, cx = (float)camera->cx;
    float y = ((float)v - (float)camera->cy) / fy;
    for (int64_t u = 1; u < last; u++) { /* without branches, for eight at a time */
        float x = ((float)(int32_t)u - cx) / fx, z = row[u], left = row[u - 1], right = row[u + 1];
        /* With slopes dz/du, dz/dv the normal is (fx dz/du, fy dz/dv, -(z + x fx dz/du + y fy dz/dv)), unnormalised;
         * its product with the ray (x, y, 1) is -z. */
        float nx = fx * 0.5f * (right - left), ny = fy * 0.5f * (down[u] - up[u]);
        float nz = z + x * nx + y * ny;
        float cosine = z / sqrtf((nx * nx + ny * ny + nz * nz) * (x * x + y * y + 1.0f));
        bool known = (left > 0) & (right > 0) & (up[u] > 0) & (down[u] > 0) & (cosine > least_known);
        float near = FULL_TRUST_RANGE_M / z, weight = (known ? cosine : LEAST_COSINE) * min_f(near * near, 1.0f);
        weights[u] = ((z > 0) & (z <= far)) ? weight : 0.0f;
    }
    weights[0] = LEAST_COSINE * near_weight(row[0], far);
    weights[last] = LEAST_COSINE * near_weight(row[last], far);
}

typedef struct {
    F32 depth; /* (H, W) metres */
    I32 rows;  /* (H, W), -1 = unknown */
    U8 proper; /* (K,) bool, of evidence_of_rows */
    Camera camera;
    double depth_max; /* metres */
    F32 weights;      /* (H, W) to fill */
    I64 bad;          /* (H,) to fill: known pixels of each row of the image whose probabilities are not proper */
} VoteWeightsArguments;

KERNEL(vote_weights, VoteWeightsArguments) {
    int64_t width = a->depth.shape[1];
    bool all_proper = !memchr(a->proper.data, 0, (size_t)a->proper.shape[0]); /* as a rule */
    for (int64_t v = start; v < stop; v++) {
        float *restrict weights = a->weights.data + v * width;
        weigh_row(&a->depth, v, &a->camera, (float)a->depth_max, weights);
        const int32_t *rows = a->rows.data + v * width;
        for (int64_t u = 0; u < width; u++) weights[u] = rows[u] < 0 ? 0.0f : weights[u];
        a->bad.data[v] = 0;
        for (int64_t u = 0; u < width && !all_proper; u++) {
            if (rows[u] < 0 || a->proper.data[rows[u]]) continue;
            a->bad.data[v] += weights[u] > 0;
            weights[u] = 0.0f;
        }
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
    F32 trust; /* (H, W) fraction of `look` that each depth weighs, or (0, 0): 1 */
    Votes votes;
    double look, weight_cap; /* what one depth weighs, and what all of its kind together may */
    DepthBounds bounds;      /* of the depth; no levels: nothing is cleared */
    I64 cleared;             /* (B,) to fill: voxels of a surface that were cleared */
} FuseArguments;

/* Ask for what voxel k of `found` will need: blocks lie in no order, and pixels are far apart. It saves a fifth. */
INLINE void fetch_ahead(const FuseArguments *a, int64_t block, const VoxelsInView *found, int64_t k) {
    int64_t at = block * BLOCK_VOXELS + found->voxel[k], pixel = found->pixel[k];
    __builtin_prefetch(a->rgb.data + 3 * pixel);
    __builtin_prefetch(a->votes.weights.data + pixel);
    __builtin_prefetch(a->votes.rows.data + pixel);
    __builtin_prefetch(a->buffers.tsdf.data + at, 1);
    __builtin_prefetch(a->buffers.weight.data + at, 1);
    __builtin_prefetch(a->buffers.color.data + 3 * at, 1);
    __builtin_prefetch(a->buffers.votes.data + at, 1);
}

/* The same of its evidence, once its row of the table is there. */
INLINE void fetch_evidence(const FuseArguments *a, int64_t block, const VoxelsInView *found, int64_t k, float band) {
    if (fabsf(found->distance[k]) > band) return;
    int64_t classes = a->votes.evidence.shape[1], row = a->votes.rows.data[found->pixel[k]];
    const char *own = (const char *)(a->buffers.evidence.data + (block * BLOCK_VOXELS + found->voxel[k]) * classes);
    const char *said = (const char *)(a->votes.evidence.data + max_i(row, 0) * classes);
    for (int64_t at = 0; at < 2 * classes + CACHE_LINE - 1; at += CACHE_LINE) {
        __builtin_prefetch(own + at, 1);
        __builtin_prefetch(said + at);
    }
}

/* Returns how many voxels were cleared. */
static int64_t fuse_block(const FuseArguments *a, int64_t block, const VoxelOffsets *offsets) {
    const GridBuffers *buffers = &a->buffers;
    const int32_t *key = buffers->keys.data + 3 * block;
    float truncation = (float)a->limits.truncation, band = (float)a->limits.vote_band;
    float cap = (float)a->limits.max_weight;
    float look = (float)a->look, weight_cap = (float)a->weight_cap;
    float focal = (float)max_d(a->camera.fx, a->camera.fy), voxel_size = (float)a->limits.voxel_size;
    float margin = least_margin(voxel_size);
    bool weighted = a->trust.shape[0] > 0, clears = a->bounds.nearest.shape[0] > 0;
    int64_t cleared = 0;
    int64_t classes = a->votes.evidence.shape[1];
    VoxelsInView found;
    int64_t count = look_up_voxels(key, offsets, &a->camera, a->limits.voxel_size, &a->depth, truncation,
                                   (float)a->limits.depth_max, &found);
    for (int64_t k = 0; k < min_i(count, AHEAD); k++) fetch_ahead(a, block, &found, k);
    for (int64_t k = 0; k < count; k++) {
        if (k + AHEAD < count) fetch_ahead(a, block, &found, k + AHEAD);
        if (k + AHEAD / 2 < count) fetch_evidence(a, block, &found, k + AHEAD / 2, band);
        int64_t voxel = found.voxel[k], pixel = found.pixel[k], at = block * BLOCK_VOXELS + voxel;
        float *tsdf = buffers->tsdf.data + at, *color = buffers->color.data + 3 * at;
        float old = buffers->weight.data[at], new = weighted ? look * a->trust.data[pixel] : look;
        if (clears && found.distance[k] > margin && old > 0 && *tsdf < LARGEST_CLEARED_TSDF &&
            sees_through(&a->bounds, &a->depth, (float)a->limits.depth_max, focal, voxel_size, truncation, pixel,
                         a->depth.data[pixel] - found.distance[k], *tsdf)) {
            cleared += weaken(buffers, at, a->rgb.data + 3 * pixel);
            continue;
        }
        if (look == MEASURED || old < MEASURED) { /* what is computed leaves alone what was measured */
            float fraction = 1.0f / (old + new);
            *tsdf = (old * *tsdf + new * min_f(found.distance[k] / truncation, 1.0f)) * fraction;
            for (int c = 0; c < 3; c++) color[c] = (old * color[c] + new * a->rgb.data[3 * pixel + c]) * fraction;
            buffers->weight.data[at] = min_f(old + new, weight_cap);
        }
        float weight = a->votes.weights.data[pixel];
        if (weight > 0 && fabsf(found.distance[k]) <= band)
            add_vote(buffers, at, a->votes.evidence.data + a->votes.rows.data[pixel] * classes, weight, cap);
    }
    return cleared;
}

KERNEL(fuse_frame_into_blocks, FuseArguments) {
    VoxelOffsets offsets;
    find_offsets(&a->camera, a->limits.voxel_size, &offsets);
    for (int64_t i = start; i < stop; i++) a->cleared.data[i] = fuse_block(a, a->indices.data[i], &offsets);
    return 0;
}
