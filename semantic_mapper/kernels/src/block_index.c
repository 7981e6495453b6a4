/* The table of mapping/blocks.py. */
#include "block_index.h"

typedef struct {
    BlockIndex index;
    I64 packed; /* (B,) */
    I32 values; /* (B,): found, or to insert */
} BlockIndexArguments;

KERNEL(find_block_indices, BlockIndexArguments) {
    for (int64_t i = 0; i < a->packed.shape[0]; i++)
        a->values.data[i] = (int32_t)find_block(&a->index, a->packed.data[i]);
    return 0;
}

KERNEL(insert_blocks, BlockIndexArguments) {
    int64_t slots = a->index.slot_keys.shape[0];
    for (int64_t i = 0; i < a->packed.shape[0]; i++) {
        int64_t slot = first_slot(a->packed.data[i], slots);
        while (a->index.slot_keys.data[slot] != EMPTY_KEY) slot = (slot + 1) & (slots - 1);
        a->index.slot_keys.data[slot] = a->packed.data[i];
        a->index.slot_values.data[slot] = a->values.data[i];
    }
    return 0;
}
