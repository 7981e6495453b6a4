/* Fills the pixels between those that have rays, and how uncertain they are: see fields/render.py. */
#include <math.h>

#include "kernels.h"

typedef struct {
    int64_t step;      /* pixels between those of the grid, even */
    F32 probabilities; /* (H, W, L) */
    U8 known;          /* (H, W) */
    F32 depth, prior;  /* (H, W) metres: rendered, and the prior of the rays */
    U8 rgb;            /* (H, W, 3) */
    F32 uncertainty;   /* (H, W) */
} FillArguments;

#define DEPTH_STEP 0.03  /* fraction of z by which the prior leaves the plane through its neighbours across a border */
#define COLOUR_STEP 40.0 /* 8-bit steps, summed over the channels, by which a colour differs at an edge */
#define UNSURE 0.2 /* probability that is not the likeliest class's, above which agreeing rays do not tell enough */

/* One pixel: the mean of the known ones among the four grid pixels round it. */
static void fill_pixel(const FillArguments *a, int64_t v, int64_t u) {
    const int64_t height = a->probabilities.shape[0], width = a->probabilities.shape[1];
    const int64_t classes = a->probabilities.shape[2], step = a->step, at = v * width + u;
    float *p = a->probabilities.data + at * classes, depth_sum = 0, prior_sum = 0, best = 0;
    int64_t count = 0, before = -2, colour_sum[3] = {0};
    bool differs = false;
    for (int corner = 0; corner < 4; corner++) {
        int64_t j = corner < 2 ? v / step * step : (v + step - 1) / step * step;
        int64_t i = corner % 2 == 0 ? u / step * step : (u + step - 1) / step * step;
        j = j < height ? j : j - step, i = i < width ? i : i - step;
        const int64_t from = j * width + i;
        prior_sum += a->prior.data[from];
        for (int c = 0; c < 3; c++) colour_sum[c] += a->rgb.data[3 * from + c];
        int64_t top = -1;
        if (a->known.data[from]) {
            const float *q = a->probabilities.data + from * classes;
            count++, top = 0;
            depth_sum += a->depth.data[from];
            for (int64_t c = 0; c < classes; c++) {
                p[c] += q[c];
                if (q[c] > q[top]) top = c;
            }
        }
        differs = differs || (before > -2 && top != before);
        before = top;
    }
    if (count > 0) {
        a->known.data[at] = true, a->depth.data[at] = depth_sum / (float)count;
        for (int64_t c = 0; c < classes; c++) {
            p[c] /= (float)count;
            best = max_f(best, p[c]);
        }
    }
    const double prior = a->prior.data[at], unsure = 1 - (double)best;
    const bool jump = fabs((double)prior_sum / 4 - prior) > DEPTH_STEP * prior;
    double edge = 0;
    for (int c = 0; c < 3; c++) edge += fabs((double)colour_sum[c] / 4 - a->rgb.data[3 * at + c]);
    if (differs || jump || edge > COLOUR_STEP || unsure > UNSURE)
        a->uncertainty.data[at] = (float)((differs ? 2.0 : 0.0) + (jump ? 1.0 : 0.0) + min_d(edge / 255, 1.0) + unsure);
}

/* Iterations are rows, half a step apart. */
KERNEL(fill_between_rays, FillArguments) {
    const int64_t step = a->step, half = step / 2;
    for (int64_t v = start * half; v < stop * half; v += half)
        for (int64_t u = 0; u < a->depth.shape[1]; u += half)
            if (v % step > 0 || u % step > 0) fill_pixel(a, v, u);
    return 0;
}
