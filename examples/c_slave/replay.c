/* Replays test vectors on the device, as a firmware test does: vectors.h is the only thing needed.
 *
 *     ecatspec export slave.ecs --format c -o vectors.h
 *     make replay VECTORS=vectors.h && build/replay
 */
#include "device.h"
#include VECTORS

#include <stdio.h>

static struct device device;

static void bench_reset(void *context) { device_reset(context); }

static int bench_read(void *context, uint16_t address, uint8_t *data, size_t length)
{
    return device_read(context, address, data, length);
}

static int bench_write(void *context, uint16_t address, const uint8_t *data, size_t length)
{
    return device_write(context, address, data, length);
}

static void bench_advance(void *context, uint32_t microseconds) { device_advance(context, microseconds); }

static int bench_local(void *context, const char *event) { return device_local(context, event) == 0; }

int main(void)
{
    const struct ecatspec_target target = {
        &device, bench_reset, bench_read, bench_write, bench_advance, bench_local
    };
    static const char *const words[] = { "passed", "ended early", "skipped", "FAILED" };
    unsigned counts[4] = { 0, 0, 0, 0 };
    size_t number, place;

    for (number = 0; number < ECATSPEC_TESTS; number++) {
        struct ecatspec_result result = ecatspec_run(&target, number);
        counts[result.outcome]++;
        if (result.outcome != ECATSPEC_FAILED) continue;
        printf("FAILED %s: step %u, expectation %u, clauses %s, seen", ecatspec_tests[number].id,
               result.step, result.expected, result.clauses);
        for (place = 0; place < result.size; place++) printf(" %02x", ecatspec_seen[place]);
        printf("\n");
    }
    for (place = 0; place < 4; place++) printf("%u %s%s", counts[place], words[place], place < 3 ? ", " : "\n");
    return counts[ECATSPEC_FAILED] != 0;
}
