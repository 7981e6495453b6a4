/* Where a ray first meets a primitive of a room; see scenes/fast_cast.py. */
#pragma once

#include "kernels.h"

#define NEAR_M 0.02 /* nothing nearer than this is seen */
#define PILLOW_STEPS 10
#define PILLOW_ERROR 0.02 /* of x^4 + y^4 + z^4 at a hit */
#define TORUS_RING 0.7    /* radius of the tube's middle; that of the tube is 1 - TORUS_RING */
#define TORUS_STEPS 48
#define TORUS_CLOSE 1e-3 /* distance from which Newton's steps go on */
#define TORUS_POLISH 5
#define TORUS_ERROR 1e-6 /* distance at a hit */

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

/* A ring of round tube, drawn out in z so that it fills [-1, 1]^3. Sphere tracing comes near from outside, Newton's steps
 * do the rest; a ray that is not at the surface then has gone past. */
static inline double hit_torus(const double *o, const double *d) {
    const double tube = 1.0 - TORUS_RING;
    double near = -INFINITY, far = INFINITY;
    for (int i = 0; i < 3; i++) {
        double inverse = 1.0 / d[i], a = (-1.0 - o[i]) * inverse, b = (1.0 - o[i]) * inverse;
        near = max_d(near, min_d(a, b)), far = min_d(far, max_d(a, b));
    }
    double t = max_d(near, 0.0), oz = tube * o[2], dz = tube * d[2], away = 0.0;
    if (!(t <= far)) return INFINITY;
    double speed = sqrt(d[0] * d[0] + d[1] * d[1] + dz * dz);
    for (int k = 0; k < TORUS_STEPS + TORUS_POLISH; k++) {
        double x = o[0] + t * d[0], y = o[1] + t * d[1], z = oz + t * dz;
        double radial = sqrt(x * x + y * y), out = radial - TORUS_RING, length = sqrt(out * out + z * z);
        away = length - tube;
        if (k == 0 && away < -TORUS_ERROR) return INFINITY; /* starts inside */
        if (k < TORUS_STEPS && away > TORUS_CLOSE) {
            t += away / speed;
            if (t > far) return INFINITY;
            continue;
        }
        if (k < TORUS_STEPS) k = TORUS_STEPS;
        double slope = (out / radial * (x * d[0] + y * d[1]) + z * dz) / length;
        if (!(slope < 0.0)) break;
        t -= away / slope;
    }
    return fabs(away) <= TORUS_ERROR && t > NEAR_M ? t : INFINITY;
}

/* Half of a box: x + y <= 0 of [-1, 1]^3. */
static inline double hit_prism(const double *o, const double *d) {
    double near = -INFINITY, far = INFINITY;
    for (int i = 0; i < 3; i++) {
        double inverse = 1.0 / d[i], a = (-1.0 - o[i]) * inverse, b = (1.0 - o[i]) * inverse;
        near = max_d(near, min_d(a, b)), far = min_d(far, max_d(a, b));
    }
    double above = o[0] + o[1], climb = d[0] + d[1], t = -above / climb;
    if (climb < 0.0)
        near = max_d(near, t);
    else if (climb > 0.0)
        far = min_d(far, t);
    else if (above > 0.0)
        return INFINITY;
    return entry(near, far);
}

static inline double hit_shape(int64_t shape, const double *o, const double *d) {
    if (shape == 0) return hit_box(o, d);
    if (shape == 1) return hit_cylinder(o, d);
    if (shape == 2) return hit_sphere(o, d);
    if (shape == 3) return hit_frustum(o, d);
    if (shape == 4) return hit_pillow(o, d);
    return shape == 5 ? hit_torus(o, d) : hit_prism(o, d);
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
