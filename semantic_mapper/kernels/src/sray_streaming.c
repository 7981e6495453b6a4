/* S-Ray's renderer as one pass over each ray: reproject, gather, attend, blend, composite, without temporaries.
 *
 * The same arithmetic as SRay.render_samples in fields/sray.py, which stays the readable reference, with what only
 * costs time left out: samples outside a view are dropped instead of masked, what is linear is computed once a ray, and
 * nothing leaves the cache between two steps. "Eq." are the equations of the paper (S-Ray, CVPR 2023).
 *
 * Shapes: m views, R rays, N samples, C channels, L classes. A token is one (view, sample) pair, of a ray's T at most.
 */
#include <math.h>
#include <stdlib.h>

#include "kernels.h"

#pragma clang fp contract(fast)
#include "simd.h"

enum {
    CUES = 4,        /* hit, visibility, view cosine, logarithm of the depth's spread */
    OWN = 4,         /* place of one more, of tokens at the surface: whether the view is the query's own */
    COLOUR = 5,      /* place of the colour behind the cues */
    ROW_EXTRA = 8,   /* columns of a token beyond its features: cues, own, colour */
    GEOMETRY = 5,    /* mu_1, s_1, mu_2, s_2, weight of the first: a mixture of two logistics over depth */
    SAMPLE_CUES = 4, /* what DensityNet gets beside mean and variance of the features and colours */
    ROWS = 4,        /* that a matrix product works on at a time */
};

typedef struct {
    F32 origin, direction; /* (R, 3) */
    F32 z;                 /* (R, N), N >= 2, ascending */
    F32 own_factor;        /* (R,) times which the own view's weight counts, of tokens at the surface */
} Rays;

typedef struct {
    F32 feature;   /* (m, h, w, C) */
    F32 rgb;       /* (m, h, w, 3) */
    F32 geometry;  /* (m, h, w, GEOMETRY) */
    F32 log_scale; /* (m, h, w): of s_1 */
    F32 K;         /* (m, 4): fx, fy, cx, cy */
    F32 T;         /* (m, 3, 4): world -> camera */
    I16 labels;    /* (m, H, W) known labels, -1 = none; (m, 0, 0) where no view has any */
} SourceMaps;

typedef struct {
    int64_t heads;
    int64_t at_surface;        /* one token a view for the attention across views and for blending */
    double colour_scale;       /* of the colours whose moments the density depends on; 0 = on none */
    double sample_weight_threshold; /* samples of a smaller fraction of their ray's weight are not attended to */
    double log_ratio;          /* ln(1 / tau) of Eq. 12 */
    double hidden_below;       /* visibility below which a view is left out where another one sees the sample */
    double least_visibility;   /* added to each visibility that is a weight */
    double label_uncertainty;  /* hit probability at which a label that a view carries over counts by half */
    double own_density_offset; /* of the density that the network adds */
    double min_depth;          /* metres before a source camera */
    double background;         /* metres to what a ray meets that meets nothing */
    double own_radius;         /* metres from the ray's origin within which a camera is the query's own */
} Settings;

typedef struct {
    F32 weight, bias; /* (in, out), (out,); of layers with two outputs (2, in), (2,) */
} Layer;

typedef struct {
    F32 qkv, out; /* (C, 3 C), (C, C); (0, 0) where the model has no such attention */
} Attention;

typedef struct {
    Attention radial, cross;
    Layer view_hidden, view_scores;        /* ViewWeightNet; the second layer (2, in) */
    Layer density_hidden, density_token;   /* DensityNet.token */
    F32 density_qkv;                       /* (D, 3 D) */
    Layer density_out_hidden, density_out; /* DensityNet.out; the second layer (2, in) */
    Layer semantic_hidden, semantic_out;   /* SRay.semantic */
} Weights;

typedef struct {
    F32 feature; /* (R, C) composited, before the classifier */
    F32 colour;  /* (R, 3) */
    F32 depth;   /* (R,) metres */
    F32 opacity; /* (R,) */
    U8 known;    /* (R,) some view sees some sample */
    F32 carried; /* (R, L) composited labels of the views */
} Rendered;

typedef struct {
    Rays rays;
    SourceMaps maps;
    Settings settings;
    Weights weights;
    Rendered out;
} RenderArguments;

/* Buffers of one thread, for one ray at a time. Lists that vectors run over have a multiple of 8 elements, matrices a
 * multiple of 4 rows; what stands beyond the end means nothing. */
typedef struct {
    int64_t channels, samples, views, classes;
    int64_t stride;                            /* floats of a token */
    int64_t view_width, density_width, hidden; /* outputs of view_hidden, density_token, semantic_hidden (H) */
    int64_t density_inputs;                    /* of density_hidden */

    /* Tokens, in the order of the views and then of the samples; behind them, from token `far` on, one a view at the
     * background, in no order of samples. */
    int64_t far;
    float *tokens;                        /* (T, stride): features, CUES, own, colour */
    float *normed, *surface;              /* (T, stride), (m, stride) layer norms; one token a view */
    int64_t *sees_far;                    /* (m,) whether the direction of the ray lies in a view */
    float *surface_visible, *own_view;    /* (m,) */
    float *hit, *visible;                 /* (T,) */
    float *depth, *half;                  /* (T,) of the sample in the view, and half the sample's interval */
    float *mixture[GEOMETRY];             /* (T,) what the view knows of the surface there */
    int64_t *sample_of, *label;           /* (T,) */
    float *semantic_score, *colour_score; /* (T,) */
    float *qkv, *mixed, *view_hidden;     /* (T, 3 C), (T, C), (T, view_width) */
    int64_t *every;                       /* (max(T, H),) 0, 1, 2, ... */
    int64_t *view_start;                  /* (m + 1,) where the tokens of a view begin */
    int64_t *by_sample, *sample_size;     /* (N, m), (N,) tokens of each sample, and how many */

    /* Samples. */
    float *z, *delta, *sigma;                 /* (N,) depth, interval length, density */
    float *weight, *looked_at, *clearest;     /* (N,) of compositing; the same without pruned samples; best visibility */
    float *density_input, *density_hidden;    /* (N, density_inputs), (N, the wider of two hidden layers) */
    float *density_token, *density_qkv;       /* (N, D), (N, 3 D) */
    float *density_mixed;                     /* (N, D) */
    float *gain, *own;                        /* (N,) */
    int64_t *seen;                            /* (N,) samples that some view sees */
    float *s, *semantic_hidden, *kept_weight; /* (N, C), (N, H), (N,) of the samples that are looked at */
    float *composited_hidden, *composited;    /* (H,), (C,) */

    /* Attention among up to max(m, N) tokens, and blending. */
    float *keys, *scores, *padding; /* (max(C, D), group), (4 * group + 16,), (group,) */
    float *view_share;              /* (m,) */
} Scratch;

/* Gives parts of one allocation; without it only counts. */
typedef struct {
    char *next;
    size_t size;
} Arena;

static void *take(Arena *arena, int64_t count, size_t itemsize) {
    size_t bytes = ((size_t)count * itemsize + 63) & ~(size_t)63;
    char *here = arena->next ? arena->next + arena->size : NULL;
    arena->size += bytes;
    return here;
}

static float *take_floats(Arena *arena, int64_t count) { return take(arena, count, sizeof(float)); }
static int64_t *take_ints(Arena *arena, int64_t count) { return take(arena, count, sizeof(int64_t)); }

static void lay_out(Scratch *s, const Weights *w, Arena *arena) {
    int64_t C = s->channels, M = round_up(s->views, LANES), N = round_up(max_i(s->samples, s->views), LANES);
    int64_t T = round_up(s->views * s->samples, LANES) + M;
    s->far = T - M;
    int64_t D = s->density_width, group = round_up(max_i(s->views, s->samples), LANES);
    s->tokens = take_floats(arena, T * s->stride);
    s->normed = take_floats(arena, T * s->stride), s->surface = take_floats(arena, M * s->stride);
    s->sees_far = take_ints(arena, M), s->surface_visible = take_floats(arena, M);
    s->own_view = take_floats(arena, M);
    s->hit = take_floats(arena, T), s->visible = take_floats(arena, T);
    s->depth = take_floats(arena, T), s->half = take_floats(arena, T);
    for (int i = 0; i < GEOMETRY; i++) s->mixture[i] = take_floats(arena, T);
    s->sample_of = take_ints(arena, T), s->label = take_ints(arena, T);
    s->semantic_score = take_floats(arena, T), s->colour_score = take_floats(arena, T);
    s->qkv = take_floats(arena, T * 3 * C), s->mixed = take_floats(arena, T * C);
    s->view_hidden = take_floats(arena, T * s->view_width);
    s->every = take_ints(arena, max_i(T, s->hidden)), s->view_start = take_ints(arena, s->views + 1);
    s->by_sample = take_ints(arena, s->samples * s->views), s->sample_size = take_ints(arena, s->samples);
    s->z = take_floats(arena, N), s->delta = take_floats(arena, N), s->sigma = take_floats(arena, N);
    s->weight = take_floats(arena, N), s->looked_at = take_floats(arena, N), s->clearest = take_floats(arena, N);
    s->density_input = take_floats(arena, N * s->density_inputs);
    s->density_hidden = take_floats(arena, N * max_i(w->density_hidden.weight.shape[1],
                                                     w->density_out_hidden.weight.shape[1]));
    s->density_token = take_floats(arena, N * D), s->density_qkv = take_floats(arena, N * 3 * D);
    s->density_mixed = take_floats(arena, N * D);
    s->gain = take_floats(arena, N), s->own = take_floats(arena, N), s->seen = take_ints(arena, N);
    s->s = take_floats(arena, N * C), s->semantic_hidden = take_floats(arena, N * s->hidden);
    s->composited_hidden = take_floats(arena, s->hidden), s->composited = take_floats(arena, C);
    s->kept_weight = take_floats(arena, N);
    s->keys = take_floats(arena, max_i(C, D) * group), s->scores = take_floats(arena, 4 * group + 2 * LANES);
    s->padding = take_floats(arena, group), s->view_share = take_floats(arena, s->views);
}

/* ---- Building blocks ---- */

/* Sixteen outputs of four rows, which share each load of the weights: eight sums in registers. */
INLINE void four_rows(const float *x, int64_t x_stride, int64_t inputs, const float *weight, int64_t outputs,
                      const float *bias, float *out, int64_t out_stride) {
    Lanes sum[ROWS][2];
    for (int r = 0; r < ROWS; r++) {
        const float *start = bias ? bias : out + r * out_stride;
        sum[r][0] = load(start), sum[r][1] = load(start + LANES);
    }
    for (int64_t i = 0; i < inputs; i++) {
        Lanes near = load(weight + i * outputs), far = load(weight + i * outputs + LANES);
        for (int r = 0; r < ROWS; r++) {
            Lanes value = splat(x[r * x_stride + i]);
            sum[r][0] += value * near, sum[r][1] += value * far;
        }
    }
    for (int r = 0; r < ROWS; r++)
        store(out + r * out_stride, sum[r][0]), store(out + r * out_stride + LANES, sum[r][1]);
}

/* out[:rows] = x[:rows] weight + bias, or out[:rows] += x[:rows] weight where there is no bias. Works on whole groups
 * of four rows. */
INLINE void multiply_matrix(const float *x, int64_t x_stride, int64_t rows, const F32 *weight, const float *bias,
                            float *out, int64_t out_stride) {
    int64_t inputs = weight->shape[0], outputs = weight->shape[1], o = 0;
    for (; o + 2 * LANES <= outputs; o += 2 * LANES)
        for (int64_t t = 0; t < rows; t += ROWS)
            four_rows(x + t * x_stride, x_stride, inputs, weight->data + o, outputs, bias ? bias + o : NULL,
                      out + t * out_stride + o, out_stride);
    for (int64_t t = 0; t < rows; t++) {
        const float *row = x + t * x_stride;
        int64_t c = o;
        for (; c + LANES <= outputs; c += LANES) {
            Lanes sum = load(bias ? bias + c : out + t * out_stride + c);
            for (int64_t i = 0; i < inputs; i++) sum += splat(row[i]) * load(weight->data + i * outputs + c);
            store(out + t * out_stride + c, sum);
        }
        for (; c < outputs; c++) {
            float sum = bias ? bias[c] : out[t * out_stride + c];
            for (int64_t i = 0; i < inputs; i++) sum += row[i] * weight->data[i * outputs + c];
            out[t * out_stride + c] = sum;
        }
    }
}

/* A layer: out[:rows] = x[:rows] weight + bias. */
static void linear(const float *x, int64_t x_stride, int64_t rows, const Layer *layer, float *out) {
    multiply_matrix(x, x_stride, rows, &layer->weight, layer->bias.data, out, layer->weight.shape[1]);
}

/* The same for a layer without a bias: out[:rows] = x[:rows] weight. */
static void product(const float *x, int64_t x_stride, int64_t rows, const F32 *weight, float *out) {
    memset(out, 0, (size_t)(rows * weight->shape[1]) * sizeof(float));
    multiply_matrix(x, x_stride, rows, weight, NULL, out, weight->shape[1]);
}

/* A linear layer and ReLU. */
static void hidden_layer(const float *x, int64_t x_stride, int64_t rows, const Layer *layer, float *out) {
    linear(x, x_stride, rows, layer, out);
    for (int64_t i = 0; i < rows * layer->weight.shape[1]; i++) out[i] = max_f(out[i], 0.0f);
}

/* The two outputs of a layer whose weights are (2, in), a list each. */
static void two_outputs(const float *x, int64_t rows, const Layer *layer, float *first, float *second) {
    int64_t inputs = layer->weight.shape[1];
    const float *w = layer->weight.data, *v = w + inputs;
    for (int64_t t = 0; t < rows; t++) {
        const float *row = x + t * inputs;
        Lanes a = splat(0), b = splat(0);
        int64_t i = 0;
        for (; i + LANES <= inputs; i += LANES) {
            a += load(row + i) * load(w + i);
            b += load(row + i) * load(v + i);
        }
        first[t] = layer->bias.data[0] + total(a), second[t] = layer->bias.data[1] + total(b);
        for (; i < inputs; i++) first[t] += row[i] * w[i], second[t] += row[i] * v[i];
    }
}

/* out[:columns] = sum of weight[i] * x[row[i], :columns], i < count. */
static void weighted_sum(const float *x, int64_t stride, const int64_t *row, const float *weight, int64_t count,
                         int64_t columns, float *out) {
    int64_t c = 0;
    for (; c + 4 * LANES <= columns; c += 4 * LANES) { /* four sums at a time: one would wait for itself */
        Lanes sum[4] = {splat(0), splat(0), splat(0), splat(0)};
        for (int64_t i = 0; i < count; i++) {
            const float *from = x + row[i] * stride + c;
            for (int n = 0; n < 4; n++) sum[n] += splat(weight[i]) * load(from + n * LANES);
        }
        for (int n = 0; n < 4; n++) store(out + c + n * LANES, sum[n]);
    }
    for (; c + LANES <= columns; c += LANES) {
        Lanes sum = splat(0);
        for (int64_t i = 0; i < count; i++) sum += splat(weight[i]) * load(x + row[i] * stride + c);
        store(out + c, sum);
    }
    for (; c < columns; c++) {
        float sum = 0;
        for (int64_t i = 0; i < count; i++) sum += weight[i] * x[row[i] * stride + c];
        out[c] = sum;
    }
}

/* ---- Attention (Eq. 6 to 8) ---- */

/* Scores of one query with two keys, of four heads of eight channels: four with the first, then with the second. */
INLINE Lanes two_keys(const Lanes *query, const float *near, const float *far) {
    return totals(query[0] * load(near), query[1] * load(near + 8), query[2] * load(near + 16),
                  query[3] * load(near + 24), query[0] * load(far), query[1] * load(far + 8),
                  query[2] * load(far + 16), query[3] * load(far + 24));
}

/* Four heads of eight channels. A lane is a head, of two keys at a time: groups of a few tokens leave no lane empty,
 * and no sum goes across the lanes. */
static void attend_four_heads(const float *qkv, const int64_t *index, int64_t count, float *score, float *out) {
    enum { HEADS = 4, INNER = HEADS * LANES, WIDTH = 3 * INNER };
    const float rate = 1.0f / sqrtf(LANES);
    for (int64_t i = 0; i < count; i++) {
        Lanes query[HEADS], top = splat(-1e30f), sum = splat(0), mixed[HEADS];
        for (int h = 0; h < HEADS; h++) query[h] = load(qkv + index[i] * WIDTH + h * LANES) * rate;
        int64_t k = 0;
        for (; k + 1 < count; k += 2) {
            Lanes value = two_keys(query, qkv + index[k] * WIDTH + INNER, qkv + index[k + 1] * WIDTH + INNER);
            top = larger(top, value);
            store(score + HEADS * k, value);
        }
        if (k < count) {
            const float *last = qkv + index[k] * WIDTH + INNER;
            Lanes value = two_keys(query, last, last);
            top = larger(top, value);
            store(score + HEADS * k, value);
            for (int h = 0; h < HEADS; h++) score[HEADS * (k + 1) + h] = -1e30f; /* no key to make the pair whole */
        }
        top = larger(top, swap_halves(top));
        for (k = 0; k < count; k += 2) {
            Lanes value = exp_below(load(score + HEADS * k) - top);
            sum += value;
            store(score + HEADS * k, value);
        }
        sum = 1.0f / (sum + swap_halves(sum));
        for (int h = 0; h < HEADS; h++) mixed[h] = splat(0);
        for (k = 0; k < count; k++)
            for (int h = 0; h < HEADS; h++)
                mixed[h] += splat(score[HEADS * k + h]) * load(qkv + index[k] * WIDTH + 2 * INNER + h * LANES);
        for (int h = 0; h < HEADS; h++) store(out + index[i] * INNER + h * LANES, mixed[h] * splat(sum[h]));
    }
}

/* Any heads. A lane is a key. */
static void attend_any(const float *qkv, const int64_t *index, int64_t count, int64_t heads, int64_t inner, Scratch *s,
                       float *out) {
    int64_t width = 3 * inner, head_dim = inner / heads, padded = round_up(count, LANES);
    const float rate = 1.0f / sqrtf((float)head_dim);
    for (int64_t k = 0; k < padded; k++) s->padding[k] = k < count ? 0.0f : -1e30f;
    for (int64_t c = 0; c < inner; c++)
        for (int64_t k = 0; k < padded; k++)
            s->keys[c * padded + k] = k < count ? qkv[index[k] * width + inner + c] * rate : 0.0f;
    for (int64_t base = 0; base < inner; base += head_dim)
        for (int64_t i = 0; i < count; i++) {
            const float *query = qkv + index[i] * width;
            Lanes top = splat(-1e30f), sum = splat(0);
            for (int64_t k = 0; k < padded; k += LANES) {
                Lanes value = load(s->padding + k);
                for (int64_t c = base; c < base + head_dim; c++)
                    value += splat(query[c]) * load(s->keys + c * padded + k);
                top = larger(top, value);
                store(s->scores + k, value);
            }
            Lanes highest = splat(largest(top));
            for (int64_t k = 0; k < padded; k += LANES) {
                Lanes value = exp_below(load(s->scores + k) - highest);
                sum += value;
                store(s->scores + k, value);
            }
            const float share = 1.0f / total(sum);
            for (int64_t k = 0; k < count; k++) s->scores[k] *= share;
            weighted_sum(qkv + 2 * inner + base, width, index, s->scores, count, head_dim,
                         out + index[i] * inner + base);
        }
}

/* Among the `count` tokens qkv[index], (T, 3 inner) queries, keys and values; results go to out[index], (T, inner). */
static void attend(const float *qkv, const int64_t *index, int64_t count, int64_t heads, int64_t inner, Scratch *s,
                   float *out) {
    if (heads == 4 && inner == 4 * LANES) attend_four_heads(qkv, index, count, s->scores, out);
    else attend_any(qkv, index, count, heads, inner, s, out);
}

/* The tokens as the learned parts take them: with a layer norm of their features at the surface. */
static const float *normalised(Scratch *s, const Settings *set, int64_t count) {
    const int64_t C = s->channels;
    if (!set->at_surface) return s->tokens;
    memcpy(s->normed, s->tokens, (size_t)(count * s->stride) * sizeof(float));
    for (int64_t t = 0; t < count; t++) {
        float *row = s->normed + t * s->stride, mean = 0, square = 0;
        for (int64_t c = 0; c < C; c++) mean += row[c];
        mean /= (float)C;
        for (int64_t c = 0; c < C; c++) row[c] -= mean, square += row[c] * row[c];
        const float rate = 1.0f / sqrtf(square / (float)C + 1e-5f);
        for (int64_t c = 0; c < C; c++) row[c] *= rate;
    }
    return s->normed;
}

/* Queries, keys and values of all tokens. */
static void project_tokens(Scratch *s, const F32 *qkv, const Settings *set, int64_t count) {
    product(normalised(s, set, count), s->stride, count, qkv, s->qkv);
}

/* What the heads found is added to the tokens' features. */
static void merge_heads(Scratch *s, const F32 *out, int64_t count) {
    multiply_matrix(s->mixed, s->channels, count, out, NULL, s->tokens, s->stride);
}

/* Intra-view radial attention (Eq. 9): each view's tokens among themselves. */
static void attend_along_ray(Scratch *s, const Attention *w, const Settings *set, int64_t count) {
    project_tokens(s, &w->qkv, set, count);
    for (int64_t j = 0; j < s->views; j++)
        attend(s->qkv, s->every + s->view_start[j], s->view_start[j + 1] - s->view_start[j], set->heads, s->channels, s,
               s->mixed);
    merge_heads(s, &w->out, count);
}

/* Cross-view sparse attention (Eq. 10): each sample's tokens among themselves. */
static void attend_across_views(Scratch *s, const Attention *w, const Settings *set, int64_t count) {
    project_tokens(s, &w->qkv, set, count);
    for (int64_t k = 0; k < s->samples; k++)
        attend(s->qkv, s->by_sample + k * s->views, s->sample_size[k], set->heads, s->channels, s, s->mixed);
    merge_heads(s, &w->out, count);
}

/* ---- Tokens: the contextual space (Eq. 3 to 5) ---- */

/* Row or column of the nearest pixel, the border repeated. */
INLINE int64_t nearest(float place, int64_t size) { return min_i(max_i(lrintf(place), 0), size - 1); }

/* A token of view j at its pixel (u, v): bilinear features and colour, the nearest pixel's geometry and label. */
INLINE void gather_token(Scratch *s, const SourceMaps *maps, int64_t j, float u, float v, int64_t t) {
    const int64_t height = maps->feature.shape[1], width = maps->feature.shape[2], C = s->channels;
    const float x = min_f(max_f(u, 0.0f), (float)(width - 1)), y = min_f(max_f(v, 0.0f), (float)(height - 1));
    const int64_t x0 = (int64_t)x, y0 = (int64_t)y, x1 = min_i(x0 + 1, width - 1), y1 = min_i(y0 + 1, height - 1);
    const float fx = x - (float)x0, fy = y - (float)y0;
    const float w[4] = {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy};
    const int64_t upper = (j * height + y0) * width, lower = (j * height + y1) * width;
    const int64_t pixel[4] = {upper + x0, upper + x1, lower + x0, lower + x1};
    float *row = s->tokens + t * s->stride;
    weighted_sum(maps->feature.data, C, pixel, w, 4, C, row);
    for (int c = 0; c < 3; c++) {
        const float *rgb = maps->rgb.data + c;
        row[C + COLOUR + c] = w[0] * rgb[3 * pixel[0]] + w[1] * rgb[3 * pixel[1]] + w[2] * rgb[3 * pixel[2]] +
                            w[3] * rgb[3 * pixel[3]];
    }
    const int64_t at = (j * height + nearest(v, height)) * width + nearest(u, width);
    for (int i = 0; i < GEOMETRY; i++) s->mixture[i][t] = maps->geometry.data[at * GEOMETRY + i];
    row[C + 3] = maps->log_scale.data[at];
    const int64_t rows = maps->labels.shape[1], columns = maps->labels.shape[2];
    if (rows > 0 && columns > 0) {
        const int64_t m = nearest((v + 0.5f) * (float)((double)rows / (double)height) - 0.5f, rows);
        const int64_t n = nearest((u + 0.5f) * (float)((double)columns / (double)width) - 0.5f, columns);
        s->label[t] = maps->labels.data[(j * rows + m) * columns + n];
    }
}

/* Probability that a view's ray ends in the sample, and that it gets there at all; see hit_and_visibility. */
static void find_hits(Scratch *s, int64_t first, int64_t count) {
    for (int64_t t = first; t < first + count; t += LANES) {
        const Lanes z = load(s->depth + t), half = load(s->half + t), share = load(s->mixture[4] + t);
        const Lanes first = 1.0f / load(s->mixture[1] + t), second = 1.0f / load(s->mixture[3] + t);
        const Lanes front = z - load(s->mixture[0] + t), behind = z - load(s->mixture[2] + t);
        Lanes near = share * logistic((front - half) * first), far = share * logistic((front + half) * first);
        near += (1.0f - share) * logistic((behind - half) * second);
        far += (1.0f - share) * logistic((behind + half) * second);
        store(s->hit + t, far - near);
        store(s->visible + t, 1.0f - near);
    }
    for (int64_t t = first; t < first + count; t++) {
        float *cues = s->tokens + t * s->stride + s->channels;
        cues[0] = s->hit[t], cues[1] = s->visible[t];
    }
}

/* The token of view j at the background. */
INLINE void look_far(Scratch *s, const SourceMaps *maps, const Settings *set, int64_t j, const float *o,
                     const float *d, float length) {
    const float far = (float)set->background, *K = maps->K.data + 4 * j;
    const float x = o[0] + far * d[0], y = o[1] + far * d[1], depth = o[2] + far * d[2];
    const float width = (float)maps->feature.shape[2] - 0.5f, height = (float)maps->feature.shape[1] - 0.5f;
    const float u = K[0] * x / depth + K[2], v = K[1] * y / depth + K[3];
    s->sees_far[j] = depth > (float)set->min_depth && u > -0.5f && u < width && v > -0.5f && v < height;
    s->depth[s->far + j] = depth, s->half[s->far + j] = 0;
    if (!s->sees_far[j]) {
        for (int i = 0; i < GEOMETRY; i++) s->mixture[i][s->far + j] = 1.0f;
        return;
    }
    gather_token(s, maps, j, u, v, s->far + j);
    s->tokens[(s->far + j) * s->stride + s->channels + 2] =
        (x * d[0] + y * d[1] + depth * d[2]) / (sqrtf(x * x + y * y + depth * depth) * length);
}

/* Reproject the samples of a ray into all views (Eq. 4, 5); returns the number of tokens. */
static int64_t fill_tokens(Scratch *s, const SourceMaps *maps, const Settings *set, const float *origin,
                           const float *direction) {
    const float width = (float)maps->feature.shape[2] - 0.5f, height = (float)maps->feature.shape[1] - 0.5f;
    const float min_depth = (float)set->min_depth;
    int64_t count = 0;
    for (int64_t j = 0; j < s->views; j++) {
        const float *T = maps->T.data + 12 * j, *K = maps->K.data + 4 * j;
        float o[3], d[3];
        for (int i = 0; i < 3; i++) {
            d[i] = T[4 * i] * direction[0] + T[4 * i + 1] * direction[1] + T[4 * i + 2] * direction[2];
            o[i] = T[4 * i] * origin[0] + T[4 * i + 1] * origin[1] + T[4 * i + 2] * origin[2] + T[4 * i + 3];
        }
        const float length = sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        s->view_start[j] = count;
        s->own_view[j] = sqrtf(o[0] * o[0] + o[1] * o[1] + o[2] * o[2]) < (float)set->own_radius ? 1.0f : 0.0f;
        if (set->at_surface) look_far(s, maps, set, j, o, d, length);
        for (int64_t base = 0; base < s->samples; base += LANES) {
            const Lanes z = load(s->z + base), x = o[0] + z * d[0], y = o[1] + z * d[1], depth = o[2] + z * d[2];
            const Lanes u = K[0] * x / depth + K[2], v = K[1] * y / depth + K[3];
            const IntLanes seen = (depth > min_depth) & (u > -0.5f) & (u < width) & (v > -0.5f) & (v < height);
            const Lanes distance = __builtin_elementwise_sqrt(x * x + y * y + depth * depth);
            const Lanes cosine = (x * d[0] + y * d[1] + depth * d[2]) / (distance * length);
            for (int64_t k = base; k < min_i(base + LANES, s->samples); k++) {
                const int64_t lane = k - base;
                if (!seen[lane]) continue;
                gather_token(s, maps, j, u[lane], v[lane], count);
                s->depth[count] = depth[lane], s->half[count] = 0.5f * s->delta[k];
                s->tokens[count * s->stride + s->channels + 2] = cosine[lane];
                s->sample_of[count] = k;
                count++;
            }
        }
    }
    s->view_start[s->views] = count;
    find_hits(s, 0, count);
    if (set->at_surface) find_hits(s, s->far, s->views);
    return count;
}

/* List the tokens of each sample. */
static void group_by_sample(Scratch *s, int64_t count) {
    memset(s->sample_size, 0, (size_t)s->samples * sizeof(int64_t));
    for (int64_t t = 0; t < count; t++) {
        const int64_t k = s->sample_of[t];
        s->by_sample[k * s->views + s->sample_size[k]++] = t;
    }
}

/* Move the tokens that SRay.mask_occluded and pruned keep to the front; returns how many they are. */
static int64_t drop_tokens(Scratch *s, const Settings *set) {
    const float hidden_below = set->at_surface ? 0.0f : (float)set->hidden_below;
    const bool prune = set->sample_weight_threshold > 0;
    int64_t kept = 0, end = 0;
    for (int64_t k = 0; k < s->samples; k++) {
        s->clearest[k] = 0;
        for (int64_t i = 0; i < s->sample_size[k]; i++)
            s->clearest[k] = max_f(s->clearest[k], s->visible[s->by_sample[k * s->views + i]]);
    }
    for (int64_t j = 0, t = 0; j < s->views; j++) {
        end = s->view_start[j + 1];
        s->view_start[j] = kept;
        for (; t < end; t++) {
            const int64_t k = s->sample_of[t];
            const bool hidden = s->visible[t] < hidden_below && hidden_below <= s->clearest[k];
            if (hidden || (prune && s->looked_at[k] == 0)) continue;
            if (kept < t) {
                memcpy(s->tokens + kept * s->stride, s->tokens + t * s->stride, (size_t)s->stride * sizeof(float));
                s->visible[kept] = s->visible[t], s->sample_of[kept] = k;
            }
            kept++;
        }
    }
    s->view_start[s->views] = kept;
    return kept;
}

/* ---- Density (DensityNet) and compositing weights ---- */

/* Mean and variance over the views of the colours at a sample; cues and colour fill one vector of a token. */
_Static_assert(ROW_EXTRA == LANES && COLOUR + 3 == LANES, "the colour ends the vector behind the features");
static void describe_colour(const Scratch *s, const int64_t *tokens, int64_t views, float scale, float *mean_out,
                            float *variance_out) {
    Lanes mean = splat(0), square = splat(0);
    for (int64_t i = 0; i < views; i++) {
        const Lanes value = scale * load(s->tokens + tokens[i] * s->stride + s->channels);
        const Lanes part = splat(s->view_share[i]) * value;
        mean += part, square += part * value;
    }
    const Lanes variance = square - mean * mean;
    for (int c = 0; c < 3; c++) mean_out[c] = mean[COLOUR + c], variance_out[c] = variance[COLOUR + c];
}

/* Inputs of the network for one sample: mean and variance of the features, and of the colours, over the views, and what
 * these see. */
static void describe_sample(Scratch *s, const Settings *set, int64_t k) {
    const int64_t C = s->channels, views = s->sample_size[k], *tokens = s->by_sample + k * s->views;
    const int64_t values = set->colour_scale > 0 ? C + 3 : C;
    float *input = s->density_input + k * s->density_inputs, *variance = input + values, *share = s->view_share;
    float sum = 0, visible = 0, hits = 0;
    for (int64_t i = 0; i < views; i++) {
        visible += s->visible[tokens[i]], hits += s->hit[tokens[i]];
        share[i] = s->visible[tokens[i]] + (float)set->least_visibility;
        sum += share[i];
    }
    for (int64_t i = 0; i < views; i++) share[i] /= max_f(sum, 1e-6f);
    int64_t c = 0;
    for (; c + LANES <= C; c += LANES) {
        Lanes mean = splat(0), square = splat(0);
        for (int64_t i = 0; i < views; i++) {
            Lanes value = load(s->tokens + tokens[i] * s->stride + c), part = splat(share[i]) * value;
            mean += part, square += part * value;
        }
        store(input + c, mean), store(variance + c, square - mean * mean);
    }
    for (; c < C; c++) {
        float mean = 0, square = 0;
        for (int64_t i = 0; i < views; i++) {
            const float value = s->tokens[tokens[i] * s->stride + c], part = share[i] * value;
            mean += part, square += part * value;
        }
        input[c] = mean, variance[c] = square - mean * mean;
    }
    if (values > C) describe_colour(s, tokens, views, (float)set->colour_scale, input + C, variance + C);
    float *cues = variance + values;
    cues[0] = min_f(max_f(hits / max_f(visible, 1e-3f), 0.0f), 0.999f); /* opacity */
    cues[1] = visible / (float)views, cues[2] = hits / (float)views, cues[3] = min_f(s->delta[k], 1.0f);
    s->sigma[k] = -log1pf(-cues[0]) / max_f(s->delta[k], 1e-4f);
}

static float softplus(float x) { return max_f(x, 0.0f) + log1pf(expf(-fabsf(x))); }

/* Density sigma of each sample of the ray from what all views say about it. */
static void find_density(Scratch *s, const Weights *w, const Settings *set) {
    const int64_t D = s->density_width;
    int64_t seen = 0;
    for (int64_t k = 0; k < s->samples; k++) {
        s->sigma[k] = 0;
        if (s->sample_size[k] == 0) continue;
        describe_sample(s, set, k);
        s->seen[seen++] = k;
    }
    hidden_layer(s->density_input, s->density_inputs, s->samples, &w->density_hidden, s->density_hidden);
    linear(s->density_hidden, w->density_hidden.weight.shape[1], s->samples, &w->density_token, s->density_token);
    product(s->density_token, D, s->samples, &w->density_qkv, s->density_qkv);
    attend(s->density_qkv, s->seen, seen, 1, D, s, s->density_mixed);
    for (int64_t i = 0; i < s->samples * D; i++) s->density_token[i] += s->density_mixed[i];
    hidden_layer(s->density_token, D, s->samples, &w->density_out_hidden, s->density_hidden);
    two_outputs(s->density_hidden, s->samples, &w->density_out, s->gain, s->own);
    for (int64_t i = 0; i < seen; i++) {
        const int64_t k = s->seen[i];
        const float gain = expf(min_f(max_f(s->gain[k], -4.0f), 4.0f));
        s->sigma[k] = s->sigma[k] * gain + softplus(s->own[k] - (float)set->own_density_offset);
    }
}

/* Compositing weights of the samples, and those of the samples that are looked at, 0 for pruned ones. */
static void weigh_samples(Scratch *s, const Settings *set, float *opacity, float *depth) {
    float optical = 0, sum = 0, depth_sum = 0, kept = 0;
    for (int64_t k = 0; k < s->samples; k++) {
        const float step = s->sigma[k] * s->delta[k];
        s->weight[k] = expf(-optical) * -expm1f(-step);
        optical += step, sum += s->weight[k], depth_sum += s->weight[k] * s->z[k];
    }
    for (int64_t k = 0; k < s->samples; k++) {
        s->looked_at[k] = s->weight[k] >= (float)set->sample_weight_threshold * sum ? s->weight[k] : 0.0f;
        kept += s->looked_at[k];
    }
    for (int64_t k = 0; k < s->samples; k++) s->looked_at[k] *= sum / max_f(kept, 1e-12f);
    *opacity = sum, *depth = sum > 1e-3f ? depth_sum / max_f(sum, 1e-6f) : 0.0f;
}

/* ---- One token a view (sray_layers.surface_space) ---- */

/* Of view j's token `from`, `weight` times: its row to a surface token, and what the view sees of it, which is all where
 * the view is the query's own; returns its share in the token. */
INLINE float add_to_surface(Scratch *s, const Settings *set, int64_t j, int64_t from, float weight, float *token,
                            float *visible) {
    const float *row = s->tokens + from * s->stride;
    const int64_t C = s->channels;
    const float seen = s->own_view[j] > 0 ? 1.0f : s->visible[from];
    const float share = weight * (seen + (float)set->least_visibility);
    for (int64_t c = 0; c < C; c++) token[c] += share * row[c];
    for (int64_t c = C + 2; c < s->stride; c++) token[c] += share * row[c];
    token[C] += weight * row[C];
    *visible += weight * seen;
    return share;
}

/* Composite each view's tokens by itself, the background's with what the samples leave; those of views that see the
 * surface, where any does, become the tokens. Returns how many they are. */
static int64_t composite_views(Scratch *s, const Settings *set) {
    const int64_t C = s->channels;
    const float hidden_below = (float)set->hidden_below;
    float rest = 1.0f, clearest = 0;
    for (int64_t k = 0; k < s->samples; k++) rest -= s->looked_at[k];
    rest = max_f(rest, 0.0f);
    int64_t count = 0;
    memset(s->surface, 0, (size_t)(s->views * s->stride) * sizeof(float));
    for (int64_t j = 0; j < s->views; j++) {
        float *token = s->surface + count * s->stride, sum = 0, weight = 0, visible = 0;
        for (int64_t t = s->view_start[j]; t < s->view_start[j + 1]; t++) {
            const float part = s->looked_at[s->sample_of[t]];
            sum += add_to_surface(s, set, j, t, part, token, &visible), weight += part;
        }
        if (s->sees_far[j]) sum += add_to_surface(s, set, j, s->far + j, rest, token, &visible), weight += rest;
        if (weight <= 0) continue;
        const float rate = 1.0f / max_f(sum, 1e-12f);
        for (int64_t c = 0; c < s->stride; c++) token[c] *= c == C ? 1.0f : rate;
        token[C + 1] = visible, token[C + OWN] = s->own_view[j];
        s->surface_visible[count++] = visible;
        clearest = max_f(clearest, visible);
    }
    int64_t kept = 0;
    for (int64_t i = 0; i < count; i++) {
        if (s->surface_visible[i] < hidden_below && hidden_below <= clearest) continue;
        memcpy(s->tokens + kept * s->stride, s->surface + i * s->stride, (size_t)s->stride * sizeof(float));
        s->visible[kept++] = s->surface_visible[i];
    }
    memset(s->sample_size, 0, (size_t)s->samples * sizeof(int64_t));
    for (int64_t i = 0; i < kept; i++) s->by_sample[i] = i;
    s->sample_size[0] = kept;
    return kept;
}

/* ---- Blending (Eq. 11, 12) and compositing (Eq. 13) ---- */

/* Of each token its weights in the semantic ray and in the colour, neither yet normalised (Eq. 12). */
static void score_views(Scratch *s, const Weights *w, const Settings *set, int64_t count) {
    hidden_layer(normalised(s, set, count), s->stride, count, &w->view_hidden, s->view_hidden);
    two_outputs(s->view_hidden, count, &w->view_scores, s->semantic_score, s->colour_score);
    for (int64_t k = 0; k < s->samples; k++) {
        const int64_t *tokens = s->by_sample + k * s->views;
        float top = -1e30f;
        for (int64_t i = 0; i < s->sample_size[k]; i++) top = max_f(top, s->colour_score[tokens[i]]);
        for (int64_t i = 0; i < s->sample_size[k]; i++) s->colour_score[tokens[i]] -= top;
    }
    for (int64_t t = 0; t < count; t += LANES) {
        /* tanh(x) = 2 logistic(2 x) - 1. Of tau^-0.5 times as much as Eq. 12 says, which the sum over the views divides
         * out. */
        const Lanes score = load(s->semantic_score + t);
        Lanes weight = exp_below((float)set->log_ratio * (logistic(2.0f * score) - 1.0f));
        store(s->semantic_score + t, weight * (load(s->visible + t) + (float)set->least_visibility));
        Lanes colour = exp_below(load(s->colour_score + t));
        if (set->at_surface) colour *= load(s->visible + t) + (float)set->least_visibility;
        store(s->colour_score + t, colour);
    }
}

/* Semantic ray s of the samples that are looked at (Eq. 11), and the colour of the ray; returns how many they are. */
static int64_t blend_views(Scratch *s, float *colour) {
    const int64_t C = s->channels;
    int64_t kept = 0;
    memset(colour, 0, 3 * sizeof(float));
    for (int64_t k = 0; k < s->samples; k++) {
        const int64_t views = s->sample_size[k], *tokens = s->by_sample + k * s->views;
        if (views == 0) continue;
        float sum = 0, colour_sum = 0;
        for (int64_t i = 0; i < views; i++)
            sum += s->semantic_score[tokens[i]], colour_sum += s->colour_score[tokens[i]];
        for (int64_t i = 0; i < views; i++) s->view_share[i] = s->semantic_score[tokens[i]] / sum;
        weighted_sum(s->tokens, s->stride, tokens, s->view_share, views, C, s->s + kept * C);
        for (int64_t i = 0; i < views; i++) {
            const float weight = s->looked_at[k] * s->colour_score[tokens[i]] / colour_sum;
            const float *rgb = s->tokens + tokens[i] * s->stride + C + COLOUR;
            for (int c = 0; c < 3; c++) colour[c] += weight * rgb[c];
        }
        s->kept_weight[kept++] = s->looked_at[k];
    }
    return kept;
}

/* The same of tokens at the surface, which stay apart until they have been through `semantic`; as many as there are. */
static int64_t weigh_views(Scratch *s, float own_factor, int64_t count, float *colour) {
    const int64_t C = s->channels;
    float sum = 0, colour_sum = 0;
    memset(colour, 0, 3 * sizeof(float));
    for (int64_t i = 0; i < count; i++)
        if (s->tokens[i * s->stride + C + OWN] > 0) s->semantic_score[i] *= own_factor;
    for (int64_t i = 0; i < count; i++) sum += s->semantic_score[i], colour_sum += s->colour_score[i];
    for (int64_t i = 0; i < count; i++) {
        const float *row = s->tokens + i * s->stride;
        memcpy(s->s + i * C, row, (size_t)C * sizeof(float));
        s->kept_weight[i] = s->semantic_score[i] / sum;
        for (int c = 0; c < 3; c++) colour[c] += s->colour_score[i] / colour_sum * row[C + COLOUR + c];
    }
    return count;
}

/* Eq. 13 of s + semantic(s): the second layer of `semantic` is linear, so it is applied once, to the composited hidden
 * units. */
static void composite_semantics(Scratch *s, const Weights *w, int64_t count, float *out) {
    const int64_t C = s->channels, hidden = s->hidden;
    hidden_layer(s->s, C, count, &w->semantic_hidden, s->semantic_hidden);
    weighted_sum(s->s, C, s->every, s->kept_weight, count, C, out);
    weighted_sum(s->semantic_hidden, hidden, s->every, s->kept_weight, count, hidden, s->composited_hidden);
    weighted_sum(w->semantic_out.weight.data, C, s->every, s->composited_hidden, hidden, C, s->composited);
    float sum = 0;
    for (int64_t k = 0; k < count; k++) sum += s->kept_weight[k];
    for (int64_t c = 0; c < C; c++) out[c] += s->composited[c] + sum * w->semantic_out.bias.data[c];
}

/* Known labels that the views carry over to the samples, composited; see SRay.propagate_labels. */
static void carry_labels(const Scratch *s, const Settings *set, float *out) {
    for (int64_t k = 0; k < s->samples; k++) {
        const int64_t *tokens = s->by_sample + k * s->views;
        float sum = (float)set->label_uncertainty;
        for (int64_t i = 0; i < s->sample_size[k]; i++)
            if (s->label[tokens[i]] >= 0) sum += s->hit[tokens[i]];
        for (int64_t i = 0; i < s->sample_size[k]; i++) {
            const int64_t label = s->label[tokens[i]];
            if (label >= 0 && label < s->classes) out[label] += s->weight[k] * s->hit[tokens[i]] / sum;
        }
    }
}

/* ---- One ray ---- */

static void render_ray(const RenderArguments *a, Scratch *s, int64_t r) {
    const Settings *set = &a->settings;
    const Weights *w = &a->weights;
    const int64_t N = s->samples, C = s->channels;
    const float *direction = a->rays.direction.data + 3 * r, *z = a->rays.z.data + r * N;
    const float norm =
        sqrtf(direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2]);
    memcpy(s->z, z, (size_t)N * sizeof(float));
    for (int64_t k = 0; k < N - 1; k++) s->delta[k] = (z[k + 1] - z[k]) * norm;
    s->delta[N - 1] = s->delta[N - 2];

    int64_t count = fill_tokens(s, &a->maps, set, a->rays.origin.data + 3 * r, direction);
    a->out.known.data[r] = count > 0;
    group_by_sample(s, count);
    find_density(s, w, set);
    weigh_samples(s, set, a->out.opacity.data + r, a->out.depth.data + r);
    memset(a->out.carried.data + r * s->classes, 0, (size_t)s->classes * sizeof(float));
    if (a->maps.labels.shape[1] > 0) carry_labels(s, set, a->out.carried.data + r * s->classes);
    count = drop_tokens(s, set);
    group_by_sample(s, count);
    if (w->radial.qkv.shape[0] > 0) attend_along_ray(s, &w->radial, set, count);
    if (set->at_surface) count = composite_views(s, set);
    if (w->cross.qkv.shape[0] > 0) attend_across_views(s, &w->cross, set, count);
    score_views(s, w, set, count);
    float *colour = a->out.colour.data + 3 * r;
    const float own_factor = a->rays.own_factor.data[r];
    const int64_t kept = set->at_surface ? weigh_views(s, own_factor, count, colour) : blend_views(s, colour);
    composite_semantics(s, w, kept, a->out.feature.data + r * C);
}

/* Returns 1 where there is no memory for the buffers. */
KERNEL(render_sray, RenderArguments) {
    Scratch s = {
        .channels = a->maps.feature.shape[3],
        .samples = a->rays.z.shape[1],
        .views = a->maps.feature.shape[0],
        .classes = a->out.carried.shape[1],
        .stride = a->maps.feature.shape[3] + ROW_EXTRA,
        .view_width = a->weights.view_hidden.weight.shape[1],
        .density_width = a->weights.density_token.weight.shape[1],
        .hidden = a->weights.semantic_hidden.weight.shape[1],
        .density_inputs = a->weights.density_hidden.weight.shape[0],
    };
    Arena arena = {0};
    lay_out(&s, &a->weights, &arena);
    void *memory = calloc(arena.size, 1); /* zeros: sums beyond the ends cost the more, the smaller what stood there */
    if (!memory) return 1;
    arena = (Arena){.next = memory};
    lay_out(&s, &a->weights, &arena);
    for (int64_t i = 0; i < max_i(s.far, s.hidden); i++) s.every[i] = i;
    for (int64_t r = start; r < stop; r++) render_ray(a, &s, r);
    free(memory);
    return 0;
}
