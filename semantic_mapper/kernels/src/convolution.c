/* Convolutions of images, the same to the bit on any number of threads: see depth_from_motion/convolution.py. */
#include <math.h>

#include "kernels.h"
#include "simd.h"

#pragma clang fp contract(fast)

#define BLOCK 16 /* output channels at a time: two vectors */
#define TILE 6   /* pixels at a time: with two vectors each they fill the registers */

typedef struct {
    F32 input;     /* (H, W, C) with its margin */
    F32 weight;    /* (blocks, size * size, C, BLOCK) */
    F32 bias;      /* (blocks * BLOCK,) */
    F32 out;       /* (h, w, blocks * BLOCK), added to */
    int64_t size;  /* of the kernel, pixels a side */
    int64_t stride;
    int64_t dilation;
} ConvolutionArguments;

/* `tile` pixels from column x of row y on, BLOCK channels. A pixel's sum has one order, whatever the tile. */
INLINE void convolve_tile(const ConvolutionArguments *a, int64_t block, int64_t y, int64_t x, const int tile) {
    const int64_t columns = a->input.shape[1], depth = a->input.shape[2];
    const int64_t width = a->out.shape[1], channels = a->out.shape[2], step = a->stride * depth;
    const float *weight = a->weight.data + block * a->size * a->size * depth * BLOCK;
    const float *bias = a->bias.data + block * BLOCK;
    float *out = a->out.data + (y * width + x) * channels + block * BLOCK;
    Lanes low[TILE], high[TILE];
    for (int p = 0; p < tile; p++) low[p] = load(bias), high[p] = load(bias + LANES);
    for (int64_t j = 0; j < a->size; j++)
        for (int64_t i = 0; i < a->size; i++) {
            const int64_t row = y * a->stride + j * a->dilation, column = x * a->stride + i * a->dilation;
            const float *in = a->input.data + (row * columns + column) * depth;
            for (int64_t c = 0; c < depth; c++, weight += BLOCK) {
                const Lanes first = load(weight), second = load(weight + LANES);
                for (int p = 0; p < tile; p++) {
                    const Lanes value = splat(in[p * step + c]);
                    low[p] += value * first, high[p] += value * second;
                }
            }
        }
    for (int p = 0; p < tile; p++) {
        store(out + p * channels, load(out + p * channels) + low[p]);
        store(out + p * channels + LANES, load(out + p * channels + LANES) + high[p]);
    }
}

KERNEL(convolve_rows, ConvolutionArguments) {
    const int64_t width = a->out.shape[1], blocks = a->weight.shape[0];
    for (int64_t block = 0; block < blocks; block++)
        for (int64_t y = start; y < stop; y++) {
            int64_t x = 0;
            for (; x + TILE <= width; x += TILE) convolve_tile(a, block, y, x, TILE);
            for (; x + 2 <= width; x += 2) convolve_tile(a, block, y, x, 2);
            for (; x < width; x++) convolve_tile(a, block, y, x, 1);
        }
    return 0;
}

typedef struct {
    F32 small; /* (h, w, C) */
    F32 out;   /* (2h, 2w, C), added to */
} DoubleArguments;

/* Bilinear, pixel centres at half: three quarters of the nearest, a quarter of the next. */
KERNEL(add_doubled_rows, DoubleArguments) {
    const int64_t height = a->small.shape[0], width = a->small.shape[1], channels = a->small.shape[2];
    for (int64_t y = start; y < stop; y++) {
        const int64_t near = y / 2, other = y & 1 ? min_i(near + 1, height - 1) : max_i(near - 1, 0);
        for (int64_t x = 0; x < 2 * width; x++) {
            const int64_t column = x / 2, beside = x & 1 ? min_i(column + 1, width - 1) : max_i(column - 1, 0);
            const float *p = a->small.data + (near * width + column) * channels;
            const float *q = a->small.data + (near * width + beside) * channels;
            const float *r = a->small.data + (other * width + column) * channels;
            const float *s = a->small.data + (other * width + beside) * channels;
            float *out = a->out.data + (y * 2 * width + x) * channels;
            for (int64_t c = 0; c < channels; c++)
                out[c] += 0.5625f * p[c] + 0.1875f * (q[c] + r[c]) + 0.0625f * s[c];
        }
    }
    return 0;
}
