/* Probabilities of classes: see fields/render.py and mapping/rendering.py. */
#include <string.h>

#include "kernels.h"
#include "simd.h"

#pragma clang fp contract(fast)

#define NOTHING -1e30f /* a score that is no class's */

typedef float Row[MOST_CLASSES + LANES]; /* a row of numbers, one a class, and what fills its last lanes */

static void fill_row(Row row, int64_t classes) {
    for (int64_t c = classes; c < round_up(classes, LANES); c++) row[c] = NOTHING;
}

static void read_row(Row row, const float *from, int64_t classes) {
    memcpy(row, from, (size_t)classes * sizeof *row);
    fill_row(row, classes);
}

static void softmax(Row row, int64_t classes) {
    const int64_t end = round_up(classes, LANES);
    Lanes top = load(row), sum = splat(0);
    for (int64_t c = LANES; c < end; c += LANES) top = larger(top, load(row + c));
    const Lanes most = splat(largest(top));
    for (int64_t c = 0; c < end; c += LANES) {
        const Lanes raised = exp_below(load(row + c) - most);
        sum += raised, store(row + c, raised);
    }
    const Lanes whole = splat(total(sum));
    for (int64_t c = 0; c < end; c += LANES) store(row + c, load(row + c) / whole);
}

typedef struct {
    F32 logits, out; /* (N, L) */
} SoftmaxArguments;

KERNEL(softmax_rows, SoftmaxArguments) {
    const int64_t classes = a->logits.shape[1];
    Row row;
    for (int64_t n = start; n < stop; n++) {
        read_row(row, a->logits.data + n * classes, classes);
        softmax(row, classes);
        memcpy(a->out.data + n * classes, row, (size_t)classes * sizeof *row);
    }
    return 0;
}

typedef struct {
    F32 probabilities; /* (N, L) */
    I64 channel;       /* (N,) to fill */
    F32 most;          /* (N,) to fill */
} LikeliestArguments;

/* The class of the largest probability of each row, the first of equal ones, and that probability. */
KERNEL(likeliest_rows, LikeliestArguments) {
    const int64_t classes = a->probabilities.shape[1];
    for (int64_t n = start; n < stop; n++) {
        const float *row = a->probabilities.data + n * classes;
        int64_t best = 0;
        for (int64_t c = 1; c < classes; c++) best = row[c] > row[best] ? c : best;
        a->channel.data[n] = best, a->most.data[n] = row[best];
    }
    return 0;
}

typedef struct {
    F32 own, probabilities; /* (N, L) logits; probabilities, of which those of `known` are replaced */
    U8 known;               /* (N,) bool */
    double weight, floor;   /* of `own`; the least probability that counts */
} JoinArguments;

/* Weighted geometric means of two opinions. */
KERNEL(join_opinions, JoinArguments) {
    const int64_t classes = a->own.shape[1], end = round_up(classes, LANES);
    const float weight = (float)a->weight;
    const Lanes floor = splat((float)a->floor);
    Row own, row;
    for (int64_t n = start; n < stop; n++) {
        if (!a->known.data[n]) continue;
        float *probabilities = a->probabilities.data + n * classes;
        read_row(own, a->own.data + n * classes, classes);
        softmax(own, classes);
        read_row(row, probabilities, classes);
        for (int64_t c = 0; c < end; c += LANES) {
            const Lanes one = log_of(larger(load(own + c), floor)), other = log_of(larger(load(row + c), floor));
            store(row + c, weight * one + (1.0f - weight) * other);
        }
        fill_row(row, classes);
        softmax(row, classes);
        memcpy(probabilities, row, (size_t)classes * sizeof *row);
    }
    return 0;
}
