/* Class evidence is the sum of weighted log probabilities; how a vote is added to it. */
#pragma once

#include "grid_buffers.h"

/* Adds `weight * log_p` (L,) to the evidence of voxel `at` (block * 512 + voxel) and `weight` to its votes. Past the
 * cap the old sum shrinks, so that the map stays able to change its mind. */
static inline void add_vote(const GridBuffers *buffers, int64_t at, const float *restrict log_p, float weight,
                            float cap) {
    int64_t classes = buffers->evidence.shape[2];
    float old_votes = buffers->votes.data[at], total = old_votes + weight, keep = 1.0f;
    if (total > cap) {
        keep = (cap - weight) / old_votes;
        total = cap;
    }
    buffers->votes.data[at] = total;
    float *restrict evidence = buffers->evidence.data + at * classes;
    for (int64_t c = 0; c < classes; c++) evidence[c] = evidence[c] * keep + weight * log_p[c];
}
