/* One state of a mirrored map; see queries/snapshot.py. */
#pragma once

#include "grid_buffers.h"

typedef struct {
    I8 tsdf;       /* (S, 512) signed distance over truncation, times 127 */
    U8 weight;     /* (S, 512) 0 where not observed, 1 where computed, 2 where a sensor measured it */
    U8 label;      /* (S, 512) class ids */
    U8 confidence; /* (S, 512) probability times 255 */
    U8 rgb;        /* (S, 512, 3) */
    U64 classes;   /* (S, 4) a bit for each class id that a surface voxel of the block may have */
} BlockVoxels;
