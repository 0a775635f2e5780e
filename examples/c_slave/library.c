/* The device as a shared library, level A of docs/adapters.md: make library, then
 * ecatspec run slave.ecs --dut lib:build/libslave.so */
#include "device.h"

#include <ecatspec_dut.h>
#include <stdlib.h>

static void *create(void) { return calloc(1, sizeof(struct device)); }

static void reset(void *device) { device_reset(device); }

static int read_memory(void *device, uint16_t address, uint8_t *data, size_t length)
{
    return device_read(device, address, data, length);
}

static int write_memory(void *device, uint16_t address, const uint8_t *data, size_t length)
{
    return device_write(device, address, data, length);
}

static void advance(void *device, uint64_t microseconds)
{
    for (; microseconds > UINT32_MAX; microseconds -= UINT32_MAX) {
        device_advance(device, UINT32_MAX);
    }
    device_advance(device, (uint32_t)microseconds);
}

static int local(void *device, const char *event) { return device_local(device, event); }

const struct ecatspec_dut *ecatspec_dut(void)
{
    static const struct ecatspec_device device = {
        create, free, reset, read_memory, write_memory, advance, local
    };
    static const struct ecatspec_dut dut = {
        .abi = ECATSPEC_DUT_ABI,
        .name = "c_slave",
        .protocols = "al coe ds402 emergency mailbox process_data sdo sdo_information",
        .locals = "ds402.fault ds402.fault_gone ds402.stopped ds402.reaction_done",
        .device = &device
    };
    return &dut;
}
