/* Where a ray first meets a primitive of a room; see scenes/fast_cast.py and, for the same in torch, tests/scenes/torch_renderer.py. */
#pragma once

#include "kernels.h"

#define NEAR_M 0.02 /* nothing nearer than this is seen */
#define PILLOW_STEPS 10
#define PILLOW_ERROR 0.02 /* of x^4 + y^4 + z^4 at a hit */

typedef struct {
    I64 shape;    /* (P,) primitives.Shape */
    F64 center;   /* (P, 3) metres */
    F64 half;     /* (P, 3) half extents along the primitive's own axes */
    F64 rotation; /* (P, 3, 3) own axes -> world */
} Primitives;

/* What follows is in the primitive's own coordinates, in which it is a unit shape: a ray o + t d, and t where the ray
 * enters; infinity where it does not, or starts inside. */

static inline double entry(double near, double far) { return near <= far && near > NEAR_M ? near : INFINITY; }

static inline double hit_box(const double *o, const double *d) {
    double ix = 1.0 / d[0], iy = 1.0 / d[1], iz = 1.0 / d[2];
    double ax = (-1.0 - o[0]) * ix, bx = (1.0 - o[0]) * ix;
    double ay = (-1.0 - o[1]) * iy, by = (1.0 - o[1]) * iy;
    double az = (-1.0 - o[2]) * iz, bz = (1.0 - o[2]) * iz;
    double near = max_d(max_d(min_d(ax, bx), min_d(ay, by)), min_d(az, bz));
    double far = min_d(min_d(max_d(ax, bx), max_d(ay, by)), max_d(az, bz));
    return entry(near, far);
}

static inline double hit_cylinder(const double *o, const double *d) {
    double a = d[0] * d[0] + d[1] * d[1];
    double b = o[0] * d[0] + o[1] * d[1];
    double c = o[0] * o[0] + o[1] * o[1] - 1.0;
    double discriminant = b * b - a * c;
    if (discriminant < 0.0) return INFINITY;
    double root = sqrt(discriminant), iz = 1.0 / d[2];
    double az = (-1.0 - o[2]) * iz, bz = (1.0 - o[2]) * iz;
    return entry(max_d((-b - root) / a, min_d(az, bz)), min_d((-b + root) / a, max_d(az, bz)));
}

static inline double hit_sphere(const double *o, const double *d) {
    double a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    double b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2];
    double c = o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - 1.0;
    double discriminant = b * b - a * c;
    if (discriminant < 0.0) return INFINITY;
    double root = sqrt(discriminant);
    return entry((-b - root) / a, (-b + root) / a);
}

/* Radius 0.8 - 0.2 z between z = -1 and 1: a slice of the lower half of a double cone with its tip at z = 4. */
static inline double hit_frustum(const double *o, const double *d) {
    double radius = 0.8 - 0.2 * o[2], slope = -0.2 * d[2];
    double a = d[0] * d[0] + d[1] * d[1] - slope * slope;
    double b = o[0] * d[0] + o[1] * d[1] - radius * slope;
    double c = o[0] * o[0] + o[1] * o[1] - radius * radius;
    double discriminant = b * b - a * c, near = -INFINITY, far = INFINITY;
    if (discriminant >= 0.0) {
        double root = sqrt(discriminant), first = (-b - root) / a, last = (-b + root) / a;
        if (a > 0.0)
            near = first, far = last;
        else if (slope < 0.0) /* going up: inside the lower half up to the earlier of the two crossings */
            far = last;
        else
            near = first;
    } else if (a > 0.0) {
        return INFINITY;
    }
    double iz = 1.0 / d[2], az = (-1.0 - o[2]) * iz, bz = (1.0 - o[2]) * iz;
    return entry(max_d(near, min_d(az, bz)), min_d(far, max_d(az, bz)));
}

/* x^4 + y^4 + z^4 = 1. Along a ray that sum is convex, so Newton's steps from outside never pass the first crossing; a
 * ray that is still outside after the last step, or going outwards, misses. */
static inline double hit_pillow(const double *o, const double *d) {
    double near = -INFINITY, far = INFINITY;
    for (int i = 0; i < 3; i++) {
        double inverse = 1.0 / d[i], a = (-1.0 - o[i]) * inverse, b = (1.0 - o[i]) * inverse;
        near = max_d(near, min_d(a, b)), far = min_d(far, max_d(a, b));
    }
    double t = max_d(near, 0.0), f = 0.0;
    if (!(t <= far)) return INFINITY;
    for (int k = 0; k < PILLOW_STEPS; k++) {
        double slope = 0.0;
        f = -1.0;
        for (int i = 0; i < 3; i++) {
            double x = o[i] + t * d[i], cube = x * x * x;
            f += cube * x, slope += 4.0 * cube * d[i];
        }
        if (k == 0 && f < -PILLOW_ERROR) return INFINITY; /* starts inside */
        if (!(slope < 0.0)) break;
        t -= max_d(f, 0.0) / slope;
    }
    return fabs(f) <= PILLOW_ERROR && t > NEAR_M ? t : INFINITY;
}

static inline double hit_shape(int64_t shape, const double *o, const double *d) {
    if (shape == 0) return hit_box(o, d);
    if (shape == 1) return hit_cylinder(o, d);
    if (shape == 2) return hit_sphere(o, d);
    return shape == 3 ? hit_frustum(o, d) : hit_pillow(o, d);
}

/* Ray parameter (infinity = miss) of one ray, and the number of the primitive (-1 = miss). */
static inline double first_hit(const Primitives *primitives, const double *origin, const double *ray, int64_t *index) {
    double nearest = INFINITY, square = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2];
    *index = -1;
    for (int64_t p = 0; p < primitives->shape.shape[0]; p++) {
        const double *center = primitives->center.data + 3 * p, *half = primitives->half.data + 3 * p;
        const double *rotation = primitives->rotation.data + 9 * p;
        double cx = center[0] - origin[0], cy = center[1] - origin[1], cz = center[2] - origin[2];
        double along = cx * ray[0] + cy * ray[1] + cz * ray[2];
        double reach = half[0] * half[0] + half[1] * half[1] + half[2] * half[2];
        if (cx * cx + cy * cy + cz * cz - along * along / square > reach) continue; /* past the sphere round it */
        double o[3], d[3];
        for (int i = 0; i < 3; i++) {
            o[i] = -(rotation[i] * cx + rotation[3 + i] * cy + rotation[6 + i] * cz) / half[i];
            d[i] = (rotation[i] * ray[0] + rotation[3 + i] * ray[1] + rotation[6 + i] * ray[2]) / half[i];
        }
        double t = hit_shape(primitives->shape.data[p], o, d);
        if (t < nearest) nearest = t, *index = p;
    }
    return nearest;
}
