/* Surface voxels of some classes, copied from an earlier state where nothing changed; see queries/class_surface.py. */
#include <string.h>

#include "surface.h"

typedef struct {
    I64 packed, serials; /* (B,) sorted keys and what content the blocks have */
    BlockIndex index;
    I32 row_of;                  /* (S,) row of the block in each slot */
    I64 old_packed, old_serials; /* (A,) of the earlier state */
    I64 changed;                 /* (A + B,) scratch: keys */
    I64 source;                  /* (B,) out: row in the earlier state; -1: the block or a neighbour has changed */
} FindSourcesArguments;

KERNEL(find_block_sources, FindSourcesArguments) {
    int64_t rows = a->packed.shape[0], old_rows = a->old_packed.shape[0], count = 0, old = 0;
    const int64_t *packed = a->packed.data, *old_packed = a->old_packed.data;
    int64_t *changed = a->changed.data, *source = a->source.data;
    for (int64_t row = 0; row < rows; row++) {
        source[row] = -1;
        while (old < old_rows && old_packed[old] < packed[row]) changed[count++] = old_packed[old++]; /* gone */
        if (old < old_rows && old_packed[old] == packed[row]) {
            if (a->old_serials.data[old] == a->serials.data[row]) source[row] = old;
            old++;
        }
        if (source[row] < 0) changed[count++] = packed[row];
    }
    while (old < old_rows) changed[count++] = old_packed[old++];
    for (int64_t i = 0; i < count; i++) {
        int64_t near[6];
        neighbour_slots(&a->index, key_part(changed[i], 0), key_part(changed[i], 1), key_part(changed[i], 2), near);
        for (int n = 0; n < 6; n++)
            if (near[n] >= 0) source[a->row_of.data[near[n]]] = -1;
    }
    return 0;
}

typedef struct {
    I64 packed, serials; /* (B,) */
    U8 fresh;            /* (B,) bool */
    I64 start;           /* (B + 1,) */
    I32 voxel;           /* (N,) */
    F64 point;           /* (N, 3) */
    U8 label;            /* (N,) */
    U8 confidence;       /* (N,) */
} ClassSurface;

typedef struct {
    I64 packed; /* (B,) keys */
    I32 slots;  /* (B,) */
    I64 source; /* (B,) of find_block_sources */
    BlockIndex index;
    BlockVoxels voxels;
    U8 wanted;           /* (256,) bool: class ids */
    ClassSurface before; /* the earlier state */
    int64_t first_row;   /* where to go on */
    I64 start;           /* (B + 1,) out; start[first_row] is given */
    I32 voxel;           /* (room,) and the following out */
    F64 point;           /* (room, 3) */
    U8 label;            /* (room,) */
    U8 confidence;       /* (room,) */
} CollectClassArguments;

/* Copies the voxels of a block of the earlier state to `at`; returns where they end. */
static int64_t copy_block(const CollectClassArguments *a, int64_t old_row, int64_t at) {
    const ClassSurface *before = &a->before;
    int64_t from = before->start.data[old_row], count = before->start.data[old_row + 1] - from;
    memcpy(a->voxel.data + at, before->voxel.data + from, (size_t)count * sizeof(int32_t));
    memcpy(a->point.data + 3 * at, before->point.data + 3 * from, (size_t)count * 3 * sizeof(double));
    memcpy(a->label.data + at, before->label.data + from, (size_t)count);
    memcpy(a->confidence.data + at, before->confidence.data + from, (size_t)count);
    return at + count;
}

static int64_t compute_block(const CollectClassArguments *a, int64_t slot, int64_t key, int64_t at) {
    int64_t x = key_part(key, 0), y = key_part(key, 1), z = key_part(key, 2), near[6];
    const uint8_t *label = a->voxels.label.data + slot * BLOCK_VOXELS;
    double offset[3];
    neighbour_slots(&a->index, x, y, z, near);
    for (int64_t v = 0; v < BLOCK_VOXELS; v++) {
        if (!a->wanted.data[label[v]] || !surface_offset(&a->voxels, slot, v, near, offset)) continue;
        a->voxel.data[at] = (int32_t)v;
        a->label.data[at] = label[v];
        a->confidence.data[at] = a->voxels.confidence.data[slot * BLOCK_VOXELS + v];
        surface_point(x, y, z, v, offset, a->point.data + 3 * at);
        at++;
    }
    return at;
}

/* Returns the row that it came to: fewer than there are where there is no room for a block's 512 voxels. */
KERNEL(collect_class_surface, CollectClassArguments) {
    int64_t row = a->first_row, at = a->start.data[row], room = a->voxel.shape[0];
    for (; row < a->packed.shape[0] && at + BLOCK_VOXELS <= room; row++) {
        int64_t old_row = a->source.data[row];
        at = old_row >= 0 ? copy_block(a, old_row, at) : compute_block(a, a->slots.data[row], a->packed.data[row], at);
        a->start.data[row + 1] = at;
    }
    return row;
}
