/* Class evidence is what votes say on average: of each class minus the log probability, as whole EVIDENCE_STEPS. */
#pragma once

#include "grid_buffers.h"
#include "simd.h"

#define EVIDENCE_STEPS 4096.0f /* a nat; of mapping/fusion.py */

typedef uint16_t ShortLanes __attribute__((ext_vector_type(LANES)));

/* Moves eight numbers of evidence towards what a vote says by a fraction of their distance, rounded. */
INLINE ShortLanes move_towards(const uint16_t *evidence, const uint16_t *said, Lanes fraction) {
    ShortLanes from, to;
    memcpy(&from, evidence, sizeof from);
    memcpy(&to, said, sizeof to);
    Lanes own = __builtin_convertvector(from, Lanes), step = __builtin_convertvector(to, Lanes) - own;
    return __builtin_convertvector(__builtin_convertvector(own + fraction * step + 0.5f, IntLanes), ShortLanes);
}

/* Adds a vote, `said` (L,) of a weight, to the evidence of voxel `at` (block * 512 + voxel) and its weight to the votes.
 * At the cap old votes fade, so that the map stays able to change its mind. */
static inline void add_vote(const GridBuffers *buffers, int64_t at, const uint16_t *said, float weight, float cap) {
    int64_t classes = buffers->evidence.shape[2], last = classes - LANES;
    float votes = min_f(buffers->votes.data[at] + weight, cap), fraction = weight / votes;
    uint16_t *evidence = buffers->evidence.data + at * classes;
    buffers->votes.data[at] = votes;
    if (last < 0) {
        for (int64_t c = 0; c < classes; c++) {
            float own = (float)evidence[c];
            evidence[c] = (uint16_t)(own + fraction * ((float)said[c] - own) + 0.5f);
        }
        return;
    }
    ShortLanes rest = move_towards(evidence + last, said + last, splat(fraction)); /* read before it is written */
    for (int64_t c = 0; c < last; c += LANES) {
        ShortLanes moved = move_towards(evidence + c, said + c, splat(fraction));
        memcpy(evidence + c, &moved, sizeof moved);
    }
    memcpy(evidence + last, &rest, sizeof rest);
}
