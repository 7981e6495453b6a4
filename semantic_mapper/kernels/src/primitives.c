/* Rays through closed triangle meshes; see fields/scene/primitives.py. */
#include "kernels.h"

#define MAX_HITS 128 /* of a ray with one mesh */
#define TRIES 4      /* a ray that meets an edge exactly is moved by a millionth of a millionth, and tried again */

typedef struct {
    F64 vertices;  /* (V, 3) metres */
    I64 faces;     /* (F, 3) vertices of triangles, anticlockwise seen from outside */
    I64 first;     /* (P + 1,) first face of each mesh */
    F64 low, high; /* (P, 3) bounds of each mesh */
} Meshes;

typedef struct {
    Meshes meshes;
    F64 origin, direction; /* (R, 3) */
    F64 near, far;         /* (R,) in units of the direction */
    F64 enter, leave;      /* (R, M) out: by ascending enter */
    I32 mesh;              /* (R, M) out: which; -1 = no more */
    I64 count;             /* (R,) out: how many there are; the nearest M are kept */
} Arguments;

typedef struct {
    double at;
    int side; /* 1 = enters, -1 = leaves */
} Hit;

typedef struct {
    double origin[3], shear_x, shear_y, scale; /* axes turned so that z is the main one */
    int x, y, z;
} Sheared;

static Sheared shear(const double *o, const double *d) {
    Sheared s = {.z = 0};
    for (int i = 1; i < 3; i++)
        if (fabs(d[i]) > fabs(d[s.z])) s.z = i;
    s.x = (s.z + 1) % 3, s.y = (s.z + 2) % 3;
    for (int i = 0; i < 3; i++) s.origin[i] = o[i];
    s.shear_x = d[s.x] / d[s.z], s.shear_y = d[s.y] / d[s.z], s.scale = 1 / d[s.z];
    return s;
}

/* `edge` becomes true where the ray meets an edge of the face exactly. */
static bool meets(const Meshes *m, const Sheared *s, int64_t face, Hit *hit, bool *edge) {
    const int64_t *index = m->faces.data + 3 * face;
    double x[3], y[3], z[3];
    for (int i = 0; i < 3; i++) {
        const double *v = m->vertices.data + 3 * index[i];
        const double depth = v[s->z] - s->origin[s->z];
        x[i] = v[s->x] - s->origin[s->x] - s->shear_x * depth;
        y[i] = v[s->y] - s->origin[s->y] - s->shear_y * depth;
        z[i] = s->scale * depth;
    }
    const double u = x[1] * y[2] - x[2] * y[1], v = x[2] * y[0] - x[0] * y[2], w = x[0] * y[1] - x[1] * y[0];
    const double least = min_d(min_d(u, v), w), most = max_d(max_d(u, v), w);
    if (least < 0 && most > 0) return false;
    *edge = *edge || u == 0 || v == 0 || w == 0;
    const double area = u + v + w;
    if (area == 0) return false;
    hit->at = (u * z[0] + v * z[1] + w * z[2]) / area;
    hit->side = (area < 0) == (s->scale > 0) ? 1 : -1;
    return true;
}

static bool meets_bounds(const double *low, const double *high, const double *o, const double *d, double near,
                         double far) {
    for (int i = 0; i < 3; i++) {
        const double below = low[i] - 1e-9, above = high[i] + 1e-9;
        if (d[i] == 0) {
            if (o[i] < below || o[i] > above) return false;
            continue;
        }
        const double a = (below - o[i]) / d[i], b = (above - o[i]) / d[i];
        near = max_d(near, min_d(a, b)), far = min_d(far, max_d(a, b));
    }
    return far >= near;
}

/* All hits of a line with a mesh, sorted; -1 where it meets an edge exactly, or hits do not pair up. */
static int64_t hits_of(const Meshes *m, int64_t mesh, const double *o, const double *d, Hit *hits) {
    const Sheared s = shear(o, d);
    int64_t count = 0;
    int depth = 0;
    bool edge = false;
    for (int64_t face = m->first.data[mesh]; face < m->first.data[mesh + 1]; face++) {
        Hit hit;
        if (!meets(m, &s, face, &hit, &edge)) continue;
        if (count == MAX_HITS) return -1;
        int64_t k = count++;
        for (; k > 0 && hits[k - 1].at > hit.at; k--) hits[k] = hits[k - 1];
        hits[k] = hit;
        depth += hit.side;
    }
    return depth == 0 && !edge ? count : -1;
}

static void keep(const Arguments *a, int64_t r, double enter, double leave, int64_t mesh) {
    const int64_t most = a->enter.shape[1], row = r * most;
    int64_t k = min_i(a->count.data[r]++, most);
    if (k == most && !(a->enter.data[row + --k] > enter)) return;
    for (; k > 0 && a->enter.data[row + k - 1] > enter; k--) {
        a->enter.data[row + k] = a->enter.data[row + k - 1], a->leave.data[row + k] = a->leave.data[row + k - 1];
        a->mesh.data[row + k] = a->mesh.data[row + k - 1];
    }
    a->enter.data[row + k] = enter, a->leave.data[row + k] = leave, a->mesh.data[row + k] = (int32_t)mesh;
}

KERNEL(ray_intervals, Arguments) {
    const Meshes *m = &a->meshes;
    for (int64_t r = start; r < stop; r++) {
        const double *o = a->origin.data + 3 * r, *d = a->direction.data + 3 * r;
        const double near = a->near.data[r], far = a->far.data[r], size = fabs(d[0]) + fabs(d[1]) + fabs(d[2]);
        a->count.data[r] = 0;
        for (int64_t k = 0; k < a->enter.shape[1]; k++) {
            a->enter.data[r * a->enter.shape[1] + k] = a->leave.data[r * a->enter.shape[1] + k] = INFINITY;
            a->mesh.data[r * a->enter.shape[1] + k] = -1;
        }
        if (!(size > 0 && size < INFINITY) || !(fabs(o[0]) + fabs(o[1]) + fabs(o[2]) < INFINITY)) continue;
        for (int64_t mesh = 0; mesh + 1 < m->first.shape[0]; mesh++) {
            if (!meets_bounds(m->low.data + 3 * mesh, m->high.data + 3 * mesh, o, d, near, far)) continue;
            Hit hits[MAX_HITS];
            int64_t count = hits_of(m, mesh, o, d, hits);
            for (int i = 1; i <= TRIES && count < 0; i++) {
                const double off = 1e-12 * i * size;
                const double moved[3] = {d[0] + off, d[1] - 0.7 * off, d[2] + 0.4 * off};
                count = hits_of(m, mesh, o, moved, hits);
            }
            int depth = 0;
            for (int64_t k = 0; k < count; k++) {
                depth += hits[k].side;
                if (k + 1 == count || depth <= 0) continue;
                const double enter = max_d(hits[k].at, near), leave = min_d(hits[k + 1].at, far);
                if (leave > enter) keep(a, r, enter, leave, mesh);
            }
        }
    }
    return 0;
}
