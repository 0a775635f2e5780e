/* The whole SubDevice in software. Firmware polls over and over; here the MainDevice can act only
 * through the functions below, so one poll after each of them is enough. */
#include "device.h"

void device_reset(struct device *device)
{
    chip_reset(&device->esc);
    slave_init(&device->slave, &device->esc, &device->application);
    application_reset(&device->slave);
}

int device_read(struct device *device, uint16_t address, uint8_t *data, size_t length)
{
    int counter = chip_main_read(&device->esc, address, data, length);
    slave_poll(&device->slave, 0);
    return counter;
}

int device_write(struct device *device, uint16_t address, const uint8_t *data, size_t length)
{
    int counter = chip_main_write(&device->esc, address, data, length);
    slave_poll(&device->slave, 0);
    return counter;
}

void device_advance(struct device *device, uint32_t microseconds)
{
    do {
        uint32_t step = microseconds, due = chip_due(&device->esc);
        uint32_t timer = device->application.drive.timer;
        /* not beyond what comes first, so that everything happens in its order */
        step = timer > 0 && timer < step ? timer : step;
        step = due > 0 && due < step ? due : step;
        microseconds -= step;
        chip_advance(&device->esc, step);
        slave_poll(&device->slave, step);
    } while (microseconds > 0);
}

int device_local(struct device *device, const char *event)
{
    int unknown = application_local(&device->slave, event);
    slave_poll(&device->slave, 0);
    return unknown;
}
