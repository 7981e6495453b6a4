/* What rays meet in a snapshot; see queries/surface.py. */
#include "ray_casting.h"
#include "snapshot.h"

/* Slot (-1 = none) and voxel of the observed corner nearest to a point; of those with votes if any has some. */
static int64_t nearest_corner(const double *p, const BlockIndex *index, const BlockVoxels *voxels, int64_t *chosen) {
    int64_t x0 = floor_int(p[0]), y0 = floor_int(p[1]), z0 = floor_int(p[2]), best_slot = -1;
    double best = -1.0;
    bool best_voted = false;
    *chosen = 0;
    for (int corner = 0; corner < 8; corner++) {
        int64_t x = x0 + (corner & 1), y = y0 + ((corner >> 1) & 1), z = z0 + (corner >> 2);
        int64_t slot = find_block(index, key_of_voxel(x, y, z)), voxel = voxel_in_block(x, y, z);
        if (slot < 0 || !voxels->weight.data[slot * BLOCK_VOXELS + voxel]) continue;
        double fraction = (1 - fabs(p[0] - (double)x)) * (1 - fabs(p[1] - (double)y)) * (1 - fabs(p[2] - (double)z));
        bool voted = voxels->confidence.data[slot * BLOCK_VOXELS + voxel] > 0;
        if ((voted && !best_voted) || (voted == best_voted && fraction > best))
            best = fraction, best_slot = slot, *chosen = voxel, best_voted = voted;
    }
    return best_slot;
}

typedef struct {
    F64 origins;            /* (N, 3) units of voxels */
    F64 directions;         /* (N, 3) voxels a unit of the distance */
    double voxels_per_step; /* length of one step of the TSDF */
    double max_m;
    BlockIndex index;
    BlockVoxels voxels;
    F32 distance; /* (N,) out: 0 = miss */
    I64 slots;    /* (N,) out: -1 = none */
    I64 chosen;   /* (N,) out: voxel of the block */
} MarchArguments;

KERNEL(march_rays, MarchArguments) {
    TsdfField field = {a->voxels.tsdf.data, a->voxels.weight.data, true};
    for (int64_t n = 0; n < a->origins.shape[0]; n++) {
        const double *origin = a->origins.data + 3 * n, *direction = a->directions.data + 3 * n;
        double p[3], d = march(origin, direction, a->voxels_per_step, a->max_m, &a->index, &field);
        a->distance.data[n] = 0.0f, a->slots.data[n] = -1, a->chosen.data[n] = 0;
        if (!(d > 0)) continue;
        point_at(origin, direction, d, p);
        a->distance.data[n] = (float)d;
        a->slots.data[n] = nearest_corner(p, &a->index, &a->voxels, a->chosen.data + n);
    }
    return 0;
}
