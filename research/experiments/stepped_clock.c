/* Preloaded: CLOCK_REALTIME as it would be after somebody has set it; the offset, in whole seconds, stands in a file.
 *
 *   cc -shared -fPIC -O1 -o stepped_clock.so stepped_clock.c -ldl
 *   LD_PRELOAD=./stepped_clock.so STEPPED_CLOCK=/tmp/offset program    (8 bytes, int64)
 *
 * All other clocks are the kernel's. Deadlines on CLOCK_REALTIME that a program hands to the kernel are off by the
 * offset, which is worse than a clock that really was set: whoever has any, hangs or spins.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>

static const volatile int64_t *offset;
static int (*real_gettime)(clockid_t, struct timespec *);

__attribute__((constructor)) static void begin(void)
{
    static const int64_t none = 0;
    const char *path = getenv("STEPPED_CLOCK");
    int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    void *page = file >= 0 ? mmap(NULL, 4096, PROT_READ, MAP_SHARED, file, 0) : MAP_FAILED;
    offset = page == MAP_FAILED ? &none : page;
    real_gettime = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
}

int clock_gettime(clockid_t clock, struct timespec *now)
{
    if (!real_gettime)
        begin();
    int failed = real_gettime(clock, now);
    if (!failed && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE))
        now->tv_sec += *offset;
    return failed;
}

int gettimeofday(struct timeval *now, void *zone)
{
    struct timespec t;
    (void)zone;
    if (clock_gettime(CLOCK_REALTIME, &t))
        return -1;
    now->tv_sec = t.tv_sec;
    now->tv_usec = t.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *where)
{
    struct timespec t;
    if (clock_gettime(CLOCK_REALTIME, &t))
        return -1;
    if (where)
        *where = t.tv_sec;
    return t.tv_sec;
}
