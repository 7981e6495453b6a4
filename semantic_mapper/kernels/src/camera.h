/* A pinhole camera; see mapping/allocation.py. */
#pragma once

#include "kernels.h"

typedef struct {
    double fx, fy, cx, cy; /* pixels */
    F64 R, t;              /* R_world_camera (3, 3), and the camera centre in the world (3,) in metres */
} Camera;
