/* The map seen from a pose; see mapping/surface.py. */
#include "camera.h"
#include "ray_casting.h"

typedef struct {
    Camera camera;
    int64_t top, left, height, width; /* of the window, pixels */
    double voxel_size;                /* metres */
    double truncation_voxels;
    double z_max; /* metres */
    double vote_discount, unknown_below;
    BlockIndex index;
    GridBuffers buffers;
    U8 wanted;      /* (H, W) */
    F32 depth;      /* (H, W) metres */
    U8 rgb;         /* (H, W, 3) */
    I64 channel;    /* (H, W) */
    F32 confidence; /* (H, W) */
    U8 measured;    /* (H, W) */
} CastViewArguments;

KERNEL(cast_view_rows, CastViewArguments) {
    const Camera *camera = &a->camera;
    const double *R = camera->R.data;
    TsdfField field = tsdf_of_grid(&a->buffers);
    double origin[3];
    for (int axis = 0; axis < 3; axis++) origin[axis] = camera->t.data[axis] / a->voxel_size;
    for (int64_t v = a->top + start; v < a->top + stop; v++) {
        double y = ((double)v - camera->cy) / camera->fy;
        for (int64_t u = a->left; u < a->left + a->width; u++) {
            int64_t at = v * a->depth.shape[1] + u;
            if (!a->wanted.data[at]) continue;
            double x = ((double)u - camera->cx) / camera->fx, d[3], p[3], confidence;
            for (int axis = 0; axis < 3; axis++)
                d[axis] = (R[3 * axis] * x + R[3 * axis + 1] * y + R[3 * axis + 2]) / a->voxel_size;
            double z = march(origin, d, a->truncation_voxels, a->z_max, &a->index, &field);
            if (z <= 0) continue;
            point_at(origin, d, z, p);
            a->channel.data[at] = read_point(p, &a->index, &a->buffers, a->vote_discount, a->unknown_below,
                                             a->rgb.data + 3 * at, &confidence, a->measured.data + at);
            a->depth.data[at] = (float)z;
            a->confidence.data[at] = (float)confidence;
        }
    }
    return 0;
}
