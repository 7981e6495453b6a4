/* Depth borders drawn to the edges of the image: see imaging.py. */
#include <math.h>

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

/* Depth at a pixel whose window holds surfaces at `low` and at `high`. */
static float choose_surface(const DrawArguments *a, const Window *w, int64_t pixel, float low, float high) {
    const int64_t width = a->filled.shape[1];
    const float own = a->filled.data[pixel], middle = 0.5f * (low + high);
    const uint8_t *colour = a->rgb.data + 3 * pixel;
    double count[2] = {0, 0}, sum[2] = {0, 0};
    for (int64_t y = w->top; y < w->bottom; y++)
        for (int64_t x = w->left; x < w->right; x++) {
            const int64_t other = y * width + x;
            const float z = a->measured.data[other];
            if (other == pixel || !(z > 0)) continue;
            double distance = 0;
            for (int c = 0; c < 3; c++) {
                const double difference = (double)a->rgb.data[3 * other + c] - (double)colour[c];
                distance += difference * difference;
            }
            const double weight = exp(-COLOUR_RATE * distance);
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

/* Whether depth leaps from one pixel to the next somewhere in the window: on a slanted surface it climbs. */
static bool has_leap(const DrawArguments *a, const Window *w) {
    const int64_t width = a->filled.shape[1];
    for (int64_t y = w->top; y < w->bottom; y++)
        for (int64_t x = w->left; x < w->right; x++) {
            const float *z = a->filled.data + y * width + x;
            if (x + 1 < w->right && apart(z[0], z[1])) return true;
            if (y + 1 < w->bottom && apart(z[0], z[width])) return true;
        }
    return false;
}

KERNEL(draw_borders_to_edges, DrawArguments) {
    const int64_t height = a->filled.shape[0], width = a->filled.shape[1];
    for (int64_t j = start; j < stop; j++)
        for (int64_t i = 0; i < width; i++) {
            const int64_t pixel = j * width + i;
            const Window w = {max_i(i - a->reach, 0), min_i(i + a->reach + 1, width), max_i(j - a->reach, 0),
                              min_i(j + a->reach + 1, height)};
            const float own = a->filled.data[pixel];
            float low = own, high = own;
            for (int64_t y = w.top; y < w.bottom; y++)
                for (int64_t x = w.left; x < w.right; x++) {
                    const float z = a->filled.data[y * width + x];
                    low = min_f(low, z), high = max_f(high, z);
                }
            const bool two = apart(low, high) && has_leap(a, &w);
            a->out.data[pixel] = two ? choose_surface(a, &w, pixel, low, high) : own;
        }
    return 0;
}
