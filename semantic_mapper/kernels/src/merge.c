/* Adding the voxels of one map to another, resampled where they do not coincide; see mapping/merge.py. */
#include "evidence.h"
#include "packed_blocks.h"

#define LEAST_FRACTION 1e-6 /* voxels that count less are there by rounding alone */
#define LEAST_OBSERVED 0.5  /* of the eight voxels around a point, by their fractions */

/* The voxels around a point that lie in blocks of the source, with their fractions in the interpolation. */
typedef struct {
    int64_t at[8]; /* block * 512 + voxel */
    double fraction[8];
    int count;
    double total; /* what the fractions of all eight add up to */
} Corners;

typedef struct {
    I32 keys; /* (B, 3) of the blocks to fill */
    F64 R, t; /* their point p is the source's R (p - t), in voxels; (3, 3) and (3,) */
    BlockIndex index;
    GridBuffers buffers; /* of the source */
    BlockValues moved;   /* (B, ...) zeros, to fill */
} ResampleArguments;

static void find_corners(const double *p, const BlockIndex *index, Corners *corners) {
    int64_t x0 = floor_int(p[0]), y0 = floor_int(p[1]), z0 = floor_int(p[2]), last_key = EMPTY_KEY, block = -1;
    double fx = p[0] - (double)x0, fy = p[1] - (double)y0, fz = p[2] - (double)z0;
    corners->count = 0;
    for (int corner = 0; corner < 8; corner++) {
        int i = corner & 1, j = (corner >> 1) & 1, k = corner >> 2;
        double fraction = (i ? fx : 1 - fx) * (j ? fy : 1 - fy) * (k ? fz : 1 - fz);
        if (fraction < LEAST_FRACTION) continue;
        int64_t x = x0 + i, y = y0 + j, z = z0 + k, key = key_of_voxel(x, y, z);
        if (key != last_key) last_key = key, block = find_block(index, key);
        if (block < 0) continue;
        corners->at[corners->count] = block * BLOCK_VOXELS + voxel_in_block(x, y, z);
        corners->fraction[corners->count++] = fraction;
    }
}

/* Across a depth edge, only the nearest observed voxel keeps its fraction. The total is 1 where nothing changes: voxels
 * without a block count as not observed. */
static void keep_nearest_at_edges(Corners *corners, const GridBuffers *buffers) {
    float least = 2, most = -2;
    int nearest = 0;
    corners->total = 1.0;
    for (int i = 0; i < corners->count; i++) {
        if (!(buffers->weight.data[corners->at[i]] > 0)) continue;
        float value = buffers->tsdf.data[corners->at[i]];
        if (most < least || corners->fraction[i] > corners->fraction[nearest]) nearest = i;
        least = min_f(least, value), most = max_f(most, value);
    }
    if (most - least <= LARGEST_STEP) return;
    for (int i = 0; i < corners->count; i++)
        if (i != nearest) corners->fraction[i] = 0;
    corners->total = corners->fraction[nearest];
}

static void blend_geometry(const Corners *corners, const GridBuffers *buffers, const BlockValues *moved, int64_t to) {
    double tsdf = 0.0, weight = 0.0, color[3] = {0.0, 0.0, 0.0}, observed = 0.0;
    for (int i = 0; i < corners->count; i++) {
        int64_t at = corners->at[i];
        double fraction = corners->fraction[i];
        if (!(buffers->weight.data[at] > 0)) continue;
        observed += fraction;
        weight += fraction * buffers->weight.data[at];
        tsdf += fraction * buffers->tsdf.data[at];
        for (int c = 0; c < 3; c++) color[c] += fraction * buffers->color.data[3 * at + c];
    }
    if (!(observed >= LEAST_OBSERVED * corners->total)) return;
    moved->weight.data[to] = (float)(weight / observed);
    moved->tsdf.data[to] = (float)(tsdf / observed);
    for (int c = 0; c < 3; c++) moved->color.data[3 * to + c] = (float)(color[c] / observed);
}

static void blend_votes(const Corners *corners, const GridBuffers *buffers, const BlockValues *moved, int64_t to) {
    int64_t classes = moved->evidence.shape[2], first[8];
    double votes = 0.0, voted = 0.0, factor[8];
    int count = 0;
    for (int i = 0; i < corners->count; i++) {
        double voxel_votes = buffers->votes.data[corners->at[i]];
        if (!(voxel_votes > 0)) continue;
        voted += corners->fraction[i];
        first[count] = corners->at[i] * classes;
        factor[count] = corners->fraction[i] * voxel_votes;
        votes += factor[count++];
    }
    if (voted == 0 || voted < LEAST_OBSERVED * corners->total) return;
    moved->votes.data[to] = (float)(votes / voted);
    for (int64_t c = 0; c < classes; c++) {
        double evidence = 0.0;
        for (int i = 0; i < count; i++) evidence += factor[i] * (double)buffers->evidence.data[first[i] + c];
        moved->evidence.data[to * classes + c] = (uint16_t)(evidence / votes + 0.5);
    }
}

KERNEL(resample_blocks, ResampleArguments) {
    const double *R = a->R.data;
    for (int64_t n = start; n < stop; n++) {
        for (int64_t voxel = 0; voxel < BLOCK_VOXELS; voxel++) {
            double to[3], from[3];
            for (int axis = 0; axis < 3; axis++)
                to[axis] =
                    (double)((int64_t)a->keys.data[3 * n + axis] * BLOCK_SIDE + ((voxel >> (3 * axis)) & 7)) -
                    a->t.data[axis];
            for (int axis = 0; axis < 3; axis++)
                from[axis] = R[3 * axis] * to[0] + R[3 * axis + 1] * to[1] + R[3 * axis + 2] * to[2];
            Corners corners;
            find_corners(from, &a->index, &corners);
            if (corners.count == 0) continue;
            keep_nearest_at_edges(&corners, &a->buffers);
            blend_geometry(&corners, &a->buffers, &a->moved, n * BLOCK_VOXELS + voxel);
            blend_votes(&corners, &a->buffers, &a->moved, n * BLOCK_VOXELS + voxel);
        }
    }
    return 0;
}

typedef struct {
    I32 blocks;          /* (B,) buffer indices of the blocks to add to */
    GridBuffers buffers; /* of the target */
    BlockValues added;   /* (B, ...) */
    double cap;          /* of weights and votes */
} AddBlocksArguments;

static void add_voxel(const GridBuffers *buffers, int64_t at, const BlockValues *added, int64_t from, double cap) {
    int64_t classes = buffers->evidence.shape[2];
    double mine = buffers->weight.data[at], theirs = added->weight.data[from];
    if (theirs > 0) {
        double weight = mine + theirs;
        double most = mine < MEASURED && theirs < MEASURED ? COMPUTED_CAP : cap;
        buffers->tsdf.data[at] =
            (float)((mine * buffers->tsdf.data[at] + theirs * added->tsdf.data[from]) / weight);
        for (int c = 0; c < 3; c++) {
            float *color = buffers->color.data + 3 * at + c;
            *color = (float)((mine * *color + theirs * added->color.data[3 * from + c]) / weight);
        }
        buffers->weight.data[at] = (float)min_d(weight, most);
    }
    double old = buffers->votes.data[at], new = added->votes.data[from], votes = old + new;
    if (!(new > 0)) return;
    buffers->votes.data[at] = (float)min_d(votes, cap);
    for (int64_t c = 0; c < classes; c++) {
        uint16_t *evidence = buffers->evidence.data + at * classes + c;
        *evidence = (uint16_t)((old * *evidence + new * added->evidence.data[from * classes + c]) / votes + 0.5);
    }
}

KERNEL(add_block_values, AddBlocksArguments) {
    for (int64_t n = start; n < stop; n++)
        for (int64_t voxel = 0; voxel < BLOCK_VOXELS; voxel++)
            add_voxel(&a->buffers, a->blocks.data[n] * (int64_t)BLOCK_VOXELS + voxel, &a->added,
                      n * BLOCK_VOXELS + voxel, a->cap);
    return 0;
}
