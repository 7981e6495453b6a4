/* All surface voxels of some blocks; see queries/surface.py. */
#include "surface.h"

typedef struct {
    I32 keys;  /* (B, 3) block coordinates */
    I32 slots; /* (B,) */
    BlockIndex index;
    BlockVoxels voxels;
    I64 counts; /* (B,) surface voxels of each block, out */
    I32 voxel;  /* (512 B,) out, the first N of them */
    F64 point;  /* (512 B, 3) out, the first N of them, units of voxels */
} CollectArguments;

KERNEL(collect_surface_voxels, CollectArguments) {
    int64_t at = 0;
    for (int64_t n = 0; n < a->keys.shape[0]; n++) {
        const int32_t *key = a->keys.data + 3 * n;
        int64_t near[6], first = at;
        double offset[3];
        neighbour_slots(&a->index, key[0], key[1], key[2], near);
        for (int64_t v = 0; v < BLOCK_VOXELS; v++) {
            if (!surface_offset(&a->voxels, a->slots.data[n], v, near, offset)) continue;
            a->voxel.data[at] = (int32_t)v;
            surface_point(key[0], key[1], key[2], v, offset, a->point.data + 3 * at);
            at++;
        }
        a->counts.data[n] = at - first;
    }
    return at;
}
