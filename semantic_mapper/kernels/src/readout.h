/* Reading the map at any point: interpolation over the eight voxels around it; see mapping/surface.py. */
#pragma once

#include "evidence.h"

#define LEAST_FRACTION 1e-3 /* corners that count less are rounding dust of a point that lies on a voxel edge */
#define NOT_OBSERVED 2.0    /* a TSDF value that no voxel has */

/* Signed distances of a grid, or of a snapshot of one, where they are bytes. */
typedef struct {
    const void *tsdf;   /* (B, 512) float32 or int8 */
    const void *weight; /* (B, 512) float32 or uint8; > 0 where observed */
    bool bytes;         /* which of both; a constant in the caller, so that the compiler makes a function for each */
} TsdfField;

static inline TsdfField tsdf_of_grid(const GridBuffers *buffers) {
    return (TsdfField){buffers->tsdf.data, buffers->weight.data, false};
}

static inline double tsdf_at(const TsdfField *field, int64_t at) {
    return field->bytes ? (double)((const int8_t *)field->tsdf)[at] : (double)((const float *)field->tsdf)[at];
}

static inline bool is_observed(const TsdfField *field, int64_t at) {
    return field->bytes ? ((const uint8_t *)field->weight)[at] > 0 : ((const float *)field->weight)[at] > 0;
}

/* Interpolated TSDF at a point (voxel units) over its observed corners; NOT_OBSERVED where there is none. */
ALWAYS_INLINE double sample_tsdf(const double *p, const BlockIndex *index, const TsdfField *field) {
    int64_t x0 = floor_int(p[0]), y0 = floor_int(p[1]), z0 = floor_int(p[2]), last_key = EMPTY_KEY, block = -1;
    double fx = p[0] - (double)x0, fy = p[1] - (double)y0, fz = p[2] - (double)z0, total = 0.0, fraction_sum = 0.0;
    for (int corner = 0; corner < 8; corner++) {
        int i = corner & 1, j = (corner >> 1) & 1, k = corner >> 2;
        double fraction = (i ? fx : 1 - fx) * (j ? fy : 1 - fy) * (k ? fz : 1 - fz);
        if (fraction <= 0) continue;
        int64_t x = x0 + i, y = y0 + j, z = z0 + k, key = key_of_voxel(x, y, z);
        if (key != last_key) last_key = key, block = find_block(index, key);
        if (block < 0) continue;
        int64_t at = block * BLOCK_VOXELS + voxel_in_block(x, y, z);
        if (is_observed(field, at)) {
            total += fraction * tsdf_at(field, at);
            fraction_sum += fraction;
        }
    }
    return fraction_sum > 0 ? total / fraction_sum : NOT_OBSERVED;
}

/* Interpolates color (3,) and evidence (L,), which weighs by its votes, at a point, and finds the least weight around
 * it; returns the interpolated votes. */
static inline double gather(const double *p, const BlockIndex *index, const GridBuffers *buffers, double *color,
                            double *evidence, float *least_weight) {
    int64_t classes = buffers->evidence.shape[2];
    int64_t x0 = floor_int(p[0]), y0 = floor_int(p[1]), z0 = floor_int(p[2]);
    double fx = p[0] - (double)x0, fy = p[1] - (double)y0, fz = p[2] - (double)z0;
    double color_sum = 0.0, vote_sum = 0.0, votes = 0.0;
    *least_weight = INFINITY;
    for (int c = 0; c < 3; c++) color[c] = 0.0;
    for (int64_t c = 0; c < classes; c++) evidence[c] = 0.0;
    for (int corner = 0; corner < 8; corner++) {
        int i = corner & 1, j = (corner >> 1) & 1, k = corner >> 2;
        double fraction = (i ? fx : 1 - fx) * (j ? fy : 1 - fy) * (k ? fz : 1 - fz);
        if (fraction < LEAST_FRACTION) continue;
        int64_t x = x0 + i, y = y0 + j, z = z0 + k, block = find_block(index, key_of_voxel(x, y, z));
        if (block < 0) continue;
        int64_t at = block * BLOCK_VOXELS + voxel_in_block(x, y, z);
        if (buffers->weight.data[at] > 0) {
            color_sum += fraction;
            *least_weight = min_f(*least_weight, buffers->weight.data[at]);
            for (int c = 0; c < 3; c++) color[c] += fraction * (double)buffers->color.data[3 * at + c];
        }
        float voxel_votes = buffers->votes.data[at];
        if (voxel_votes > 0) {
            vote_sum += fraction;
            votes += fraction * (double)voxel_votes;
            const uint16_t *own = buffers->evidence.data + at * classes;
            for (int64_t c = 0; c < classes; c++) evidence[c] += fraction * (double)voxel_votes * (double)own[c];
        }
    }
    if (color_sum > 0)
        for (int c = 0; c < 3; c++) color[c] /= color_sum;
    if (!(vote_sum > 0)) return 0.0;
    for (int64_t c = 0; c < classes; c++) evidence[c] /= votes;
    return votes / vote_sum;
}

/* How many independent votes so many are worth: n_eff, at least 1. */
static inline double vote_worth(double votes, double vote_discount) {
    return votes > 1 ? votes / (1.0 + vote_discount * (votes - 1.0)) : 1.0;
}

/* Channel and confidence of one voxel's evidence (L,); -1 and 0 without votes. Below `unknown_below` the channel is -1,
 * too, and the confidence that of the likeliest class. One function for evidence as it is stored and one for
 * evidence that was interpolated. */
#define DECIDE(name, type)                                                                                          \
    static inline int64_t name(const type *evidence, int64_t classes, double votes, double vote_discount,           \
                               double unknown_below, double *confidence) {                                          \
        *confidence = 0.0;                                                                                          \
        if (votes <= 0) return -1;                                                                                  \
        double worth = vote_worth(votes, vote_discount) / EVIDENCE_STEPS, total = 0.0;                              \
        int64_t best = 0;                                                                                           \
        for (int64_t c = 1; c < classes; c++)                                                                       \
            if (evidence[c] < evidence[best]) best = c;                                                             \
        for (int64_t c = 0; c < classes; c++) total += exp((evidence[best] - evidence[c]) * worth);                 \
        *confidence = 1.0 / total;                                                                                  \
        return *confidence < unknown_below ? -1 : best;                                                             \
    }
DECIDE(decide_stored, uint16_t)
DECIDE(decide_interpolated, double)
#undef DECIDE

/* Channel and confidence of a point; writes its color to `rgb` (3,) and whether all around it was measured. At most
 * MAX_CLASSES classes. */
static inline int64_t read_point(const double *p, const BlockIndex *index, const GridBuffers *buffers,
                                 double vote_discount, double unknown_below, uint8_t *rgb, double *confidence,
                                 uint8_t *measured) {
    double color[3], evidence[MAX_CLASSES];
    float least_weight;
    double votes = gather(p, index, buffers, color, evidence, &least_weight);
    *measured = least_weight >= MEASURED && least_weight < INFINITY;
    for (int c = 0; c < 3; c++) rgb[c] = to_byte(color[c]);
    return decide_interpolated(evidence, buffers->evidence.shape[2], votes, vote_discount, unknown_below, confidence);
}
