/* What all kernels share: arrays as Python passes them, and the form of a kernel.
 *
 * A kernel has one struct of arguments, in the order of its Python declaration (see binding.py): an array is an
 * `Array` of its element type, an int or a bool is an int64_t, a float is a double, a named tuple is a struct of its
 * fields. All members are 8 bytes wide, so there is no padding. Every kernel is called with the range of its loop.
 */
#pragma once

#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#define ARRAY(type, name)                                                                                             \
    typedef struct {                                                                                                  \
        type *data;                                                                                                   \
        int64_t itemsize; /* in bytes: tells element types apart where a kernel takes several */                      \
        int64_t shape[4]; /* C order, contiguous; beyond the last dimension 1 */                                      \
    } name

ARRAY(float, F32);
ARRAY(double, F64);
ARRAY(uint8_t, U8); /* bool arrays, too */
ARRAY(int8_t, I8);
ARRAY(int16_t, I16);
ARRAY(uint16_t, U16);
ARRAY(int32_t, I32);
ARRAY(int64_t, I64);
ARRAY(uint64_t, U64);
ARRAY(void, AnyArray);

/* KERNEL(name, Arguments) { ... } defines one with `start`, `stop` and `a`; NAME_size lets Python check the struct. */
#define KERNEL(name, Arguments)                                                                                       \
    __attribute__((visibility("default"))) const int64_t name##_size = sizeof(Arguments);                             \
    __attribute__((visibility("default"))) int64_t name(__attribute__((unused)) int64_t start,                        \
                                                        __attribute__((unused)) int64_t stop, const Arguments *a)

#define MOST_CLASSES 256 /* ids are bytes */

/* For functions that are made again for each caller's constants, which a compiler by itself may not do. */
#define ALWAYS_INLINE static inline __attribute__((always_inline))

static inline int64_t min_i(int64_t a, int64_t b) { return a < b ? a : b; }
static inline int64_t max_i(int64_t a, int64_t b) { return a > b ? a : b; }
static inline float min_f(float a, float b) { return b < a ? b : a; }
static inline float max_f(float a, float b) { return b > a ? b : a; }
static inline double min_d(double a, double b) { return b < a ? b : a; }
static inline double max_d(double a, double b) { return b > a ? b : a; }

/* Conversions are undefined in C beyond the range of the type: NaN and what no int64 holds become the lowest here. */
static inline int64_t to_int(double x) { return x >= -0x1p63 && x < 0x1p63 ? (int64_t)x : INT64_MIN; }
static inline int64_t floor_int(double x) { return to_int(floor(x)); }

/* A whole number as one of n pixels; NaN is the first. */
static inline int64_t clip_pixel(double x, int64_t n) { return x > 0 ? (x < (double)n ? (int64_t)x : n - 1) : 0; }

/* A color value as a byte, rounded and clipped; NaN becomes 0. */
static inline uint8_t to_byte(double x) {
    double clipped = min_d(max_d(x + 0.5, 0.0), 255.0);
    return clipped >= 0.0 ? (uint8_t)clipped : 0;
}
