/* How class evidence is stored, and how a vote is added to it; see mapping/fusion/evidence.py.
 *
 * An evidence array is float32 (itemsize 4), the sum of weighted log probabilities, or int16 (itemsize 2), their mean
 * in steps of 1 / STEPS_PER_NAT. Evidence that was interpolated is float64 (itemsize 8), a sum.
 */
#pragma once

#include "grid_buffers.h"

#define STEPS_PER_NAT 3500.0
#define DITHERS 4096

/* One value of an evidence array of any of the three types. */
static inline double evidence_at(const void *evidence, int64_t itemsize, int64_t at) {
    if (itemsize == 2) return ((const int16_t *)evidence)[at];
    return itemsize == 4 ? (double)((const float *)evidence)[at] : ((const double *)evidence)[at];
}

/* What stored evidence of a voxel with this many votes is multiplied with to be the sum of log probabilities. */
static inline double evidence_scale(int64_t itemsize, double votes) {
    return itemsize == 2 ? votes / STEPS_PER_NAT : 1.0;
}

/* Stores the sum of log probabilities of `votes` votes, of which `keep` remain after the cap. */
static inline void store_evidence(AnyArray evidence, int64_t at, double sum, double votes, double keep) {
    if (evidence.itemsize == 2)
        ((int16_t *)evidence.data)[at] = (int16_t)to_int(rint(sum / votes * STEPS_PER_NAT));
    else
        ((float *)evidence.data)[at] = (float)(sum * keep);
}

/* For the votes of one block at one moment, which is any number that changes from frame to frame. */
static inline uint64_t dither_seed(const int32_t *key, int64_t moment) {
    uint64_t seed = (uint64_t)key[0] * 73856093u + (uint64_t)key[1] * 19349663u;
    return seed + (uint64_t)key[2] * 83492791u + (uint64_t)moment * 2654435761u;
}

/* Where in the dither table the numbers of a voxel begin. */
static inline int64_t first_dither(uint64_t seed, int64_t voxel) {
    int64_t mixed = (int64_t)((seed + (uint64_t)voxel * 668265263u) * 0x9E3779B97F4A7C15u);
    mixed = (int64_t)((uint64_t)(mixed ^ (mixed >> 29)) * 0xBF58476D1CE4E5B9u);
    return (mixed >> 32) & (DITHERS - 1);
}

/* Adds `weight * log_p` to the evidence of voxel `at` (block * 512 + voxel) and `weight` to its votes. Past the cap
 * the old sum shrinks, so that the map stays able to change its mind. `log_p` has L values; `dither` (4096 + 256,) is
 * the table of mapping/fusion/evidence.py, `first` of first_dither. */
static inline void add_vote(const GridBuffers *buffers, int64_t at, const float *restrict log_p, float weight,
                            float cap, const float *restrict dither, int64_t first) {
    int64_t classes = buffers->evidence.shape[2];
    float old_votes = buffers->votes.data[at], total = old_votes + weight, keep = 1.0f;
    if (total > cap) {
        keep = (cap - weight) / old_votes;
        total = cap;
    }
    buffers->votes.data[at] = total;
    if (buffers->evidence.itemsize == 2) {
        int16_t *restrict evidence = (int16_t *)buffers->evidence.data + at * classes;
        float share = weight / total, steps = (float)STEPS_PER_NAT;
        for (int64_t c = 0; c < classes; c++) {
            float old = evidence[c];
            evidence[c] = (int16_t)(old + floorf(share * (log_p[c] * steps - old) + dither[first + c]));
        }
    } else {
        float *restrict evidence = (float *)buffers->evidence.data + at * classes;
        for (int64_t c = 0; c < classes; c++) evidence[c] = evidence[c] * keep + weight * log_p[c];
    }
}
