/* Blocks that the rays of a depth image cross near their depth; see mapping/allocation.py. */
#include <stdlib.h>
#include <string.h>

#include "camera.h"
#include "grid_buffers.h"

#define TILE 8   /* pixels a side of the largest tiles that one ray may stand for; the smaller ones have 4, 2 and 1 */
#define LEVELS 4 /* of tiles */
#define TRAIL 8  /* blocks of the ray before that are kept in mind: most are the same again */

/* The blocks of one band of the image. */
typedef struct {
    int64_t *slots, slot_count; /* hash set of keys, EMPTY_KEY where there is none */
    int64_t *keys, capacity;    /* the same one after the other */
    int64_t count;              /* more than the capacity where there is no room */
    int64_t trail[TRAIL];       /* keys along the ray before; the last one is that of all further blocks */
} KeySet;

typedef struct {
    const float *depth; /* (height, width) metres */
    int64_t height, width;
    double fx, fy, cx, cy, R[9], t[3];
    double truncation;  /* metres */
    double per_block;   /* blocks a metre */
    float depth_max;    /* metres */
    float flat;         /* most that the depths of a tile may differ by, metres */
    float farthest[LEVELS]; /* depth from which on a tile of 1 << level pixels is too wide */
} View;

static void remember(KeySet *set, int64_t at, int64_t key) {
    if (key == set->trail[at]) return;
    set->trail[at] = key;
    if (set->count > set->capacity) return;
    int64_t slot = first_slot(key, set->slot_count);
    while (set->slots[slot] != EMPTY_KEY) {
        if (set->slots[slot] == key) return;
        slot = (slot + 1) & (set->slot_count - 1);
    }
    if (set->count < set->capacity) set->slots[slot] = set->keys[set->count] = key;
    set->count++;
}

/* Fraction of a way `d` from `a` after which the next whole number is crossed; `every`: and every further one. */
static double first_crossing(double a, double d, double *every) {
    *every = d != 0 ? 1.0 / fabs(d) : 1e300;
    return (d >= 0 ? floor(a) + 1.0 - a : a - floor(a)) * *every;
}

/* Adds the blocks that the ray of a pixel crosses between two depths, in that order (Amanatides & Woo). */
static void remember_ray(KeySet *set, const View *view, double u, double v, double near, double far) {
    double x = (u - view->cx) / view->fx, y = (v - view->cy) / view->fy, run = (far - near) * view->per_block;
    double a[3], d[3], next[3], every[3];
    int64_t block[3], step[3], steps = 0;
    for (int axis = 0; axis < 3; axis++) {
        const double *R = view->R + 3 * axis;
        d[axis] = R[0] * x + R[1] * y + R[2];
        a[axis] = (view->t[axis] + near * d[axis]) * view->per_block;
        d[axis] = d[axis] * run;
        block[axis] = floor_int(a[axis]);
        steps += llabs(floor_int(a[axis] + d[axis]) - block[axis]);
        next[axis] = first_crossing(a[axis], d[axis], &every[axis]);
        step[axis] = pack_step(axis, d[axis]);
    }
    int64_t key = pack_key(block[0], block[1], block[2]);
    remember(set, 0, key);
    for (int64_t n = 1; n <= steps; n++) {
        int axis = next[0] <= next[1] && next[0] <= next[2] ? 0 : next[1] <= next[2] ? 1 : 2;
        key += step[axis];
        next[axis] += every[axis];
        remember(set, min_i(n, TRAIL - 1), key);
    }
}

/* Adds the blocks on the ray of a tile, or of its corners at the edge of the image: nothing else is beyond those. */
static void remember_tile(KeySet *set, const View *view, int64_t u, int64_t v, int64_t side, float least, float most) {
    double near = max_d((double)least - view->truncation, 0.0), far = (double)most + view->truncation;
    double across = (double)(side - 1);
    bool inside = u > 0 && v > 0 && u < view->width - TILE && v < view->height - TILE;
    if (inside || side == 1) {
        remember_ray(set, view, (double)u + 0.5 * across, (double)v + 0.5 * across, near, far);
        return;
    }
    for (int corner = 0; corner < 4; corner++)
        remember_ray(set, view, (double)u + (corner & 1) * across, (double)v + (corner >> 1) * across, near, far);
}

/* Whether one ray speaks for a tile of 1 << level pixels a side: all measured, about as far, and not too wide. */
static bool is_smooth(const View *view, int level, float least, float most) {
    return least > 0 && most - least <= view->flat && most <= view->farthest[level];
}

/* Least and greatest depth of the tiles of a square of TILE x TILE pixels, by level: those of 1 << level pixels a side. */
typedef struct {
    float least[LEVELS][TILE][TILE], most[LEVELS][TILE][TILE];
} Tiles;

static void bound_tiles(const View *view, int64_t u0, int64_t v0, Tiles *tiles) {
    for (int64_t v = 0; v < TILE; v++)
        for (int64_t u = 0; u < TILE; u++) {
            bool inside = v0 + v < view->height && u0 + u < view->width;
            float value = inside ? view->depth[(v0 + v) * view->width + u0 + u] : 0.0f;
            tiles->least[0][v][u] = value > 0 && value <= view->depth_max ? value : 0.0f; /* NaN becomes 0, too */
            tiles->most[0][v][u] = tiles->least[0][v][u];
        }
    for (int level = 1; level < LEVELS; level++)
        for (int v = 0; v < TILE >> level; v++)
            for (int u = 0; u < TILE >> level; u++) {
                float(*low)[TILE] = tiles->least[level - 1] + 2 * v, (*high)[TILE] = tiles->most[level - 1] + 2 * v;
                int x = 2 * u, next = x + 1;
                tiles->least[level][v][u] = min_f(min_f(low[0][x], low[0][next]), min_f(low[1][x], low[1][next]));
                tiles->most[level][v][u] = max_f(max_f(high[0][x], high[0][next]), max_f(high[1][x], high[1][next]));
            }
}

/* Tile (v, u) of a level: its own ray where it is smooth, else those of its quarters. A smooth tile is at most two
 * voxels wide and deep. A block that none of the rays meets has then no more than a corner, less than a voxel wide,
 * between two of them: a few of a thousand blocks, often far from the surface. */
static void remember_tiles(KeySet *set, const View *view, const Tiles *tiles, int64_t u0, int64_t v0, int level, int v,
                           int u) {
    float least = tiles->least[level][v][u], most = tiles->most[level][v][u];
    if (most <= 0) return;
    if (is_smooth(view, level, least, most)) {
        remember_tile(set, view, u0 + (u << level), v0 + (v << level), 1 << level, least, most);
        return;
    }
    for (int quarter = 0; quarter < 4 && level > 0; quarter++)
        remember_tiles(set, view, tiles, u0, v0, level - 1, 2 * v + (quarter >> 1), 2 * u + (quarter & 1));
}

typedef struct {
    F32 depth; /* (H, W) metres */
    Camera camera;
    double voxel, truncation, depth_max; /* metres */
    I64 slots;                           /* (bands, S), S a power of two and more than the capacity */
    I64 keys;                            /* (bands, capacity) */
    I64 counts;                          /* (bands,) */
} CollectArguments;

KERNEL(collect_block_keys, CollectArguments) {
    const Camera *camera = &a->camera;
    View view = {
        .depth = a->depth.data,
        .height = a->depth.shape[0],
        .width = a->depth.shape[1],
        .fx = camera->fx,
        .fy = camera->fy,
        .cx = camera->cx,
        .cy = camera->cy,
        .truncation = a->truncation,
        .per_block = 1.0 / (a->voxel * BLOCK_SIDE),
        .depth_max = (float)a->depth_max,
        .flat = (float)(2 * a->voxel),
        .farthest = {(float)a->depth_max},
    };
    memcpy(view.R, camera->R.data, sizeof view.R);
    memcpy(view.t, camera->t.data, sizeof view.t);
    for (int level = 1; level < LEVELS; level++)
        view.farthest[level] = (float)(2 * a->voxel * min_d(camera->fx, camera->fy) / (1 << level));
    int64_t bands = a->counts.shape[0], strips = (view.height + TILE - 1) / TILE, capacity = a->keys.shape[1];
    for (int64_t band = start; band < stop; band++) {
        KeySet set = {a->slots.data + band * a->slots.shape[1], a->slots.shape[1],
                      a->keys.data + band * capacity, capacity, 0, {0}};
        for (int at = 0; at < TRAIL; at++) set.trail[at] = EMPTY_KEY;
        for (int64_t strip = band * strips / bands; strip < (band + 1) * strips / bands; strip++)
            for (int64_t u = 0; u < view.width && set.count <= capacity; u += TILE) {
                Tiles tiles;
                bound_tiles(&view, u, strip * TILE, &tiles);
                remember_tiles(&set, &view, &tiles, u, strip * TILE, LEVELS - 1, 0, 0);
            }
        a->counts.data[band] = set.count;
    }
    return 0;
}
