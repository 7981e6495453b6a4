/* Packed key -> version: the open-addressing table of mapping/storage/key_table.py. */
#include "block_index.h"

#define ABSENT ((int64_t)-1)

typedef struct {
    I64 slot_keys, slot_versions; /* (S,) */
    I64 keys;                     /* (B,) */
    I64 versions;                 /* (B,): found, or to put */
} KeyTableArguments;

/* Where a key is, or where it would go. */
static int64_t slot_of(const I64 *slot_keys, int64_t key) {
    int64_t slots = slot_keys->shape[0], slot = first_slot(key, slots);
    while (slot_keys->data[slot] != ABSENT && slot_keys->data[slot] != key) slot = (slot + 1) & (slots - 1);
    return slot;
}

KERNEL(key_table_find, KeyTableArguments) {
    for (int64_t i = 0; i < a->keys.shape[0]; i++)
        a->versions.data[i] = a->slot_versions.data[slot_of(&a->slot_keys, a->keys.data[i])];
    return 0;
}

/* Returns how many are new. */
KERNEL(key_table_put, KeyTableArguments) {
    int64_t new = 0;
    for (int64_t i = 0; i < a->keys.shape[0]; i++) {
        int64_t slot = slot_of(&a->slot_keys, a->keys.data[i]);
        new += a->slot_keys.data[slot] == ABSENT;
        a->slot_keys.data[slot] = a->keys.data[i];
        a->slot_versions.data[slot] = a->versions.data[i];
    }
    return new;
}

typedef struct {
    I64 slot_keys, slot_versions, keys;
} KeyTableRemoveArguments;

/* Returns how many were there. What comes after a gap moves up, so that no search ends too early. */
KERNEL(key_table_remove, KeyTableRemoveArguments) {
    int64_t gone = 0, slots = a->slot_keys.shape[0], last = slots - 1;
    int64_t *keys = a->slot_keys.data, *versions = a->slot_versions.data;
    for (int64_t i = 0; i < a->keys.shape[0]; i++) {
        int64_t gap = slot_of(&a->slot_keys, a->keys.data[i]);
        if (keys[gap] == ABSENT) continue;
        gone++;
        for (int64_t slot = (gap + 1) & last; keys[slot] != ABSENT; slot = (slot + 1) & last) {
            int64_t first = first_slot(keys[slot], slots);
            if (((slot - first) & last) >= ((slot - gap) & last)) { /* its search begins at the gap or before */
                keys[gap] = keys[slot], versions[gap] = versions[slot];
                gap = slot;
            }
        }
        keys[gap] = versions[gap] = ABSENT;
    }
    return gone;
}
