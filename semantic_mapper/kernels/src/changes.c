/* What changed in a map, in few bytes; see mapping/changes.py. */
#include "packed_blocks.h"
#include "readout.h"

#define TSDF_STEPS 127
#define UNOBSERVED (-128)
#define CONFIDENCE_STEPS 255

typedef struct {
    F32 data;                         /* packed blocks */
    I64 ends;                         /* (B + 1,) */
    I64 rows;                         /* (B,) of the result */
    U8 ids;                           /* (L + 1,) of the classes, and the ignore id */
    double vote_discount, unknown_below;
    double min_weight;    /* voxels with less weight count as not observed */
    I8 tsdf;                          /* (R, 512) */
    U8 label, confidence;             /* (R, 512) */
    U8 rgb;                           /* (R, 512, 3) */
    U8 computed;                      /* (R, 512) 1 where no sensor measured what was observed */
} CompactArguments;

/* The TSDF in steps, never of another sign: the surface stays between the same voxels. */
static int8_t tsdf_steps(float tsdf) {
    int64_t steps = to_int(rint(min_d(max_d(tsdf, -1.0), 1.0) * TSDF_STEPS));
    return (int8_t)(tsdf > 0 ? max_i(steps, 1) : steps);
}

KERNEL(compact_blocks, CompactArguments) {
    int64_t classes = a->ids.shape[0] - 1;
    uint8_t ignore_id = a->ids.data[classes];
    for (int64_t n = 0; n < a->rows.shape[0]; n++) {
        int64_t first = a->rows.data[n] * BLOCK_VOXELS;
        memset(a->tsdf.data + first, UNOBSERVED, BLOCK_VOXELS);
        memset(a->label.data + first, ignore_id, BLOCK_VOXELS);
        memset(a->confidence.data + first, 0, BLOCK_VOXELS);
        memset(a->rgb.data + 3 * first, 0, 3 * BLOCK_VOXELS);
        memset(a->computed.data + first, 0, BLOCK_VOXELS);
        PackedBlock block;
        int64_t begin = a->ends.data[n], end = a->ends.data[n + 1];
        if (!open_packed(a->data.data + begin, end - begin, classes, &block)) continue;
        for (int64_t voxel = 0; voxel < BLOCK_VOXELS; voxel++) {
            int64_t at = first + voxel;
            bool observed = false;
            if (in_mask(block.measured, voxel)) {
                observed = *block.weight >= a->min_weight;
                if (observed) {
                    a->tsdf.data[at] = tsdf_steps(*block.tsdf);
                    a->computed.data[at] = *block.weight < MEASURED;
                    for (int c = 0; c < 3; c++) a->rgb.data[3 * at + c] = to_byte(block.color[c]);
                }
                block.tsdf++, block.weight++, block.color += 3;
            }
            if (in_mask(block.voted, voxel)) {
                if (observed) {
                    double confidence;
                    int64_t best = decide_stored(block.evidence, classes, *block.votes, a->vote_discount,
                                          a->unknown_below, &confidence);
                    a->label.data[at] = best < 0 ? ignore_id : a->ids.data[best];
                    a->confidence.data[at] = to_byte(confidence * CONFIDENCE_STEPS);
                }
                block.evidence += classes, block.votes++;
            }
        }
    }
    return 0;
}
