/* Surface voxels of one class that touch by face, edge or corner; see queries/instances.py. */
#include "block_index.h"

typedef struct {
    I64 packed; /* (B,) sorted keys */
    I64 start;  /* (B + 1,) block b has the voxels start[b] .. start[b + 1] - 1 */
    I32 voxel;  /* (N,) within the block */
    U8 label;   /* (N,) */
    I64 used;   /* (B,) number of the block among those that have voxels */
    I32 node;   /* (blocks with voxels, 512) scratch: -1 */
    I64 parent; /* (N,) out: the first voxel of each voxel's component */
} ConnectArguments;

/* The union-find structure: the root of a tree is its lowest voxel. */
static int64_t root_of(int64_t *parent, int64_t i) {
    while (parent[i] != i) i = parent[i] = parent[parent[i]];
    return i;
}

static void join(int64_t *parent, int64_t i, int64_t j) {
    int64_t a = root_of(parent, i), b = root_of(parent, j);
    parent[max_i(a, b)] = min_i(a, b);
}

/* Row of a key among the first `count`, -1 where it is not among them or has no voxels. */
static int64_t find_row(const ConnectArguments *a, int64_t key, int64_t count) {
    int64_t low = 0, high = count;
    while (low < high) {
        int64_t middle = low + (high - low) / 2;
        if (a->packed.data[middle] < key)
            low = middle + 1;
        else
            high = middle;
    }
    bool found = low < count && a->packed.data[low] == key && a->start.data[low + 1] > a->start.data[low];
    return found ? low : -1;
}

/* Writes the rows [x][y][z] of the blocks round one that come before it in order, -1 = none; and its own. The others
 * look at this one themselves. */
static void find_rows(const ConnectArguments *a, int64_t row, int64_t near[3][3][3]) {
    int64_t key = a->packed.data[row], x = key_part(key, 0), y = key_part(key, 1), z = key_part(key, 2);
    for (int i = 0; i < 27; i++) {
        int64_t *at = &near[i / 9][i / 3 % 3][i % 3];
        *at = i < 14 ? find_row(a, pack_key(x + i / 9 - 1, y + i / 3 % 3 - 1, z + i % 3 - 1), row + 1) : -1;
    }
}

static void connect_voxel(const ConnectArguments *a, int64_t row, int64_t i, int64_t near[3][3][3]) {
    int32_t voxel = a->voxel.data[i];
    int x = voxel & 7, y = (voxel >> 3) & 7, z = voxel >> 6;
    for (int step = 0; step < 27; step++) {
        int nx = x + step % 3 - 1, ny = y + step / 3 % 3 - 1, nz = z + step / 9 - 1;
        int64_t at = near[(nx >> 3) + 1][(ny >> 3) + 1][(nz >> 3) + 1];
        if (at < 0 || (at == row && step >= 13)) continue; /* that one looks at this voxel itself */
        int64_t j = a->node.data[a->used.data[at] * 512 + (((nz & 7) << 6) | ((ny & 7) << 3) | (nx & 7))];
        if (j >= 0 && a->label.data[j] == a->label.data[i]) join(a->parent.data, i, j);
    }
}

KERNEL(connect_voxels, ConnectArguments) {
    int64_t *parent = a->parent.data, count = a->voxel.shape[0];
    for (int64_t i = 0; i < count; i++) parent[i] = i;
    for (int64_t row = 0; row < a->packed.shape[0]; row++) {
        int64_t from = a->start.data[row], to = a->start.data[row + 1], near[3][3][3];
        if (from == to) continue;
        find_rows(a, row, near);
        for (int64_t i = from; i < to; i++) a->node.data[a->used.data[row] * 512 + a->voxel.data[i]] = (int32_t)i;
        for (int64_t i = from; i < to; i++) connect_voxel(a, row, i, near);
    }
    for (int64_t i = 0; i < count; i++) parent[i] = root_of(parent, i);
    return 0;
}
