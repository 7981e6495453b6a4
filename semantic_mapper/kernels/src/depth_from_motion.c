/* Depth from posed pictures: census, plane sweep, semi-global matching: see depth_from_motion/sweep.py. */
#include <math.h>
#include <string.h>

#include "kernels.h"
#include "simd.h"

#pragma clang fp contract(fast)

#define MAX_PLANES 256

typedef struct {
    U8 padded;  /* (H + 4 * spacing, W + 4 * spacing) image with a margin of 2 * spacing on each side */
    I32 census; /* (H, W) */
    int64_t spacing;
} CensusArguments;

/* One bit for each of the other pixels of 5x5, `spacing` apart: whether it is darker than the middle. */
KERNEL(compare_with_middle, CensusArguments) {
    const int64_t width = a->census.shape[1], stride = width + 4 * a->spacing;
    for (int64_t y = start; y < stop; y++) {
        int32_t *out = a->census.data + y * width;
        const uint8_t *middle = a->padded.data + (y + 2 * a->spacing) * stride + 2 * a->spacing;
        memset(out, 0, (size_t)width * sizeof *out);
        for (int64_t j = 0; j < 5; j++)
            for (int64_t i = 0; i < 5; i++) {
                if (i == 2 && j == 2) continue;
                const uint8_t *other = a->padded.data + (y + j * a->spacing) * stride + i * a->spacing;
                for (int64_t x = 0; x < width; x++) out[x] = out[x] << 1 | (other[x] < middle[x]);
            }
    }
    return 0;
}

typedef struct {
    I32 census;         /* (2h, 2w) of the reference; its pixels are every second one */
    I32 source_census;  /* (n, H, W) of the sources, the smaller ones with a margin to the right and below */
    I64 source_size;    /* (n, 2) height and width */
    F32 rotation;       /* (n, 3, 3) reference pixel (x, y, 1) to source pixel, times depth, without translation */
    F32 translation;    /* (n, 3) */
    F32 inverse_depth;  /* (D,) of each plane, D a multiple of 16 */
    F32 hint;           /* (h, w) expected plane, < 0 = none */
    F32 hint_rate;      /* (h, w) 1 / planes by which the hint may be off */
    U8 cost;            /* (h, w, D) */
    U8 seen;            /* (h, w) the most sources that see one plane of a pixel */
    int64_t unseen;     /* cost where no source sees a plane */
    double hint_cost;   /* of a plane far from the hint */
} SweepArguments;

INLINE IntLanes count_bits(IntLanes x) {
    x = x - ((x >> 1) & 0x55555555);
    x = (x & 0x33333333) + ((x >> 2) & 0x33333333);
    x = (x + (x >> 4)) & 0x0f0f0f0f;
    return (x * 0x01010101) >> 24;
}

INLINE IntLanes smaller_of(IntLanes a, IntLanes b) { return a < b ? a : b; }
INLINE IntLanes larger_of(IntLanes a, IntLanes b) { return a < b ? b : a; }

/* Where no source sees a plane: more than any number of different bits, but no overflow of a sum. */
#define NOT_SEEN 64

/* The two lowest numbers of different bits of each plane of one pixel, and how many sources see the plane. */
static void match_source(const SweepArguments *a, int64_t n, float x, float y, int32_t bits, int32_t *first,
                         int32_t *second, int32_t *views) {
    const int64_t planes = a->inverse_depth.shape[0], stride = a->source_census.shape[2];
    const int32_t *census = a->source_census.data + n * a->source_census.shape[1] * stride;
    const float *R = a->rotation.data + 9 * n, *t = a->translation.data + 3 * n;
    const float ru = R[0] * x + R[1] * y + R[2], rv = R[3] * x + R[4] * y + R[5], rz = R[6] * x + R[7] * y + R[8];
    const float height = (float)a->source_size.data[2 * n], width = (float)a->source_size.data[2 * n + 1];
    for (int64_t d = 0; d < planes; d += LANES) {
        const Lanes w = load(a->inverse_depth.data + d), z = rz + t[2] * w, scale = 1.0f / z;
        const Lanes u = (ru + t[0] * w) * scale, v = (rv + t[1] * w) * scale;
        /* Comparisons with NaN are false. A point must lie 5 cm before the source. */
        const IntLanes inside = (z > 0.05f * w) & (u >= 0.0f) & (v >= 0.0f) & (u < width) & (v < height);
        const Lanes none = splat(0.0f);
        const IntLanes column = __builtin_convertvector(inside ? u : none, IntLanes);
        const IntLanes row = __builtin_convertvector(inside ? v : none, IntLanes);
        const IntLanes at = row * (int32_t)stride + column;
        IntLanes other;
        for (int k = 0; k < LANES; k++) other[k] = census[at[k]];
        IntLanes cost = count_bits(other ^ bits), best, next, count;
        cost = inside ? cost : (IntLanes)NOT_SEEN;
        memcpy(&best, first + d, sizeof best), memcpy(&next, second + d, sizeof next);
        memcpy(&count, views + d, sizeof count);
        next = smaller_of(next, larger_of(best, cost)), best = smaller_of(best, cost), count -= inside;
        memcpy(first + d, &best, sizeof best), memcpy(second + d, &next, sizeof next);
        memcpy(views + d, &count, sizeof count);
    }
}

/* Sum of the costs of the two sources that match best, twice that of a single one; plus what the hint says. */
KERNEL(sweep_planes, SweepArguments) {
    const int64_t height = a->cost.shape[0], width = a->cost.shape[1], planes = a->cost.shape[2];
    const int64_t sources = a->source_size.shape[0];
    if (planes > MAX_PLANES || height <= 0) return 1;
    for (int64_t j = start; j < stop; j++)
        for (int64_t i = 0; i < width; i++) {
            int32_t first[MAX_PLANES], second[MAX_PLANES], views[MAX_PLANES];
            for (int64_t d = 0; d < planes; d++) first[d] = second[d] = NOT_SEEN, views[d] = 0;
            const int32_t bits = a->census.data[2 * j * a->census.shape[1] + 2 * i];
            for (int64_t n = 0; n < sources; n++)
                match_source(a, n, (float)i, (float)j, bits, first, second, views);
            const int64_t at = j * width + i;
            uint8_t *cost = a->cost.data + at * planes;
            const float hint = a->hint.data[at], rate = a->hint_rate.data[at], far = (float)a->hint_cost;
            int32_t most = 0;
            for (int64_t d = 0; d < planes; d++) {
                const int32_t n = views[d];
                int32_t value = n > 1 ? first[d] + second[d] : n ? 2 * first[d] : (int32_t)a->unseen;
                if (hint >= 0) {
                    const float off = ((float)d - hint) * rate;
                    value += (int32_t)(far * min_f(off * off, 1.0f));
                }
                cost[d] = (uint8_t)(value < 255 ? value : 255);
                most = most < n ? n : most;
            }
            a->seen.data[at] = (uint8_t)most;
        }
    return 0;
}

typedef struct {
    U8 cost;         /* (h, w, D) */
    U8 gray;         /* (h, w) of the reference */
    I16 large_step;  /* (256,) P2 by the difference of two pixels' gray */
    U16 sum;         /* (3, h, w, D) of the paths to the sides, down and up */
    U8 buffer;       /* (3, bytes) of `path_buffer_bytes` */
    int64_t small_step;
} PathArguments;

#define WIDE 16
typedef int16_t Shorts __attribute__((ext_vector_type(WIDE)));
typedef uint8_t Bytes __attribute__((ext_vector_type(WIDE)));
#define FAR_COST 16000

INLINE Shorts load_shorts(const int16_t *from) {
    Shorts value;
    memcpy(&value, from, sizeof value);
    return value;
}

INLINE Shorts lower(Shorts a, Shorts b) { return a < b ? a : b; }

INLINE int16_t lowest(Shorts x) {
    x = lower(x, __builtin_shufflevector(x, x, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7));
    x = lower(x, __builtin_shufflevector(x, x, 4, 5, 6, 7, 0, 1, 2, 3, 12, 13, 14, 15, 8, 9, 10, 11));
    x = lower(x, __builtin_shufflevector(x, x, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13));
    return x[0] < x[1] ? x[0] : x[1];
}

/* Costs along a path at one pixel: before[0] is the lowest of the pixel before, before[1 + d] its costs, between two
 * that are far. Adds them to `sum`. */
INLINE void step_along(const uint8_t *cost, const int16_t *before, int16_t *here, uint16_t *sum, int64_t planes,
                       int16_t small, int16_t large) {
    const int16_t base = before[0];
    const Shorts jump = (Shorts)(int16_t)(base + large);
    Shorts least = (Shorts)(int16_t)FAR_COST;
    for (int64_t d = 0; d < planes; d += WIDE) {
        Bytes raw;
        memcpy(&raw, cost + d, sizeof raw);
        const int16_t *b = before + 2 + d;
        const Shorts beside = lower(load_shorts(b - 1), load_shorts(b + 1)) + small;
        const Shorts value = __builtin_convertvector(raw, Shorts) + lower(lower(load_shorts(b), beside), jump) - base;
        Shorts total = load_shorts((const int16_t *)sum + d) + value;
        memcpy(here + 2 + d, &value, sizeof value), memcpy(sum + d, &total, sizeof total);
        least = lower(least, value);
    }
    here[0] = lowest(least);
}

/* The state of a path: its lowest cost, a far one, the costs, a far one. */
static int64_t state_size(int64_t planes) { return planes + 4; }

static void start_path(int16_t *state, int64_t planes) {
    memset(state, 0, (size_t)state_size(planes) * sizeof *state);
    state[1] = state[planes + 2] = FAR_COST;
}

static int16_t step_cost(const PathArguments *a, int64_t from, int64_t to) {
    const int difference = (int)a->gray.data[from] - (int)a->gray.data[to];
    return a->large_step.data[difference < 0 ? -difference : difference];
}

static void sweep_rows(const PathArguments *a, uint16_t *sum, int16_t *states) {
    const int64_t height = a->cost.shape[0], width = a->cost.shape[1], planes = a->cost.shape[2];
    const int64_t size = state_size(planes);
    for (int64_t y = 0; y < height; y++)
        for (int way = 1; way >= -1; way -= 2) {
            start_path(states, planes), start_path(states + size, planes);
            int turn = 0;
            for (int64_t k = 0; k < width; k++, turn ^= 1) {
                const int64_t at = y * width + (way > 0 ? k : width - 1 - k);
                const int16_t large = k ? step_cost(a, at - way, at) : (int16_t)a->small_step;
                step_along(a->cost.data + at * planes, states + turn * size, states + (turn ^ 1) * size,
                           sum + at * planes, planes, (int16_t)a->small_step, large);
            }
        }
}

static void sweep_columns(const PathArguments *a, uint16_t *sum, int16_t *states, int way) {
    const int64_t height = a->cost.shape[0], width = a->cost.shape[1], planes = a->cost.shape[2];
    const int64_t size = state_size(planes), row = 3 * width * size;
    int16_t *fresh = states + 2 * row;
    start_path(fresh, planes);
    for (int64_t k = 0; k < 2 * 3 * width; k++) start_path(states + k * size, planes);
    for (int64_t k = 0; k < height; k++) {
        const int64_t y = way > 0 ? k : height - 1 - k;
        const int16_t *above = states + (k & 1) * row;
        int16_t *current = states + ((k + 1) & 1) * row;
        for (int64_t x = 0; x < width; x++)
            for (int64_t lean = -1; lean <= 1; lean++) { /* paths from the left, straight and from the right */
                const int64_t from = x + lean, at = y * width + x;
                const bool begins = k == 0 || from < 0 || from >= width;
                const int16_t *before = begins ? fresh : above + (3 * from + lean + 1) * size;
                const int16_t large = begins ? (int16_t)a->small_step : step_cost(a, (y - way) * width + from, at);
                step_along(a->cost.data + at * planes, before, current + (3 * x + lean + 1) * size, sum + at * planes,
                           planes, (int16_t)a->small_step, large);
            }
    }
}

/* Sums of the costs along 8 paths; the loop runs over their three groups. */
KERNEL(sum_paths, PathArguments) {
    const int64_t volume = a->cost.shape[0] * a->cost.shape[1] * a->cost.shape[2];
    for (int64_t group = start; group < stop; group++) {
        uint16_t *sum = a->sum.data + group * volume;
        int16_t *states = (int16_t *)(void *)(a->buffer.data + group * a->buffer.shape[1]);
        memset(sum, 0, (size_t)volume * sizeof *sum);
        if (group == 0)
            sweep_rows(a, sum, states);
        else
            sweep_columns(a, sum, states, group == 1 ? 1 : -1);
    }
    return 0;
}

typedef struct {
    U16 sum;        /* (3, h, w, D), of which the first becomes the sum of all three */
    F32 plane;      /* (h, w) lowest, between planes */
    F32 confidence; /* (h, w) 0 to 1: how much the next best, two planes away or more, costs above it */
} PickArguments;

KERNEL(pick_planes, PickArguments) {
    const int64_t width = a->sum.shape[2], planes = a->sum.shape[3], volume = a->sum.shape[1] * width * planes;
    for (int64_t at = start * width; at < stop * width; at++) {
        uint16_t *s = a->sum.data + at * planes;
        const uint16_t *t = s + volume, *u = t + volume;
        for (int64_t d = 0; d < planes; d++) s[d] = (uint16_t)(s[d] + t[d] + u[d]);
        int64_t best = 0;
        for (int64_t d = 1; d < planes; d++)
            if (s[d] < s[best]) best = d;
        uint16_t next = UINT16_MAX;
        for (int64_t d = 0; d < planes; d++)
            if ((d < best - 1 || d > best + 1) && s[d] < next) next = s[d];
        float offset = 0.0f;
        if (best > 0 && best + 1 < planes) {
            const float left = s[best - 1], middle = s[best], right = s[best + 1], bend = left - 2 * middle + right;
            if (bend > 0) offset = 0.5f * (left - right) / bend;
        }
        a->plane.data[at] = (float)best + offset;
        a->confidence.data[at] = next > 0 ? (float)(next - s[best]) / (float)next : 0.0f;
    }
    return 0;
}

typedef struct {
    F32 depth;           /* (h, w) of the reference, 0 = none */
    F32 neighbour_depth; /* (n, H, W) 0 = none */
    I64 neighbour_size;  /* (n, 2) height and width */
    F32 rotation;        /* (n, 3, 3) reference pixel (x, y, 1) to neighbour pixel, times depth, without translation */
    F32 translation;     /* (n, 3) */
    U8 agree;            /* (h, w) neighbours whose depth agrees */
    U8 visible;          /* (h, w) neighbours with a depth there */
    F32 mean;            /* (h, w) depth, the mean with those that agree in inverse depth */
    double tolerance;    /* fraction of the depth */
} AgreementArguments;

KERNEL(count_agreement, AgreementArguments) {
    const int64_t width = a->depth.shape[1], rows = a->neighbour_depth.shape[1], stride = a->neighbour_depth.shape[2];
    for (int64_t j = start; j < stop; j++)
        for (int64_t i = 0; i < width; i++) {
            const int64_t at = j * width + i;
            const float depth = a->depth.data[at], x = (float)i, y = (float)j;
            int agree = 0, visible = 0;
            float sum = depth > 0 ? 1.0f / depth : 0.0f;
            for (int64_t n = 0; n < a->neighbour_size.shape[0] && depth > 0; n++) {
                const float *R = a->rotation.data + 9 * n, *t = a->translation.data + 3 * n;
                const float z = (R[6] * x + R[7] * y + R[8]) * depth + t[2];
                if (!(z > 0.05f)) continue;
                const float u = ((R[0] * x + R[1] * y + R[2]) * depth + t[0]) / z + 0.5f;
                const float v = ((R[3] * x + R[4] * y + R[5]) * depth + t[1]) / z + 0.5f;
                if (!(u >= 0 && v >= 0 && u < (float)a->neighbour_size.data[2 * n + 1] &&
                      v < (float)a->neighbour_size.data[2 * n]))
                    continue;
                const float other = a->neighbour_depth.data[(n * rows + (int64_t)v) * stride + (int64_t)u];
                if (!(other > 0)) continue;
                visible++;
                if (!(fabsf(other - z) < (float)a->tolerance * z)) continue;
                agree++, sum += z / (other * depth);
            }
            a->agree.data[at] = (uint8_t)agree, a->visible.data[at] = (uint8_t)visible;
            a->mean.data[at] = depth > 0 ? (float)(agree + 1) / sum : 0.0f;
        }
    return 0;
}

typedef struct {
    F32 depth, sigma;         /* (h, w) 0 = none */
    U8 coarse_rgb;            /* (h, w, 3) */
    U8 rgb;                   /* (H, W, 3) */
    F32 out_depth, out_sigma; /* (H, W) */
} EnlargeArguments;

#define SAME_SURFACE 0.05f /* fraction of the depth by which pixels of one surface differ at most */
/* A coarse pixel counts by about exp(-rate * squared distance of the colours): sigma of 20 8-bit steps. */
#define COLOUR_RATE (1.0f / (2 * 20 * 20))

/* Depth of a full pixel: of the coarse pixels round it, those of the surface that looks most like it, averaged. */
static void enlarge_pixel(const EnlargeArguments *a, int64_t v, int64_t u, float y, float x) {
    const int64_t height = a->depth.shape[0], width = a->depth.shape[1], at = v * a->out_depth.shape[1] + u;
    const int64_t j0 = (int64_t)(y + 0.5f), i0 = (int64_t)(x + 0.5f);
    const uint8_t *colour = a->rgb.data + 3 * at;
    float z[9], sigma[9], weight[9], best = 0;
    int count = 0, chosen = 0;
    for (int64_t j = max_i(j0 - 1, 0); j < min_i(j0 + 2, height); j++)
        for (int64_t i = max_i(i0 - 1, 0); i < min_i(i0 + 2, width); i++) {
            const int64_t from = j * width + i;
            if (!(a->depth.data[from] > 0)) continue;
            const uint8_t *other = a->coarse_rgb.data + 3 * from;
            float distance = 0;
            for (int c = 0; c < 3; c++) distance += (float)((other[c] - colour[c]) * (other[c] - colour[c]));
            const float dy = y - (float)j, dx = x - (float)i;
            z[count] = a->depth.data[from], sigma[count] = a->sigma.data[from];
            const float near = 1.0f / (1.0f + 0.25f * (COLOUR_RATE * distance + 0.7f * (dy * dy + dx * dx)));
            weight[count++] = near * near * near * near; /* about exp of the negative sum */
        }
    if (!count) return; /* none stays 0 */
    for (int k = 0; k < count; k++) {
        float support = 0;
        for (int m = 0; m < count; m++)
            if (fabsf(z[m] - z[k]) < SAME_SURFACE * z[k]) support += weight[m];
        if (support > best) best = support, chosen = k;
    }
    float sum = 0, spread = 0, total = 0;
    for (int m = 0; m < count; m++)
        if (fabsf(z[m] - z[chosen]) < SAME_SURFACE * z[chosen])
            sum += weight[m] / z[m], spread += weight[m] * sigma[m], total += weight[m];
    a->out_depth.data[at] = total / sum, a->out_sigma.data[at] = spread / total;
}

KERNEL(enlarge_depth, EnlargeArguments) {
    const int64_t height = a->depth.shape[0], width = a->depth.shape[1], columns = a->out_depth.shape[1];
    const float scale_y = (float)((double)height / (double)a->out_depth.shape[0]);
    const float scale_x = (float)((double)width / (double)columns);
    for (int64_t v = start; v < stop; v++) {
        const float y = min_f(max_f(((float)v + 0.5f) * scale_y - 0.5f, 0.0f), (float)(height - 1));
        const int64_t j = min_i((int64_t)y, height - 2 < 0 ? 0 : height - 2), below = height > 1 ? width : 0;
        for (int64_t u = 0; u < columns; u++) {
            const float x = min_f(max_f(((float)u + 0.5f) * scale_x - 0.5f, 0.0f), (float)(width - 1));
            const int64_t i = min_i((int64_t)x, width - 2 < 0 ? 0 : width - 2), beside = width > 1;
            const float *z = a->depth.data + j * width + i, *sigma = a->sigma.data + j * width + i;
            const float low = min_f(min_f(z[0], z[beside]), min_f(z[below], z[below + beside]));
            const float high = max_f(max_f(z[0], z[beside]), max_f(z[below], z[below + beside]));
            if (!(low > 0) || high - low > SAME_SURFACE * low) {
                enlarge_pixel(a, v, u, y, x);
                continue;
            }
            const float fy = y - (float)j, fx = x - (float)i, at[4] = {(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx};
            a->out_depth.data[v * columns + u] =
                1.0f / (at[0] / z[0] + at[1] / z[beside] + at[2] / z[below] + at[3] / z[below + beside]);
            a->out_sigma.data[v * columns + u] = at[0] * sigma[0] + at[1] * sigma[beside] + at[2] * sigma[below] +
                                                 at[3] * sigma[below + beside];
        }
    }
    return 0;
}

typedef struct {
    F32 data, weight; /* (h, w) values, and how much each counts */
    F32 right, below; /* (h, w) how much a pixel is tied to the one to the right, and below; last ones 0 */
    F32 out;          /* (h, w) first guess, then the solution */
    int64_t iterations;
    double relaxation; /* 1 to 2 */
} MembraneArguments;

/* Minimum of sum weight (out - data)^2 + sum tie (difference of neighbours)^2, by red-black over-relaxation. */
KERNEL(relax_membrane, MembraneArguments) {
    const int64_t height = a->out.shape[0], width = a->out.shape[1];
    const float *right = a->right.data, *below = a->below.data, omega = (float)a->relaxation;
    float *out = a->out.data;
    for (int64_t turn = 0; turn < 2 * a->iterations; turn++)
        for (int64_t y = 0; y < height; y++)
            for (int64_t x = (y + turn) & 1; x < width; x += 2) {
                const int64_t at = y * width + x;
                float sum = a->weight.data[at] * a->data.data[at], total = a->weight.data[at] + 1e-12f;
                if (x > 0) sum += right[at - 1] * out[at - 1], total += right[at - 1];
                if (x + 1 < width) sum += right[at] * out[at + 1], total += right[at];
                if (y > 0) sum += below[at - width] * out[at - width], total += below[at - width];
                if (y + 1 < height) sum += below[at] * out[at + width], total += below[at];
                out[at] += omega * (sum / total - out[at]);
            }
    return 0;
}
