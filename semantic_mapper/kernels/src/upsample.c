/* Joint bilateral upsampling of a coarse rendered view: see mapping/rendering.py. */
#include <math.h>

#include "kernels.h"
#include "simd.h"

typedef struct {
    I64 channel;  /* (h, w) likeliest class, -1 = unknown */
    U8 one_class; /* (h, w) */
} OneClassArguments;

/* Whether the 3x3 coarse pixels round each (as far as they are in the image) are known and of one class. */
KERNEL(find_one_class, OneClassArguments) {
    const int64_t height = a->channel.shape[0], width = a->channel.shape[1], *channel = a->channel.data;
    for (int64_t j = start; j < stop; j++)
        for (int64_t i = 0; i < width; i++) {
            bool same = channel[j * width + i] >= 0;
            for (int64_t y = max_i(j - 1, 0); y < min_i(j + 2, height); y++)
                for (int64_t x = max_i(i - 1, 0); x < min_i(i + 2, width); x++)
                    same = same && channel[y * width + x] == channel[j * width + i];
            a->one_class.data[j * width + i] = same;
        }
    return 0;
}

typedef struct {
    F32 probabilities; /* (h * w, L) */
    I64 channel;       /* (h, w) */
    U8 one_class;      /* (h, w) */
    F32 look;          /* (h, w, 4) colour and depth of the coarse pixels */
    U8 rgb;            /* (H, W, 3) */
    F32 depth;         /* (H, W) */
    I32 out;           /* (H, W) */
} UpsampleArguments;

#define COLOUR_RATE (1.0f / (2 * 20 * 20)) /* sigma of 20 8-bit steps */
#define DEPTH_RATE 50.0f                   /* sigma of 2 % of z */
#define LARGEST_STEP 8.0f  /* a depth that differs by more counts no more: then colour decides among the rest */
#define LEAST_WEIGHT 1e-9f /* where nothing looks alike, the coarse pixels still count alike */

/* The coarse pixels round one full pixel. */
typedef struct {
    int64_t count, index[9], channel[9];
    float weight[2 * LANES];
} Taps;

/* The tap of the largest weight among those of the class that all give the largest total, -1 without taps. */
static int64_t nearest_of_class(const Taps *taps, const F32 *probabilities) {
    const int64_t classes = probabilities->shape[1];
    int64_t best = -1, top = -1;
    float most = -1;
    for (int64_t a = 0; a < taps->count; a++) {
        if (taps->channel[a] == top) {
            if (taps->weight[a] > taps->weight[best]) best = a;
            continue;
        }
        float total = 0;
        for (int64_t b = 0; b < taps->count; b++)
            total += taps->weight[b] * probabilities->data[taps->index[b] * classes + taps->channel[a]];
        if (total > most) best = a, top = taps->channel[a], most = total;
    }
    return best >= 0 ? taps->index[best] : -1;
}

static void upsample_row(const UpsampleArguments *a, int64_t v) {
    const int64_t height = a->channel.shape[0], width = a->channel.shape[1], columns = a->depth.shape[1];
    const float scale_y = (float)((double)height / (double)a->depth.shape[0]);
    const float scale_x = (float)((double)width / (double)columns);
    const float y = ((float)v + 0.5f) * scale_y - 0.5f;
    const int64_t j0 = min_i(max_i((int64_t)floorf(y + 0.5f), 0), height - 1);
    for (int64_t u = 0; u < columns; u++) {
        const float x = ((float)u + 0.5f) * scale_x - 0.5f;
        const int64_t i0 = min_i(max_i((int64_t)floorf(x + 0.5f), 0), width - 1), at = v * columns + u;
        if (a->one_class.data[j0 * width + i0]) {
            a->out.data[at] = (int32_t)(j0 * width + i0);
            continue;
        }
        const uint8_t *rgb = a->rgb.data + 3 * at;
        const float z = a->depth.data[at], depth_rate = z > 0 ? DEPTH_RATE / z : 0.0f;
        Taps taps;
        taps.count = 0;
        store(taps.weight, splat(0)), store(taps.weight + LANES, splat(0));
        for (int64_t j = max_i(j0 - 1, 0); j < min_i(j0 + 2, height); j++)
            for (int64_t i = max_i(i0 - 1, 0); i < min_i(i0 + 2, width); i++) {
                const int64_t from = j * width + i;
                if (a->channel.data[from] < 0) continue;
                const float *look = a->look.data + 4 * from, dy = y - (float)j, dx = x - (float)i;
                const float r = rgb[0] - look[0], g = rgb[1] - look[1], b = rgb[2] - look[2];
                const float step = (z - look[3]) * depth_rate;
                float cost = (r * r + g * g + b * b) * COLOUR_RATE + dy * dy + dx * dx;
                if (look[3] > 0) cost += min_f(step * step, LARGEST_STEP);
                taps.index[taps.count] = from, taps.channel[taps.count] = a->channel.data[from];
                taps.weight[taps.count++] = -cost;
            }
        for (int64_t t = 0; t < taps.count; t += LANES)
            store(taps.weight + t, exp_below(load(taps.weight + t)) + LEAST_WEIGHT);
        a->out.data[at] = (int32_t)nearest_of_class(&taps, &a->probabilities);
    }
}

KERNEL(upsample_view, UpsampleArguments) {
    for (int64_t v = start; v < stop; v++) upsample_row(a, v);
    return 0;
}
