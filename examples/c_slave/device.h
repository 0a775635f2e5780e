/* The whole SubDevice in software: chip, stack and application, as a MainDevice sees them. */
#ifndef DEVICE_H
#define DEVICE_H

#include "application.h"
#include "chip.h"

struct device {
    struct esc esc;
    struct slave slave;
    struct application application;
};

/* Power cycle. */
void device_reset(struct device *device);

/* Read or write as a MainDevice. Returns the working counter: 0 where the access is refused. */
int device_read(struct device *device, uint16_t address, uint8_t *data, size_t length);
int device_write(struct device *device, uint16_t address, const uint8_t *data, size_t length);

/* Let time pass. */
void device_advance(struct device *device, uint32_t microseconds);

/* Raise an event of application_events in the device. Returns 0 if it knows the event. */
int device_local(struct device *device, const char *event);

#endif
