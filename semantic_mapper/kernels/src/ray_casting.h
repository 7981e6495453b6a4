/* Walking along a ray from block to block, by the TSDF, to the first surface; see mapping/surface.py. */
#pragma once

#include "readout.h"

#define STEP_FRACTION 0.7 /* of the TSDF's distance: it is measured along other rays, so may be too long for this one */
#define REFINEMENTS 5
#define WIDENINGS 3
#define CLOSE_ENOUGH 2e-3 /* of the truncation: 0.16 mm at 2 cm voxels */

/* How far along `d` the point `p` leaves a block; voxels end half a voxel beyond their centres. */
static inline double block_exit(const double *p, const double *d, const int64_t *block) {
    double nearest = INFINITY;
    for (int axis = 0; axis < 3; axis++) {
        double base = (double)block[axis] * 8.0 - 0.5;
        if (d[axis] > 0)
            nearest = min_d(nearest, (base + 8.0 - p[axis]) / d[axis]);
        else if (d[axis] < 0)
            nearest = min_d(nearest, (base - p[axis]) / d[axis]);
    }
    return max_d(nearest, 0.0);
}

static inline void point_at(const double *origin, const double *d, double z, double *p) {
    for (int axis = 0; axis < 3; axis++) p[axis] = origin[axis] + z * d[axis];
}

ALWAYS_INLINE double value_at(double z, const double *origin, const double *d, const BlockIndex *index,
                              const TsdfField *field) {
    double p[3];
    point_at(origin, d, z, p);
    return sample_tsdf(p, index, field);
}

/* Zero of the interpolated TSDF round an interval whose nearest voxels change sign, by regula falsi (Illinois); 0 where
 * it has none there. It may change sign a little outside of the interval, which is widened by `step` until it does. */
static inline double refine(const double *origin, const double *d, double near, double far, double step,
                            const BlockIndex *index, const TsdfField *field) {
    double value_near = value_at(near, origin, d, index, field), value_far = value_at(far, origin, d, index, field);
    for (int n = 0; n < WIDENINGS; n++) {
        if (value_near <= 0) {
            far = near, value_far = value_near;
            near -= step;
            value_near = value_at(near, origin, d, index, field);
        } else if (value_far > 0) {
            near = far, value_near = value_far;
            far += step;
            value_far = value_at(far, origin, d, index, field);
        }
    }
    if (value_near <= 0 || value_far > 0) return 0.0;
    int side = 0;
    double z = near;
    for (int n = 0; n < REFINEMENTS; n++) {
        z = near + (far - near) * value_near / (value_near - value_far);
        double value = value_at(z, origin, d, index, field);
        if (fabs(value) < CLOSE_ENOUGH) break;
        if (value > 0) {
            near = z, value_near = value;
            if (side == 1) value_far *= 0.5;
            side = 1;
        } else {
            far = z, value_far = value;
            if (side == -1) value_near *= 0.5;
            side = -1;
        }
    }
    return z;
}

/* z of the first surface that the ray origin + z d (voxel units) meets from its front, 0 where there is none up to
 * `z_max`. `truncation_voxels` is the length of one unit of the field's TSDF, in voxels. */
static inline double march(const double *origin, const double *d, double truncation_voxels, double z_max,
                           const BlockIndex *index, const TsdfField *field) {
    double per_voxel = 1.0 / sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]); /* z a voxel of ray length */
    double z = 0.0, z_before = 0.0, before = -1.0; /* before > 0: TSDF at z_before, in front of a surface */
    int64_t last_key = EMPTY_KEY, block = -1;
    while (z <= z_max) {
        double p[3];
        point_at(origin, d, z, p);
        int64_t x = floor_int(p[0] + 0.5), y = floor_int(p[1] + 0.5), k = floor_int(p[2] + 0.5);
        int64_t key = key_of_voxel(x, y, k);
        if (key != last_key) last_key = key, block = find_block(index, key);
        if (block < 0) {
            z += block_exit(p, d, (int64_t[3]){x >> 3, y >> 3, k >> 3}) + 1e-3 * per_voxel;
            before = -1.0;
            continue;
        }
        int64_t at = block * BLOCK_VOXELS + voxel_in_block(x, y, k);
        if (!is_observed(field, at)) {
            z += per_voxel;
            before = -1.0;
            continue;
        }
        double value = tsdf_at(field, at);
        if (value <= 0 && before > 0) {
            double surface = refine(origin, d, z_before, z, 0.5 * per_voxel, index, field);
            if (surface > 0) return surface;
        }
        z_before = z, before = value;
        z += per_voxel * max_d(STEP_FRACTION * truncation_voxels * value, 0.5);
    }
    return 0.0;
}
