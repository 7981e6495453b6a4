/* First hit of every pixel: a primitive is tested only inside its rectangle on the screen; see scenes/fast_cast.py. */
#include "fast_cast.h"

typedef struct {
    Primitives primitives;
    F64 origin;      /* (3,) of the camera */
    F64 camera_axes; /* (3, 3) columns are the camera's axes in the world */
    double fx, fy, cx, cy;
    F64 depth; /* (H, W) out: infinity = miss */
    I32 index; /* (H, W) out: -1 = miss */
} CastArguments;

typedef struct {
    double x0, x1, y0, y1;
} Bounds;

static void extend(Bounds *bounds, double x, double y) {
    bounds->x0 = min_d(bounds->x0, x), bounds->x1 = max_d(bounds->x1, x);
    bounds->y0 = min_d(bounds->y0, y), bounds->y1 = max_d(bounds->y1, y);
}

/* `value` within 0 to `most`, or -1 to `most` - 1, as a pixel number; NaN is the lower bound. */
static int64_t first_pixel(double value, int64_t most) {
    return (int64_t)floor(min_d(max_d(0.0, value), (double)most));
}
static int64_t last_pixel(double value, int64_t most) {
    return (int64_t)ceil(min_d(max_d(-1.0, value), (double)(most - 1)));
}

/* Pixels [u0, u1) x [v0, v1) that the box round a primitive can cover; its edges are clipped at the near plane. */
static void screen_rectangle(const CastArguments *a, int64_t p, int64_t *u0, int64_t *u1, int64_t *v0, int64_t *v1) {
    const double *center = a->primitives.center.data + 3 * p, *half = a->primitives.half.data + 3 * p;
    const double *rotation = a->primitives.rotation.data + 9 * p, *axes = a->camera_axes.data;
    double corner[8][3], offset[3];
    for (int i = 0; i < 3; i++) offset[i] = center[i] - a->origin.data[i];
    for (int k = 0; k < 8; k++) {
        double s[3], world[3];
        for (int i = 0; i < 3; i++) s[i] = k & (1 << i) ? half[i] : -half[i];
        for (int i = 0; i < 3; i++)
            world[i] = offset[i] + rotation[3 * i] * s[0] + rotation[3 * i + 1] * s[1] + rotation[3 * i + 2] * s[2];
        for (int i = 0; i < 3; i++)
            corner[k][i] = axes[i] * world[0] + axes[3 + i] * world[1] + axes[6 + i] * world[2];
    }
    Bounds bounds = {INFINITY, -INFINITY, INFINITY, -INFINITY};
    for (int k = 0; k < 8; k++) {
        const double *c = corner[k];
        if (c[2] >= NEAR_M) extend(&bounds, c[0] / c[2], c[1] / c[2]);
        for (int bit = 1; bit < 8; bit *= 2) {
            const double *other = corner[k ^ bit];
            if (c[2] >= NEAR_M && other[2] < NEAR_M) {
                double w = (c[2] - NEAR_M) / (c[2] - other[2]);
                extend(&bounds, (c[0] + w * (other[0] - c[0])) / NEAR_M, (c[1] + w * (other[1] - c[1])) / NEAR_M);
            }
        }
    }
    *u0 = *u1 = *v0 = *v1 = 0;
    if (bounds.x0 > bounds.x1) return;
    int64_t height = a->depth.shape[0], width = a->depth.shape[1];
    *u0 = first_pixel(bounds.x0 * a->fx + a->cx, width), *u1 = last_pixel(bounds.x1 * a->fx + a->cx, width) + 1;
    *v0 = first_pixel(bounds.y0 * a->fy + a->cy, height), *v1 = last_pixel(bounds.y1 * a->fy + a->cy, height) + 1;
}

/* The ray of a pixel, t (x, y, 1) in the camera's axes, is from + t turn (x, y, 1) in a primitive's own coordinates. */
static void to_own_coordinates(const CastArguments *a, int64_t p, double *from, double turn[3][3]) {
    const double *center = a->primitives.center.data + 3 * p, *half = a->primitives.half.data + 3 * p;
    const double *rotation = a->primitives.rotation.data + 9 * p;
    for (int i = 0; i < 3; i++) {
        from[i] = turn[i][0] = turn[i][1] = turn[i][2] = 0.0;
        for (int j = 0; j < 3; j++) {
            double to_own = rotation[3 * j + i] / half[i];
            from[i] += to_own * (a->origin.data[j] - center[j]);
            for (int k = 0; k < 3; k++) turn[i][k] += to_own * a->camera_axes.data[3 * j + k];
        }
    }
}

/* `shape` is a constant in the caller: the compiler makes a loop for each, and runs it on several pixels at once where
 * it can. */
ALWAYS_INLINE void cast_one(const CastArguments *a, int64_t p, int64_t shape) {
    int64_t width = a->depth.shape[1], u0, u1, v0, v1;
    double from[3], turn[3][3];
    to_own_coordinates(a, p, from, turn);
    screen_rectangle(a, p, &u0, &u1, &v0, &v1);
    for (int64_t v = v0; v < v1; v++) {
        double *restrict depth = a->depth.data + v * width;
        int32_t *restrict index = a->index.data + v * width;
        double y = ((double)v - a->cy) / a->fy, base[3];
        for (int i = 0; i < 3; i++) base[i] = turn[i][1] * y + turn[i][2];
        for (int64_t u = u0; u < u1; u++) {
            double x = ((double)u - a->cx) / a->fx, d[3];
            for (int i = 0; i < 3; i++) d[i] = turn[i][0] * x + base[i];
            double t = hit_shape(shape, from, d);
            bool nearer = t < depth[u];
            depth[u] = nearer ? t : depth[u];
            index[u] = nearer ? (int32_t)p : index[u];
        }
    }
}

KERNEL(cast_primitives, CastArguments) {
    for (int64_t p = 0; p < a->primitives.shape.shape[0]; p++) {
        switch (a->primitives.shape.data[p]) {
        case 0: cast_one(a, p, 0); break;
        case 1: cast_one(a, p, 1); break;
        case 2: cast_one(a, p, 2); break;
        case 3: cast_one(a, p, 3); break;
        case 4: cast_one(a, p, 4); break;
        case 5: cast_one(a, p, 5); break;
        default: cast_one(a, p, 6);
        }
    }
    return 0;
}
