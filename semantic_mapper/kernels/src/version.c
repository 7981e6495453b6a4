#include "kernels.h"

__attribute__((visibility("default"))) const char source_digest[] = SOURCE_DIGEST;
