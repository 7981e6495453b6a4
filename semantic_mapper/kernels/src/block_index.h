/* Block key -> buffer index: an open-addressing table. Three block coordinates packed into one int64 sort like them. */
#pragma once

#include "kernels.h"

#define KEY_BITS 21
#define KEY_LIMIT ((int64_t)1 << (KEY_BITS - 1))
#define KEY_MASK (((int64_t)1 << KEY_BITS) - 1)
#define EMPTY_KEY ((int64_t)-1)

typedef struct {
    I64 slot_keys;   /* (S,) packed keys, EMPTY_KEY where there is none; S is a power of two */
    I32 slot_values; /* (S,) buffer indices */
} BlockIndex;

/* Unsigned: coordinates beyond the limit give some key, nothing worse. */
static inline int64_t pack_key(int64_t x, int64_t y, int64_t z) {
    uint64_t limit = (uint64_t)KEY_LIMIT, high = (uint64_t)x + limit, middle = (uint64_t)y + limit;
    return (int64_t)(high << (2 * KEY_BITS) | middle << KEY_BITS | ((uint64_t)z + limit));
}

/* What to add to a packed key for the next block along an axis, in the direction of `sign`. */
static inline int64_t pack_step(int axis, double sign) {
    int64_t step = (int64_t)1 << ((2 - axis) * KEY_BITS);
    return sign > 0 ? step : -step;
}

static inline int64_t key_part(int64_t packed, int axis) {
    return ((packed >> ((2 - axis) * KEY_BITS)) & KEY_MASK) - KEY_LIMIT;
}

/* Where the search for a key begins. */
static inline int64_t first_slot(int64_t packed, int64_t slot_count) {
    int64_t h = (int64_t)((uint64_t)packed * 0x9E3779B97F4A7C15u); /* 2^64 / golden ratio */
    return (h ^ (h >> 29)) & (slot_count - 1);
}

/* Buffer index of a packed key, -1 where there is no such block. */
static inline int64_t find_block(const BlockIndex *index, int64_t packed) {
    int64_t slots = index->slot_keys.shape[0];
    for (int64_t slot = first_slot(packed, slots);; slot = (slot + 1) & (slots - 1)) {
        int64_t key = index->slot_keys.data[slot];
        if (key == EMPTY_KEY) return -1; /* first: a key of coordinates beyond the limit may look like it */
        if (key == packed) return index->slot_values.data[slot];
    }
}
