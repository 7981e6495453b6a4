/* Kernels that tests of binding.py and threads.py call. */
#include "kernels.h"

typedef struct {
    I64 visits; /* (N,) */
} CountVisitsArguments;

KERNEL(count_visits, CountVisitsArguments) {
    for (int64_t i = start; i < stop; i++) a->visits.data[i]++;
    return 0;
}

typedef struct {
    I64 values; /* (N, M) */
    struct {
        double factor;
        U8 used; /* (M,) bool */
    } weights;
    int64_t negate, bias;
    AnyArray other;
} SumArguments;

/* Sum of the values in columns that are used, times the factor, negated on request, plus the bias and the item size. */
KERNEL(sum_arguments, SumArguments) {
    int64_t columns = a->values.shape[1];
    double sum = 0.0;
    for (int64_t i = 0; i < a->values.shape[0]; i++)
        for (int64_t j = 0; j < columns; j++)
            if (a->weights.used.data[j]) sum += (double)a->values.data[i * columns + j] * a->weights.factor;
    return to_int(a->negate ? -sum : sum) + a->bias + a->other.itemsize;
}
