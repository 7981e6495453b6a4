/* Color of every first hit: texture, ambient light, lamps with soft shadows, mirrors; see scenes/fast_shade.py. */
#include "fast_cast.h"
#include "fast_textures.h"

#define SHADOW_BIAS_M 0.03
#define LIGHT_RADIUS_SQ 0.5 /* softens the fall-off near a light, square metres */
#define CORNER_DIM 0.3      /* fraction of the ambient light that a wall, floor or ceiling takes from what touches it */
#define CORNER_REACH_M 0.18
#define SOFT_RIM 0.999 /* by day, the last thousandth of a cylinder's side shines as its lid does */

typedef struct {
    I64 pattern;                 /* (M,) materials.Pattern */
    F64 color_a, color_b;        /* (M, 3) linear RGB */
    F64 scale;                   /* (M,) metres */
    I64 seed;                    /* (M,) */
    F64 emission, gloss, mirror; /* (M,) */
} Materials;

typedef struct {
    F64 position, color; /* (N, 3) */
    F32 shadow;          /* (N, 6, S, S) depth of the first surface, a face of a cube round the light each */
    F64 softness;        /* (N,) pixels of the cube, at most 1 */
    F64 ambient, room;   /* (3,) */
    F32 low, high;       /* (N, 6, S, S) extremes of `shadow` round each pixel */
} Lights;

typedef struct {
    F64 depth; /* (H, W) along the camera's z */
    I32 index; /* (H, W) number of the primitive, -1 = none */
    F64 origin, camera_axes;
    double fx, fy, cx, cy;
    Primitives primitives;
    I64 material; /* (P,) of each primitive */
    Materials materials;
    Lights lights;
    F32 out; /* (H, W, 3) linear RGB, zeros */
} ShadeArguments;

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* Writes the unit normal in the primitive's own axes at the point `local`; returns its dominant axis. A cylinder's lid
 * begins at `rim`. */
static int own_normal(int64_t shape, const double *local, const double *half, double rim, double *own) {
    own[0] = own[1] = own[2] = 0.0;
    double qx = local[0] / half[0], qy = local[1] / half[1], qz = local[2] / half[2];
    if (shape == 0) {
        int axis = 2;
        if (fabs(qx) >= fabs(qy) && fabs(qx) >= fabs(qz))
            axis = 0;
        else if (fabs(qy) >= fabs(qz))
            axis = 1;
        own[axis] = local[axis] > 0 ? 1.0 : -1.0;
        return axis;
    }
    double radial = sqrt(qx * qx + qy * qy), radius = 0.8 - 0.2 * qz;
    bool lid = (shape == 1 && fabs(qz) >= radial * rim) || (shape == 3 && 1.0 - fabs(qz) < fabs(radial - radius));
    if (lid) {
        own[2] = local[2] > 0 ? 1.0 : -1.0;
        return 2;
    }
    double n[3] = {qx / half[0], qy / half[1], 0.0};
    if (shape == 6) { /* the nearest of five faces */
        double slant = fabs(qx + qy) * 0.7071067811865476, x = fabs(1.0 + qx), y = fabs(1.0 + qy), z = fabs(1.0 - fabs(qz));
        double least = min_d(min_d(slant, x), min_d(y, z));
        n[0] = least == slant ? 1.0 / half[0] : least == x ? -1.0 : 0.0;
        n[1] = least == slant ? 1.0 / half[1] : least == y && least != x ? -1.0 : 0.0;
        n[2] = least == z && least != slant && least != x && least != y ? (local[2] > 0 ? 1.0 : -1.0) : 0.0;
    } else if (shape == 5) {
        double out = (radial - TORUS_RING) / (radial * (1.0 - TORUS_RING) * (1.0 - TORUS_RING));
        n[0] *= out, n[1] *= out, n[2] = qz / half[2];
    } else if (shape == 2)
        n[2] = qz / half[2];
    else if (shape == 3)
        n[2] = 0.2 * radius / half[2];
    else if (shape == 4)
        n[0] *= qx * qx, n[1] *= qy * qy, n[2] = qz * qz * qz / half[2];
    double length = sqrt(dot(n, n));
    for (int i = 0; i < 3; i++) own[i] = n[i] / length;
    if (fabs(own[0]) >= fabs(own[1]) && fabs(own[0]) >= fabs(own[2])) return 0;
    return fabs(own[1]) >= fabs(own[2]) ? 1 : 2;
}

/* Writes the point `world` in primitive p's own axes, and the unit normal there; returns its dominant own axis. */
static int normal_at(const Primitives *primitives, int64_t p, const double *world, double rim, double *local,
                     double *normal) {
    const double *center = primitives->center.data + 3 * p, *rotation = primitives->rotation.data + 9 * p;
    double own[3];
    for (int i = 0; i < 3; i++) {
        local[i] = 0.0;
        for (int j = 0; j < 3; j++) local[i] += rotation[3 * j + i] * (world[j] - center[j]);
    }
    int axis = own_normal(primitives->shape.data[p], local, primitives->half.data + 3 * p, rim, own);
    for (int i = 0; i < 3; i++) normal[i] = dot(rotation + 3 * i, own);
    return axis;
}

/* Fraction of the ambient light that reaches a point: less near the room's walls, floor and ceiling. A room without end
 * has none. */
static double openness(const double *world, const double *normal, const double *room) {
    double fraction = 1.0;
    if (isinf(room[0])) return fraction;
    for (int i = 0; i < 3; i++) {
        if (fabs(normal[i]) < 0.7) {
            double low = world[i] / CORNER_REACH_M, high = (room[i] - world[i]) / CORNER_REACH_M;
            fraction *= (1.0 - CORNER_DIM / (1.0 + low * low)) * (1.0 - CORNER_DIM / (1.0 + high * high));
        }
    }
    return fraction;
}

/* Fraction of light k that reaches a point at (dx, dy, dz) from it: four spots of the shadow map, `softness` pixels off
 * the middle each way, each the weighted mean of four pixels. `low` and `high` answer at once wherever no edge of a
 * shadow is near. */
static double visible_fraction(const Lights *lights, int64_t k, double dx, double dy, double dz) {
    double ax = fabs(dx), ay = fabs(dy), az = fabs(dz), major, a, b;
    int64_t face;
    if (ax >= ay && ax >= az)
        face = dx > 0 ? 0 : 1, major = ax, a = dy, b = dz;
    else if (ay >= az)
        face = dy > 0 ? 2 : 3, major = ay, a = dz, b = dx;
    else
        face = dz > 0 ? 4 : 5, major = az, a = dx, b = dy;
    int64_t n = lights->shadow.shape[2], first = (k * 6 + face) * n * n;
    double u = (a / major + 1.0) * 0.5 * (double)n - 0.5, v = (b / major + 1.0) * 0.5 * (double)n - 0.5;
    double z = major - SHADOW_BIAS_M * (1.0 + 0.5 * major);
    int64_t middle = first + clip_pixel(floor(v + 0.5), n) * n + clip_pixel(floor(u + 0.5), n);
    if (lights->low.data[middle] >= z) return 1.0;
    if (lights->high.data[middle] < z) return 0.0;
    const float *shadow = lights->shadow.data + first;
    double softness = lights->softness.data[k], lit = 0.0;
    for (int corner = 0; corner < 4; corner++) {
        double x = u + (corner & 1 ? softness : -softness), y = v + (corner & 2 ? softness : -softness);
        double fx = floor(x), fy = floor(y), wx = x - fx, wy = y - fy;
        int64_t x0 = clip_pixel(fx, n), x1 = clip_pixel(fx + 1.0, n);
        const float *row0 = shadow + clip_pixel(fy, n) * n, *row1 = shadow + clip_pixel(fy + 1.0, n) * n;
        if (row0[x0] >= z) lit += (1 - wx) * (1 - wy);
        if (row0[x1] >= z) lit += wx * (1 - wy);
        if (row1[x0] >= z) lit += (1 - wx) * wy;
        if (row1[x1] >= z) lit += wx * wy;
    }
    return 0.25 * lit;
}

/* Writes the light (3,) that a point sends along `view`, before its own color. */
static void lighting(const Lights *lights, const double *world, const double *normal, const double *view, double gloss,
                     double *light) {
    double ambient = (0.75 + 0.25 * normal[2]) * openness(world, normal, lights->room.data);
    for (int i = 0; i < 3; i++) light[i] = lights->ambient.data[i] * ambient;
    double view_length = sqrt(dot(view, view));
    for (int64_t k = 0; k < lights->position.shape[0]; k++) {
        double l[3];
        for (int i = 0; i < 3; i++) l[i] = lights->position.data[3 * k + i] - world[i];
        double square = dot(l, l), length = sqrt(square), cosine = dot(normal, l) / length;
        if (cosine <= 0.0) continue;
        double lit = visible_fraction(lights, k, -l[0], -l[1], -l[2]);
        if (lit == 0.0) continue;
        double shine = 0.0;
        if (gloss > 0.0) {
            double h[3];
            for (int i = 0; i < 3; i++) h[i] = l[i] / length + view[i] / view_length;
            shine = dot(normal, h) / sqrt(dot(h, h));
            for (int n = 0; n < 4; n++) shine = shine * shine;
        }
        double strength = lit * (cosine + gloss * shine) / (square + LIGHT_RADIUS_SQ);
        for (int i = 0; i < 3; i++) light[i] += strength * lights->color.data[3 * k + i];
    }
}

/* Unit vector into which a mirror sends what is seen along `view`. */
static void mirror_ray(const double *view, const double *normal, double *ray) {
    double length = sqrt(dot(view, view)), facing = dot(normal, view) / length;
    for (int i = 0; i < 3; i++) ray[i] = 2.0 * facing * normal[i] - view[i] / length;
}

/* Adds the color of primitive p at the point `world`, seen along -`view`, to `out` (3,). */
static void shade_point(const ShadeArguments *a, int64_t p, double *world, double *view, float *out) {
    const Materials *materials = &a->materials;
    double fraction = 1.0; /* of this pixel that the surface at `world` makes up */
    double way = sqrt(dot(view, view)); /* of the light from there to the camera */
    for (int bounces = 0; bounces < 2 && p >= 0 && p < a->primitives.shape.shape[0]; bounces++) {
        double local[3], normal[3], albedo[3], light[3], ray[3];
        int axis = normal_at(&a->primitives, p, world, 1.0, local, normal);
        int64_t m = a->material.data[p];
        texture(materials->pattern.data[m], materials->color_a.data + 3 * m, materials->color_b.data + 3 * m,
                materials->scale.data[m], materials->seed.data[m], local, a->primitives.half.data + 3 * p, axis,
                way / a->fx / sqrt(max_d(dot(normal, view) / sqrt(dot(view, view)), 0.1)), albedo);
        lighting(&a->lights, world, normal, view, materials->gloss.data[m], light);
        double mirror = bounces == 0 ? materials->mirror.data[m] : 0.0; /* one in a mirror shows its own color */
        for (int i = 0; i < 3; i++) {
            double color = albedo[i] * (light[i] + materials->emission.data[m]);
            out[i] = (float)(out[i] + fraction * (1.0 - mirror) * color);
        }
        fraction *= mirror;
        if (!(fraction > 0.0)) return;
        mirror_ray(view, normal, ray);
        double t = first_hit(&a->primitives, world, ray, &p);
        for (int i = 0; i < 3; i++) world[i] = world[i] + t * ray[i], view[i] = -t * ray[i];
        way += t;
    }
}

typedef struct {
    F64 depth; /* (H, W) along the camera's z */
    I32 index; /* (H, W) number of the primitive, -1 = none */
    F64 origin, camera_axes;
    double fx, fy, cx, cy;
    Primitives primitives;
    F64 out; /* (H, W, 3) zeros */
} NormalArguments;

KERNEL(surface_normals, NormalArguments) {
    int64_t height = a->depth.shape[0], width = a->depth.shape[1];
    for (int64_t v = 0; v < height; v++) {
        for (int64_t u = 0; u < width; u++) {
            int64_t pixel = v * width + u, p = a->index.data[pixel];
            if (p < 0) continue;
            double z = a->depth.data[pixel], world[3], local[3];
            double own[3] = {((double)u - a->cx) / a->fx * z, ((double)v - a->cy) / a->fy * z, z};
            for (int i = 0; i < 3; i++) world[i] = a->origin.data[i] + dot(a->camera_axes.data + 3 * i, own);
            normal_at(&a->primitives, p, world, SOFT_RIM, local, a->out.data + 3 * pixel);
        }
    }
    return 0;
}

KERNEL(shade_hits, ShadeArguments) {
    int64_t height = a->depth.shape[0], width = a->depth.shape[1];
    const double *axes = a->camera_axes.data;
    for (int64_t v = 0; v < height; v++) {
        for (int64_t u = 0; u < width; u++) {
            int64_t pixel = v * width + u, p = a->index.data[pixel];
            if (p < 0) continue;
            double z = a->depth.data[pixel], world[3], view[3];
            double own[3] = {((double)u - a->cx) / a->fx * z, ((double)v - a->cy) / a->fy * z, z};
            for (int i = 0; i < 3; i++) {
                view[i] = -dot(axes + 3 * i, own);
                world[i] = a->origin.data[i] - view[i];
            }
            shade_point(a, p, world, view, a->out.data + 3 * pixel);
        }
    }
    return 0;
}
