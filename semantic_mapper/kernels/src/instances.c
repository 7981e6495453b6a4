/* Which instances of two states of a map share voxels; see queries/instances.py. */
#include "kernels.h"

typedef struct {
    I64 packed;    /* (B,) sorted keys */
    I64 start;     /* (B + 1,) block b has the voxels start[b] .. start[b + 1] - 1 */
    I32 voxel;     /* (N,) within the block, ascending in each */
    I64 component; /* (N,) -1 = none */
} LabelledVoxels;

typedef struct {
    LabelledVoxels old, new;
    int64_t count; /* of new components */
    I64 pairs;     /* (N,) out: old component * count + new component of each voxel that has both */
} OverlapArguments;

/* Returns how many pairs it found. */
KERNEL(find_overlaps, OverlapArguments) {
    const LabelledVoxels *old = &a->old, *new = &a->new;
    int64_t found = 0, old_row = 0, old_rows = old->packed.shape[0];
    for (int64_t row = 0; row < new->packed.shape[0]; row++) {
        while (old_row < old_rows && old->packed.data[old_row] < new->packed.data[row]) old_row++;
        if (old_row == old_rows) break;
        if (old->packed.data[old_row] != new->packed.data[row]) continue;
        int64_t j = old->start.data[old_row], end = old->start.data[old_row + 1];
        for (int64_t i = new->start.data[row]; i < new->start.data[row + 1]; i++) {
            while (j < end && old->voxel.data[j] < new->voxel.data[i]) j++;
            if (j == end) break;
            int64_t before = old->component.data[j], now = new->component.data[i];
            if (old->voxel.data[j] == new->voxel.data[i] && before >= 0 && now >= 0)
                a->pairs.data[found++] = before * a->count + now;
        }
    }
    return found;
}
