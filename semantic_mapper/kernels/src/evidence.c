/* Votes for one voxel; see mapping/fusion/evidence.py. */
#include "evidence.h"

typedef struct {
    AnyArray evidence; /* (1, 1, L) float32 or int16 */
    F32 votes;         /* (1, 1) */
    F32 log_p;         /* (N, L) */
    F32 weights;       /* (N,) */
    double cap;
    F32 dither; /* see evidence.h */
    int64_t seed;
} AddVotesArguments;

KERNEL(add_votes_in_turn, AddVotesArguments) {
    GridBuffers buffers = {.evidence = a->evidence, .votes = a->votes};
    int64_t classes = a->evidence.shape[2];
    for (int64_t n = 0; n < a->weights.shape[0]; n++)
        add_vote(&buffers, 0, a->log_p.data + n * classes, a->weights.data[n], (float)a->cap, a->dither.data,
                 first_dither((uint64_t)a->seed + (uint64_t)n, 0));
    return 0;
}
