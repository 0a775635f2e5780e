/* The device as a shared library, level A of docs/adapters.md: make library, then
 * ecatspec run slave.ecs --dut lib:build/libslave.so */
#include "slave.h"

#include <ecatspec_dut.h>
#include <stdlib.h>

static void *device_create(void) { return calloc(1, sizeof(struct slave)); }

static void device_reset(void *device) { slave_reset(device); }

static int device_read(void *device, uint16_t address, uint8_t *data, size_t length)
{
    return slave_read(device, address, data, length);
}

static int device_write(void *device, uint16_t address, const uint8_t *data, size_t length)
{
    return slave_write(device, address, data, length);
}

static void device_advance(void *device, uint64_t microseconds)
{
    for (; microseconds > UINT32_MAX; microseconds -= UINT32_MAX) {
        slave_advance(device, UINT32_MAX);
    }
    slave_advance(device, (uint32_t)microseconds);
}

static int device_local(void *device, const char *event) { return slave_local(device, event); }

const struct ecatspec_dut *ecatspec_dut(void)
{
    static const struct ecatspec_device device = {
        device_create, free, device_reset, device_read, device_write, device_advance, device_local
    };
    static const struct ecatspec_dut dut = {
        .abi = ECATSPEC_DUT_ABI,
        .name = "c_slave",
        .locals = "ds402.fault ds402.fault_gone ds402.stopped ds402.reaction_done",
        .device = &device
    };
    return &dut;
}
