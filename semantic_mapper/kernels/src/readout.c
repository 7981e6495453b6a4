/* Color, class and confidence of points; see mapping/surface.py. */
#include "readout.h"

typedef struct {
    F64 points; /* (N, 3) in voxels */
    BlockIndex index;
    GridBuffers buffers;
    double vote_discount, unknown_below;
    U8 rgb;         /* (N, 3) */
    I64 channel;    /* (N,) */
    F32 confidence; /* (N,) */
    U8 measured;    /* (N,) */
} ReadPointsArguments;

KERNEL(read_map_points, ReadPointsArguments) {
    for (int64_t i = start; i < stop; i++) {
        double confidence;
        a->channel.data[i] = read_point(a->points.data + 3 * i, &a->index, &a->buffers, a->vote_discount,
                                        a->unknown_below, a->rgb.data + 3 * i, &confidence, a->measured.data + i);
        a->confidence.data[i] = (float)confidence;
    }
    return 0;
}
