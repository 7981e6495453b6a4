/* Depth borders drawn to the edges of the image: see imaging.py. */
#include <math.h>
#include <stdlib.h>

#include "kernels.h"

typedef struct {
    F32 filled, measured; /* (H, W) depth without holes; as measured, 0 = none */
    U8 rgb;               /* (H, W, 3) */
    F32 out;              /* (H, W) */
    int64_t reach;        /* pixels to either side */
} DrawArguments;

#define STEP 0.04 /* two surfaces are farther apart than STEP * z + STEP_M, as wide as the guided interval */
#define STEP_M 0.08
#define COLOUR_RATE (1 / (2 * 12.0 * 12.0)) /* a neighbour's colour counts with a sigma of 12 8-bit steps */
#define ADVANTAGE 1.5 /* times as much must the other surface count for a pixel to go over to it */

typedef struct {
    int64_t left, right, top, bottom;
} Window;

/* Depth at a pixel whose window holds surfaces at `low` and at `high`; `alike` is the weight of each difference of a
 * colour channel. */
static float choose_surface(const DrawArguments *a, const Window *w, int64_t pixel, float low, float high,
                            const double *alike) {
    const int64_t width = a->filled.shape[1];
    const float own = a->filled.data[pixel], middle = 0.5f * (low + high);
    const uint8_t *colour = a->rgb.data + 3 * pixel;
    double count[2] = {0, 0}, sum[2] = {0, 0};
    for (int64_t y = w->top; y < w->bottom; y++)
        for (int64_t x = w->left; x < w->right; x++) {
            const int64_t other = y * width + x;
            const float z = a->measured.data[other];
            if (other == pixel || !(z > 0)) continue;
            const uint8_t *its = a->rgb.data + 3 * other;
            double weight = alike[abs(its[0] - colour[0])];
            weight *= alike[abs(its[1] - colour[1])] * alike[abs(its[2] - colour[2])];
            const int side = z > middle;
            count[side] += weight, sum[side] += weight * (double)z;
        }
    const int here = own > middle, there = 1 - here;
    const bool goes_over = count[there] > ADVANTAGE * count[here] + 1e-3;
    return goes_over ? (float)(sum[there] / count[there]) : own;
}

static bool apart(float one, float other) {
    return (double)fabsf(one - other) > STEP * (double)min_f(one, other) + STEP_M;
}

/* Of the rows of a window, one column: its depth, and whether depth leaps within it, and to the next column. On a
 * slanted surface it climbs. */
typedef struct {
    float low, high;
    bool leaps, leaps_right;
} Column;

static void look_down(const DrawArguments *a, const Window *rows, Column *columns) {
    const int64_t width = a->filled.shape[1];
    for (int64_t x = 0; x < width; x++) columns[x] = (Column){INFINITY, 0, false, false};
    for (int64_t y = rows->top; y < rows->bottom; y++) {
        const float *z = a->filled.data + y * width;
        for (int64_t x = 0; x < width; x++) {
            columns[x].low = min_f(columns[x].low, z[x]), columns[x].high = max_f(columns[x].high, z[x]);
            columns[x].leaps |= y + 1 < rows->bottom && apart(z[x], z[x + width]);
            columns[x].leaps_right |= x + 1 < width && apart(z[x], z[x + 1]);
        }
    }
}

KERNEL(draw_borders_to_edges, DrawArguments) {
    const int64_t height = a->filled.shape[0], width = a->filled.shape[1];
    double alike[256];
    for (int i = 0; i < 256; i++) alike[i] = exp(-COLOUR_RATE * i * i);
    Column *columns = malloc((size_t)max_i(width, 1) * sizeof *columns);
    if (!columns) return 1;
    for (int64_t j = start; j < stop; j++) {
        Window w = {0, 0, max_i(j - a->reach, 0), min_i(j + a->reach + 1, height)};
        look_down(a, &w, columns);
        for (int64_t i = 0; i < width; i++) {
            w.left = max_i(i - a->reach, 0), w.right = min_i(i + a->reach + 1, width);
            Column all = columns[w.right - 1];
            for (int64_t x = w.left; x + 1 < w.right; x++) {
                all.low = min_f(all.low, columns[x].low), all.high = max_f(all.high, columns[x].high);
                all.leaps |= columns[x].leaps | columns[x].leaps_right;
            }
            const int64_t pixel = j * width + i;
            const bool two = all.leaps && apart(all.low, all.high);
            a->out.data[pixel] =
                two ? choose_surface(a, &w, pixel, all.low, all.high, alike) : a->filled.data[pixel];
        }
    }
    free(columns);
    return 0;
}
