/* Rays through a scene grid, forwards and backwards; see fields/scene/march.py. */
#include "scene_grid.h"

#include <stdlib.h>

#pragma clang fp contract(fast)

#define MAX_KEPT 64
typedef float Voxel __attribute__((ext_vector_type(4))); /* raw density, then raw red, green and blue */

/* What a sample of a ray needs again on the way back. */
typedef struct {
    float weight, after; /* its part of the ray, and the light that is left behind it */
    float slope;         /* of its optical depth by its raw density */
    Voxel colour;        /* channels 1 to 3 */
} Sample;

/* Optical depth of a sample with this raw density, and its slope. */
INLINE float optical_depth(const Grid *g, float raw, float *slope) {
    const float x = raw + (float)g->bias, e = expf(-fabsf(x)), step = (float)g->step;
    *slope = step * (x > 0 ? 1.0f : e) / (1.0f + e);
    return step * (max_f(x, 0) + log1pf(e));
}

/* The same with the colour: one exponential for all four. */
INLINE float density_and_colour(const Grid *g, Voxel v, float *slope, Voxel *colour) {
    const Voxel x = v + (Voxel){(float)g->bias, 0, 0, 0}, zero = 0;
    const Voxel below = x < 0 ? x : -x;
    const Lanes e8 = exp_below(__builtin_shufflevector(below, below, 0, 1, 2, 3, 0, 1, 2, 3));
    const Voxel e = __builtin_shufflevector(e8, e8, 0, 1, 2, 3), large = 1.0f / (1.0f + e);
    const Voxel sigmoid = x < zero ? e * large : large;
    const float step = (float)g->step;
    *colour = sigmoid, *slope = step * sigmoid[0];
    return step * (max_f(x[0], 0) + log1pf(e[0]));
}

INLINE Voxel read_voxel(const F32 *values, const float *p) {
    float weight[8];
    const int64_t first = corners_of(values, p, weight);
    Voxel sum = 0, value;
    for (int c = 0; c < 8; c++) {
        memcpy(&value, values->data + 4 * corner(values, first, c), sizeof value);
        sum += weight[c] * value;
    }
    return sum;
}

INLINE float read_density(const F32 *values, const float *p) {
    float weight[8], sum = 0;
    const int64_t first = corners_of(values, p, weight), channels = values->shape[3];
    for (int c = 0; c < 8; c++) sum += weight[c] * values->data[channels * corner(values, first, c)];
    return sum;
}

/* ---- Colour rays ---- */

typedef struct {
    F32 colour; /* (R, 3) in [0, 1] */
    F32 inverse_depth; /* (R,) 1 / metres, 0 = not known */
    F32 gain; /* (R, 3) exposure of the image */
    F32 sky;  /* (R, 3) what is seen behind the grid */
} Targets;

typedef struct {
    double point_colour, opacity, depth; /* weights of three losses */
    double reach;                        /* a sample this far from the measured inverse depth costs all, 1 / metres */
    double faint;                        /* samples with less weight teach no colour */
} LossWeights;

typedef struct {
    F32 points;   /* (R, S, 3) out: where the samples are */
    F32 gradient; /* (R, S, C) out: of the loss by what the grid says there */
    I64 count;    /* (R,) out: how many of the S there are */
} SampleLists;

typedef struct {
    F32 colour;       /* (R, 3) out: with the gain */
    F32 sky_gradient; /* (R, 3) out */
    F32 gain_gradient; /* (R, 3) out */
} RayResults;

typedef struct {
    Grid grid;
    GridRays rays;
    Targets targets;
    LossWeights loss;
    SampleLists samples;
    RayResults results;
} PhotometricArguments;

static void photometric_ray(const PhotometricArguments *a, Sample *kept, int64_t r) {
    const Grid *g = &a->grid;
    const int64_t most = a->samples.points.shape[1];
    const float *target = a->targets.colour.data + 3 * r, *gain = a->targets.gain.data + 3 * r;
    const float *sky = a->targets.sky.data + 3 * r, share = 1.0f / (float)a->rays.origin.shape[0];
    float *points = a->samples.points.data + 3 * most * r, *gradient = a->samples.gradient.data + 4 * most * r;
    const Lattice l = lattice_of(g, &a->rays, r);
    float light = 1;
    Voxel colour = 0;
    int64_t n = 0;
    for (int64_t k = 0; n < most && light >= (float)g->stop_below; k++, n++) {
        k = next_sample(g, &l, k, points + 3 * n);
        if (k < 0) break;
        Sample *s = kept + n;
        const float depth = density_and_colour(g, read_voxel(&g->values, points + 3 * n), &s->slope, &s->colour);
        s->weight = -light * expm1f(-depth);
        light = s->after = light - s->weight;
        colour += s->weight * s->colour;
        gradient[4 * n] = 1.0f / z_of(&l, k);
    }
    a->samples.count.data[r] = n;

    Voxel by_colour = 0, wanted = 0; /* of the loss by the composited colour */
    float by_light = -(float)a->loss.opacity * share, by_depth = 0;
    const float measured = a->targets.inverse_depth.data[r], nearness = 1.0f / (float)a->loss.reach;
    for (int c = 0; c < 3; c++) {
        const float seen = colour[c + 1] + light * sky[c], error = gain[c] * seen - target[c];
        const float slope = 2 * share / 3 * error;
        a->results.colour.data[3 * r + c] = gain[c] * seen;
        a->results.gain_gradient.data[3 * r + c] = slope * seen;
        a->results.sky_gradient.data[3 * r + c] = slope * gain[c] * light;
        by_colour[c + 1] = slope * gain[c], by_light += slope * gain[c] * sky[c], wanted[c + 1] = target[c] / gain[c];
    }
    if (measured > 0) by_depth = (float)a->loss.depth * share, by_light += by_depth;
    const float per_point = 2 * (float)a->loss.point_colour * share;
    float behind = light * by_light; /* what the samples behind this one and the sky gain from its light */
    for (int64_t j = n - 1; j >= 0; j--) {
        const Sample *s = kept + j;
        const Voxel each = by_colour * s->colour;
        const float by_weight = each[1] + each[2] + each[3] + by_depth * min_f(fabsf(gradient[4 * j] - measured) * nearness, 1);
        Voxel out = 0;
        if (s->weight >= (float)a->loss.faint)
            out = s->weight * (by_colour + per_point * (s->colour - wanted)) * s->colour * (1.0f - s->colour);
        out[0] = (s->after * by_weight - behind) * s->slope;
        behind += s->weight * by_weight;
        memcpy(gradient + 4 * j, &out, sizeof out);
    }
}

KERNEL(photometric_rays, PhotometricArguments) {
    Sample *kept = malloc((size_t)max_i(a->samples.points.shape[1], 1) * sizeof *kept);
    if (!kept) return 1;
    for (int64_t r = start; r < stop; r++) photometric_ray(a, kept, r);
    free(kept);
    return 0;
}

/* ---- Reading and its way back ---- */

typedef struct {
    F32 values; /* (X, Y, Z, C) */
    F32 points; /* (N, 3) voxels; beyond the grid its edge is read */
    F32 out;    /* (N, C) */
} GatherArguments;

KERNEL(gather_grid, GatherArguments) {
    const int64_t channels = a->values.shape[3];
    for (int64_t n = start; n < stop; n++) {
        float weight[8], p[3], *out = a->out.data + n * channels;
        for (int i = 0; i < 3; i++)
            p[i] = min_f(max_f(a->points.data[3 * n + i], 0), (float)(a->values.shape[i] - 1));
        const int64_t first = corners_of(&a->values, p, weight);
        memset(out, 0, (size_t)channels * sizeof(float));
        for (int c = 0; c < 8; c++) {
            const float *value = a->values.data + channels * corner(&a->values, first, c);
            for (int64_t i = 0; i < channels; i++) out[i] += weight[c] * value[i];
        }
    }
    return 0;
}

typedef struct {
    SampleLists samples;
    F32 sum; /* (X, Y, Z, C) added to */
} ScatterArguments;

ALWAYS_INLINE void scatter_slab(const ScatterArguments *a, int64_t start, int64_t stop, const int64_t channels) {
    const int64_t most = a->samples.points.shape[1], plane = a->sum.shape[1] * a->sum.shape[2];
    for (int64_t r = 0; r < a->samples.count.shape[0]; r++) {
        for (int64_t j = r * most; j < r * most + a->samples.count.data[r]; j++) {
            float weight[8], p[3];
            for (int i = 0; i < 3; i++)
                p[i] = min_f(max_f(a->samples.points.data[3 * j + i], 0), (float)(a->sum.shape[i] - 1));
            const int64_t layer = base_of(p[0], a->sum.shape[0]);
            if (layer + 1 < start || layer >= stop) continue;
            const int64_t first = corners_of(&a->sum, p, weight);
            const float *gradient = a->samples.gradient.data + channels * j;
            for (int c = 0; c < 8; c++) {
                const int64_t vertex = corner(&a->sum, first, c);
                if (vertex < start * plane || vertex >= stop * plane) continue;
                float *sum = a->sum.data + channels * vertex;
                for (int64_t i = 0; i < channels; i++) sum[i] += weight[c] * gradient[i];
            }
        }
    }
}

/* Iterations are layers of x: each thread goes through all samples, and adds in their order what falls on its own. */
KERNEL(scatter_grid, ScatterArguments) {
    switch (a->sum.shape[3]) {
    case 1: scatter_slab(a, start, stop, 1); break;
    case 4: scatter_slab(a, start, stop, 4); break;
    case 16: scatter_slab(a, start, stop, 16); break;
    default: scatter_slab(a, start, stop, a->sum.shape[3]);
    }
    return 0;
}

/* ---- Marching: the samples of greatest weight ---- */

typedef struct {
    F32 z, weight; /* (R, K) out: ascending; without weight beyond the last */
    F32 light;     /* (R,) out: what gets through the grid */
} Marched;

typedef struct {
    Grid grid;
    GridRays rays;
    Marched out;
} MarchArguments;

KERNEL(march_grid, MarchArguments) {
    const int64_t most = a->out.z.shape[1];
    for (int64_t r = start; r < stop; r++) {
        const Lattice l = lattice_of(&a->grid, &a->rays, r);
        float *z = a->out.z.data + r * most, *weight = a->out.weight.data + r * most, light = 1, slope, p[3];
        int64_t n = 0, least = 0;
        for (int64_t k = 0; light >= (float)a->grid.stop_below; k++) {
            if ((k = next_sample(&a->grid, &l, k, p)) < 0) break;
            const float depth = optical_depth(&a->grid, read_density(&a->grid.values, p), &slope);
            const float w = -light * expm1f(-depth);
            light -= w;
            if (n == most) {
                if (w <= weight[least]) continue;
                memmove(z + least, z + least + 1, (size_t)(most - 1 - least) * sizeof *z);
                memmove(weight + least, weight + least + 1, (size_t)(most - 1 - least) * sizeof *weight);
                n--;
            }
            z[n] = z_of(&l, k), weight[n++] = w;
            if (n < most) continue;
            least = 0;
            for (int64_t i = 1; i < most; i++)
                if (weight[i] < weight[least]) least = i;
        }
        for (; n < most; n++) z[n] = n ? z[n - 1] : a->rays.near.data[r], weight[n] = 0;
        a->out.light.data[r] = light;
    }
    return 0;
}

typedef struct {
    Grid grid;
    GridRays rays;
    Marched out;
    F32 weight_gradient; /* (R, K) of a loss by the kept weights */
    F32 light_gradient;  /* (R,) of a loss by what gets through */
    SampleLists samples; /* of all samples, kept or not; one channel */
} MarchGradientArguments;

KERNEL(march_gradient, MarchGradientArguments) {
    const int64_t most = a->samples.points.shape[1], kept = a->out.z.shape[1];
    float *after = malloc((size_t)max_i(most, 1) * 4 * sizeof *after);
    if (!after) return 1;
    float *weight = after + most, *slope = weight + most, *by_weight = slope + most;
    for (int64_t r = start; r < stop; r++) {
        const Lattice l = lattice_of(&a->grid, &a->rays, r);
        const float *z = a->out.z.data + r * kept, *given = a->weight_gradient.data + r * kept;
        float *points = a->samples.points.data + 3 * most * r, *out = a->samples.gradient.data + most * r, light = 1;
        int64_t n = 0, next = 0;
        for (int64_t k = 0; n < most && light >= (float)a->grid.stop_below; k++, n++) {
            if ((k = next_sample(&a->grid, &l, k, points + 3 * n)) < 0) break;
            const float depth = optical_depth(&a->grid, read_density(&a->grid.values, points + 3 * n), slope + n);
            weight[n] = -light * expm1f(-depth), after[n] = light -= weight[n];
            const bool is_kept = next < kept && z[next] == z_of(&l, k);
            by_weight[n] = is_kept ? given[next++] : 0.0f;
        }
        a->samples.count.data[r] = n;
        float behind = light * a->light_gradient.data[r];
        for (int64_t j = n - 1; j >= 0; j--) {
            out[j] = (after[j] * by_weight[j] - behind) * slope[j];
            behind += weight[j] * by_weight[j];
        }
    }
    free(after);
    return 0;
}

/* ---- Steps of the fit ---- */

typedef struct {
    F32 values, gradient, first, second; /* (X, Y, Z, C); the gradient is 0 afterwards */
    F32 rate;                            /* (X, Y, Z) factor of the learning rate */
    double density_rate, colour_rate, beta1, beta2;
    double correction1, correction2; /* 1 - beta^step */
} AdamArguments;

/* Adam where there is a gradient; iterations are layers of x. */
KERNEL(adam_grid, AdamArguments) {
    const int64_t channels = a->values.shape[3], layer = a->values.shape[1] * a->values.shape[2];
    const float beta1 = (float)a->beta1, beta2 = (float)a->beta2;
    const float by1 = (float)(1 / a->correction1), by2 = (float)(1 / a->correction2);
    for (int64_t v = start * layer; v < stop * layer; v++) {
        float *g = a->gradient.data + v * channels, *value = a->values.data + v * channels;
        float *first = a->first.data + v * channels, *second = a->second.data + v * channels;
        bool any = false;
        for (int64_t i = 0; i < channels; i++) any |= g[i] != 0;
        if (!any) continue;
        for (int64_t i = 0; i < channels; i++) {
            const float rate = a->rate.data[v] * (float)(i ? a->colour_rate : a->density_rate);
            first[i] = beta1 * first[i] + (1 - beta1) * g[i];
            second[i] = beta2 * second[i] + (1 - beta2) * g[i] * g[i];
            value[i] -= rate * first[i] * by1 / (sqrtf(second[i] * by2) + 1e-15f);
            g[i] = 0;
        }
    }
    return 0;
}

typedef struct {
    F32 values, gradient; /* (X, Y, Z, C) */
    double density_weight, colour_weight;
} VariationArguments;

/* Adds the gradient of the total variation (Huber, linear beyond 1) where there is one already; layers of x. */
KERNEL(add_total_variation, VariationArguments) {
    const int64_t channels = a->values.shape[3], *shape = a->values.shape;
    const int64_t stride[3] = {shape[1] * shape[2] * channels, shape[2] * channels, channels};
    for (int64_t x = start; x < stop; x++)
        for (int64_t y = 0; y < shape[1]; y++)
            for (int64_t z = 0; z < shape[2]; z++) {
                const int64_t at[3] = {x, y, z}, v = ((x * shape[1] + y) * shape[2] + z) * channels;
                bool any = false;
                for (int64_t i = 0; i < channels; i++) any |= a->gradient.data[v + i] != 0;
                for (int64_t i = 0; any && i < channels; i++) {
                    const float *value = a->values.data + v + i;
                    float sum = 0;
                    for (int d = 0; d < 3; d++) {
                        if (at[d] > 0) sum += max_f(min_f(*value - value[-stride[d]], 1), -1);
                        if (at[d] + 1 < shape[d]) sum += max_f(min_f(*value - value[stride[d]], 1), -1);
                    }
                    a->gradient.data[v + i] += (float)(i ? a->colour_weight : a->density_weight) * sum;
                }
            }
    return 0;
}

/* ---- Distance to the measured surface ---- */

typedef struct {
    F32 distance, weight; /* (X, Y, Z) mean distance in front of the surface so far, in units of the truncation */
    F32 depth;            /* (H, W) metres of z, 0 = none */
    F64 T_camera_grid;    /* (3, 4) of vertices in voxels to metres in the camera */
    double fx, fy, cx, cy, truncation; /* pixels, metres */
} FuseArguments;

/* One frame into a truncated signed distance; layers of x. */
KERNEL(fuse_grid_depth, FuseArguments) {
    const int64_t height = a->depth.shape[0], width = a->depth.shape[1];
    const double *T = a->T_camera_grid.data;
    for (int64_t x = start; x < stop; x++)
        for (int64_t y = 0; y < a->distance.shape[1]; y++)
            for (int64_t z = 0; z < a->distance.shape[2]; z++) {
                double p[3];
                for (int i = 0; i < 3; i++)
                    p[i] = T[4 * i] * (double)x + T[4 * i + 1] * (double)y + T[4 * i + 2] * (double)z + T[4 * i + 3];
                if (!(p[2] > 1e-3)) continue;
                const double u = floor(a->fx * p[0] / p[2] + a->cx + 0.5), v = floor(a->fy * p[1] / p[2] + a->cy + 0.5);
                if (!(u >= 0 && v >= 0 && u < (double)width && v < (double)height)) continue;
                const double measured = a->depth.data[(int64_t)v * width + (int64_t)u];
                const double ahead = (measured - p[2]) / a->truncation;
                if (!(measured > 0) || ahead < -1) continue;
                const int64_t at = (x * a->distance.shape[1] + y) * a->distance.shape[2] + z;
                float *weight = a->weight.data + at, *distance = a->distance.data + at;
                *weight += 1;
                *distance += ((float)min_d(ahead, 1) - *distance) / *weight;
            }
    return 0;
}
