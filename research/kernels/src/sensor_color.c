/* The color camera: motion blur, and linear light -> 8 bits; see scenes/sensor_color.py. */
#include "kernels.h"

#define SAMPLES 7 /* along the motion of a pixel */

typedef struct {
    F32 linear;       /* (H, W, 3) */
    F32 depth;        /* (H, W) metres */
    F64 T_close_open; /* (4, 4) */
    double fx, fy, cx, cy;
    F32 out; /* (H, W, 3), holds `linear` already */
} BlurArguments;

KERNEL(blur_motion, BlurArguments) {
    int64_t height = a->depth.shape[0], width = a->depth.shape[1];
    const double *T = a->T_close_open.data;
    for (int64_t v = 0; v < height; v++) {
        for (int64_t u = 0; u < width; u++) {
            double z = a->depth.data[v * width + u];
            if (z <= 0) continue;
            double x = ((double)u - a->cx) / a->fx * z, y = ((double)v - a->cy) / a->fy * z;
            double depth_then = T[8] * x + T[9] * y + T[10] * z + T[11];
            if (depth_then <= 0.02) continue;
            double du = (T[0] * x + T[1] * y + T[2] * z + T[3]) / depth_then * a->fx + a->cx - (double)u;
            double dv = (T[4] * x + T[5] * y + T[6] * z + T[7]) / depth_then * a->fy + a->cy - (double)v;
            if (du * du + dv * dv < 0.25) continue;
            double sum[3] = {0.0, 0.0, 0.0};
            for (int k = 0; k < SAMPLES; k++) {
                double moment = (double)k / (SAMPLES - 1) - 0.5;
                int64_t column = clip_pixel(floor((double)u + moment * du + 0.5), width);
                int64_t row = clip_pixel(floor((double)v + moment * dv + 0.5), height);
                for (int i = 0; i < 3; i++) sum[i] += a->linear.data[3 * (row * width + column) + i];
            }
            for (int i = 0; i < 3; i++) a->out.data[3 * (v * width + u) + i] = (float)(sum[i] / SAMPLES);
        }
    }
    return 0;
}

typedef struct {
    F32 linear, noise; /* (H, W, 3) light, and numbers of the normal distribution */
    F32 gain;          /* (3,) */
    double corner, saturation, shot_noise, read_noise;
    double scale; /* of the tone table: entries a square root of linear light */
    U8 table;     /* (T,) grey levels */
    U8 out;       /* (H, W, 3) */
} DevelopArguments;

/* Float32 and float64 are mixed here as the numbers of images that were rendered before depend on it. */
KERNEL(develop_image, DevelopArguments) {
    int64_t height = a->linear.shape[0], width = a->linear.shape[1];
    float corner = (float)a->corner, saturation = (float)a->saturation, scale = (float)a->scale;
    float shot_noise = (float)a->shot_noise, read_noise = (float)a->read_noise;
    float row_step = (float)(2.0 / ((double)(height - 1) + 1e-6));
    float column_step = (float)(2.0 / ((double)(width - 1) + 1e-6));
    const float *restrict linear = a->linear.data, *restrict noise = a->noise.data, *restrict gain = a->gain.data;
    const uint8_t *restrict table = a->table.data;
    uint8_t *restrict out = a->out.data;
    double last = (double)(a->table.shape[0] - 1);
    for (int64_t v = 0; v < height; v++) {
        double y = (double)v * row_step - 1.0;
        for (int64_t u = 0; u < width; u++, linear += 3, noise += 3, out += 3) {
            double x = (double)u * column_step - 1.0, light = 1.0 - corner * 0.5f * (x * x + y * y);
            float rgb[3] = {linear[0] * gain[0], linear[1] * gain[1], linear[2] * gain[2]};
            float grey = 0.299f * rgb[0] + 0.587f * rgb[1] + 0.114f * rgb[2];
            double position[3]; /* in the tone table */
            for (int i = 0; i < 3; i++) {
                double value = max_d((grey + saturation * (rgb[i] - grey)) * light, 0.0);
                value += noise[i] * sqrt(shot_noise * value + read_noise * read_noise);
                position[i] = min_d(sqrt(max_d(0.0, value)) * scale + 0.5, last); /* NaN is black */
            }
            for (int i = 0; i < 3; i++) out[i] = table[(int64_t)position[i]];
        }
    }
    return 0;
}
