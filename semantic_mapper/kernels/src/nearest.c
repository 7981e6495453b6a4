/* The nearest surface of a class, from block to block; see queries/nearest.py. */
#include "surface.h"

typedef struct {
    F64 p; /* (3,) units of voxels */
    int64_t class_id;
    I64 packed;  /* (B,) keys */
    I32 slots;   /* (B,) */
    U64 classes; /* (S, 4) of BlockVoxels */
    I64 rows;    /* (B,) out: of the blocks that may have surface of the class */
    F64 bounds;  /* (B,) out: squares of the least distances that it may have */
} BoundArguments;

/* Returns how many blocks may have surface of the class. */
KERNEL(bound_blocks, BoundArguments) {
    const double *p = a->p.data;
    int64_t word = a->class_id >> 6, count = 0;
    uint64_t bit = (uint64_t)1 << (a->class_id & 63);
    for (int64_t n = 0; n < a->packed.shape[0]; n++) {
        if (!(a->classes.data[4 * (int64_t)a->slots.data[n] + word] & bit)) continue;
        double bound = 0.0;
        for (int axis = 0; axis < 3; axis++) {
            double first = (double)(key_part(a->packed.data[n], axis) * 8);
            double gap = max_d(max_d(first - 0.5 - p[axis], p[axis] - first - 7.5), 0.0);
            bound += gap * gap;
        }
        a->rows.data[count] = n, a->bounds.data[count] = bound;
        count++;
    }
    return count;
}

typedef struct {
    F64 p;            /* (3,) units of voxels */
    int64_t class_id; /* that is looked for */
    int64_t least;    /* confidence byte */
    I64 packed;       /* (R,) keys of the blocks in the order of `bounds` */
    I32 slots;        /* (R,) */
    F64 bounds;       /* (R,) squares of the least distances that their surfaces may have */
    BlockIndex index;
    BlockVoxels voxels;
    F64 found; /* (4,) the nearest surface point so far and the square of its distance; updated */
} SearchArguments;

/* Returns slot * 512 + voxel where it found a nearer one, else -1. */
KERNEL(search_blocks, SearchArguments) {
    const double *p = a->p.data;
    double *found = a->found.data;
    int64_t best = -1, class_id = a->class_id, least = a->least;
    for (int64_t i = 0; i < a->packed.shape[0] && a->bounds.data[i] <= found[3]; i++) {
        int64_t slot = a->slots.data[i], key = a->packed.data[i], near[6];
        int64_t x = key_part(key, 0), y = key_part(key, 1), z = key_part(key, 2);
        neighbour_slots(&a->index, x, y, z, near);
        const uint8_t *label = a->voxels.label.data + slot * BLOCK_VOXELS;
        const uint8_t *confidence = a->voxels.confidence.data + slot * BLOCK_VOXELS;
        for (int64_t voxel = 0; voxel < BLOCK_VOXELS; voxel++) {
            double offset[3], q[3];
            if (label[voxel] != class_id || confidence[voxel] < least) continue;
            if (!surface_offset(&a->voxels, slot, voxel, near, offset)) continue;
            surface_point(x, y, z, voxel, offset, q);
            double dx = q[0] - p[0], dy = q[1] - p[1], dz = q[2] - p[2], d = dx * dx + dy * dy + dz * dz;
            if (d < found[3]) {
                found[0] = q[0], found[1] = q[1], found[2] = q[2], found[3] = d;
                best = slot * BLOCK_VOXELS + voxel;
            }
        }
    }
    return best;
}
