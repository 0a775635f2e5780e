/* A thermostat as somebody has it: the objects, and two functions that read and write them. */
#include "application.h"

#include <stddef.h>
#include <string.h>

enum { NO_OBJECT = 0x06020000, NO_SUBINDEX = 0x06090011, READ_ONLY = 0x06010002,
       TOO_LONG = 0x06070012, TOO_SHORT = 0x06070013, TOO_HIGH = 0x06090031, TOO_LOW = 0x06090032 };

static uint8_t type[4], vendor[4], product[4] = { 100 }, revision[4] = { 1 }, serial[4] = { 1 };
static uint8_t identity_entries[1] = { 4 }, limit_entries[1] = { 2 };
static uint8_t temperature[2], set_point[2], lowest[2], highest[2], name[10];

static const struct object {
    uint16_t index;
    uint8_t subindex, writable, size;
    uint8_t *value;
    int16_t low, high;    /* equal: every value is taken */
} objects[] = {
    { 0x1000, 0, 0, 4, type, 0, 0 },
    { 0x1008, 0, 0, sizeof name, name, 0, 0 },
    { 0x1018, 0, 0, 1, identity_entries, 0, 0 },
    { 0x1018, 1, 0, 4, vendor, 0, 0 },
    { 0x1018, 2, 0, 4, product, 0, 0 },
    { 0x1018, 3, 0, 4, revision, 0, 0 },
    { 0x1018, 4, 0, 4, serial, 0, 0 },
    { 0x2000, 0, 0, 2, temperature, 0, 0 },
    { 0x2001, 0, 1, 2, set_point, -400, 1250 },
    { 0x2002, 0, 0, 1, limit_entries, 0, 0 },
    { 0x2002, 1, 1, 2, lowest, -400, 1250 },
    { 0x2002, 2, 1, 2, highest, -400, 1250 }
};

enum { OBJECTS = sizeof objects / sizeof objects[0] };

static const struct object *find(uint16_t index, uint8_t subindex)
{
    size_t n;
    for (n = 0; n < OBJECTS; n++) {
        if (objects[n].index == index && objects[n].subindex == subindex) {
            return &objects[n];
        }
    }
    return NULL;
}

static void set(uint8_t *value, int number)
{
    value[0] = (uint8_t)number;
    value[1] = (uint8_t)(number >> 8);
}

void switch_on(void)
{
    memcpy(name, "thermostat", sizeof name);
    set(temperature, 215);    /* tenths of a degree */
    set(set_point, 200);
    set(lowest, 50);
    set(highest, 300);
}

uint32_t read_object(uint16_t index, uint8_t subindex, uint8_t *data, size_t *length)
{
    const struct object *object = find(index, subindex);
    if (object == NULL) {
        return find(index, 0) == NULL ? NO_OBJECT : NO_SUBINDEX;
    }
    memcpy(data, object->value, object->size);
    *length = object->size;
    return 0;
}

uint32_t write_object(uint16_t index, uint8_t subindex, const uint8_t *data, size_t length)
{
    const struct object *object = find(index, subindex);
    if (object == NULL) {
        return find(index, 0) == NULL ? NO_OBJECT : NO_SUBINDEX;
    }
    if (!object->writable) {
        return READ_ONLY;
    }
    if (length != object->size) {
        return length > object->size ? TOO_LONG : TOO_SHORT;
    }
    if (data != NULL) {    /* all that can be written are two bytes */
        int value = (int16_t)(data[0] | data[1] << 8);
        if (object->low < object->high && (value < object->low || value > object->high)) {
            return value > object->high ? TOO_HIGH : TOO_LOW;
        }
        memcpy(object->value, data, length);
    }
    return 0;
}
