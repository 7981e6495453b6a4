/* A depth view on another one, point to plane: what one Gauss-Newton step needs; see localization/depth_alignment.py. */
#include <string.h>

#include "kernels.h"

typedef struct {
    F32 points;                  /* (H, W, 3) of the view, in its camera's axes; NaN = none */
    F32 target_points, normals;  /* (h, w, 3) of the target, in its camera's axes; NaN = none */
    F64 pose;                    /* (4, 4) T_target_camera */
    F64 lens;                    /* fx, fy, cx, cy of the target */
    double outlier_m, noise_m;   /* largest distance that counts; noise at 1 m */
    F64 normal_matrix, gradient; /* (6, 6) and (6,): rotation and shift of the camera in its own axes */
    F64 sums;                    /* known, seen, flat, near, squares, cost, weight, weighted squares, robust weight */
} PointToPlaneArguments;

/* Sums over all points. Each counts by its depth (noise grows with its square) and, robustly, by its distance. */
KERNEL(point_to_plane, PointToPlaneArguments) {
    const double *T = a->pose.data, *k = a->lens.data;
    int64_t count = a->points.shape[0] * a->points.shape[1], height = a->normals.shape[0], width = a->normals.shape[1];
    double H[6][6] = {{0}}, g[6] = {0}, known = 0, seen = 0, flat = 0, near = 0, squares = 0, cost = 0;
    double weights = 0, weighted_squares = 0, robust_weights = 0;
    for (int64_t i = 0; i < count; i++) {
        const float *p = a->points.data + 3 * i;
        double x = p[0], y = p[1], z = p[2];
        if (!(z > 0)) continue;
        known++;
        double qx = T[0] * x + T[1] * y + T[2] * z + T[3], qy = T[4] * x + T[5] * y + T[6] * z + T[7];
        double qz = T[8] * x + T[9] * y + T[10] * z + T[11];
        if (!(qz > 1e-6)) continue;
        int64_t u = floor_int(k[0] * qx / qz + k[2] + 0.5), v = floor_int(k[1] * qy / qz + k[3] + 0.5);
        if (u < 0 || v < 0 || u >= width || v >= height) continue;
        const float *t = a->target_points.data + 3 * (v * width + u), *n = a->normals.data + 3 * (v * width + u);
        if (!(t[2] > 0)) continue;
        seen++;
        if (!(n[0] >= -1)) continue;
        flat++;
        double d = (qx - t[0]) * n[0] + (qy - t[1]) * n[1] + (qz - t[2]) * n[2];
        cost += min_d(fabs(d), a->outlier_m);
        if (!(fabs(d) < a->outlier_m)) continue;
        near++;
        squares += d * d;
        double ratio = 1.0 / max_d(z * z, 1.0), part = d * ratio / a->noise_m;
        double weight = ratio * ratio, robust = weight / ((1 + part * part) * (1 + part * part)); /* Geman-McClure */
        weights += weight;
        weighted_squares += weight * d * d;
        robust_weights += robust;
        double m[3], J[6]; /* the normal in the camera's axes */
        for (int c = 0; c < 3; c++) m[c] = T[c] * n[0] + T[4 + c] * n[1] + T[8 + c] * n[2];
        J[0] = y * m[2] - z * m[1], J[1] = z * m[0] - x * m[2], J[2] = x * m[1] - y * m[0];
        J[3] = m[0], J[4] = m[1], J[5] = m[2];
        for (int r = 0; r < 6; r++) {
            double scaled = robust * J[r];
            g[r] += scaled * d;
            for (int c = r; c < 6; c++) H[r][c] += scaled * J[c];
        }
    }
    for (int r = 0; r < 6; r++)
        for (int c = 0; c < 6; c++) a->normal_matrix.data[6 * r + c] = H[r < c ? r : c][r < c ? c : r];
    memcpy(a->gradient.data, g, sizeof g);
    double sums[] = {known, seen, flat, near, squares, cost, weights, weighted_squares, robust_weights};
    memcpy(a->sums.data, sums, sizeof sums);
    return 0;
}
