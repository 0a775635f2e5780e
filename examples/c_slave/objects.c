/* The object dictionary: what slave.ecs lists, and who may read and write it when. */
#include "application.h"
#include "faults.h"

#include <string.h>

enum { NEVER = 0, ALWAYS = PREOP | SAFEOP | OP, IN_OPERATION = SAFEOP | OP };

struct object {
    uint16_t index;
    uint8_t subindex, size;
    uint8_t readable, writable;   /* AL states */
    uint16_t offset;              /* in struct values; CONSTANT: the number or the text is the value */
    uint32_t number;
    const char *text;
    int32_t lowest, highest;      /* equal: no range */
};

enum { CONSTANT = 0xFFFF };
enum { CYCLIC_SYNCHRONOUS_POSITION = 8 };

#define FIXED(index, subindex, size, number) \
    { index, subindex, size, ALWAYS, NEVER, CONSTANT, number, NULL, 0, 0 }
#define FIXED_TEXT(index, text) \
    { index, 0, sizeof text - 1, ALWAYS, NEVER, CONSTANT, 0, text, 0, 0 }
#define RANGED(index, subindex, readable, writable, name, lowest, highest) \
    { index, subindex, sizeof ((struct values *)0)->name, readable, writable, \
      offsetof(struct values, name), 0, NULL, lowest, highest }
#define VALUE(index, subindex, readable, writable, name) \
    RANGED(index, subindex, readable, writable, name, 0, 0)

static const struct object objects[] = {
    FIXED(0x1000, 0, 4, 0x00020192),                            /* device type: drive */
    FIXED_TEXT(0x1008, "ecatspec C slave"),
    FIXED(0x1018, 0, 1, 4),                                     /* identity */
    FIXED(0x1018, 1, 4, 0),
    FIXED(0x1018, 2, 4, 99),
    FIXED(0x1018, 3, 4, 1),
    FIXED(0x1018, 4, 4, 1),
    FIXED(0x1600, 0, 1, 2),                                     /* what the outputs hold */
    FIXED(0x1600, 1, 4, 0x60400010),
    FIXED(0x1600, 2, 4, 0x607A0020),
    FIXED(0x1A00, 0, 1, 3),                                     /* what the inputs hold */
    FIXED(0x1A00, 1, 4, 0x60410010),
    FIXED(0x1A00, 2, 4, 0x60640020),
    FIXED(0x1A00, 3, 4, 0x60610008),
    FIXED(0x1C12, 0, 1, 1),
    FIXED(0x1C12, 1, 2, 0x1600),
    FIXED(0x1C13, 0, 1, 1),
    FIXED(0x1C13, 1, 2, 0x1A00),
    VALUE(0x2000, 0, ALWAYS, ALWAYS, note),
    RANGED(0x2001, 0, ALWAYS, ALWAYS, limit, 10, 1000),
    VALUE(0x2002, 0, ALWAYS, ALWAYS, turns),
    VALUE(0x2003, 0, NEVER, ALWAYS, key),
    VALUE(0x2004, 0, ALWAYS, PREOP, tuning),
    VALUE(0x2005, 0, IN_OPERATION, NEVER, load),
    FIXED(0x2010, 0, 1, 2),
    RANGED(0x2010, 1, ALWAYS, ALWAYS, gain_of_position, -500, 500),
    VALUE(0x2010, 2, ALWAYS, ALWAYS, gain_of_velocity),
    FIXED(0x6007, 0, 2, 2),                                     /* leaving OP disables the drive */
    VALUE(0x6040, 0, ALWAYS, ALWAYS, control_word),
    VALUE(0x6041, 0, ALWAYS, NEVER, status_word),
    FIXED(0x605A, 0, 2, 2),                                     /* quick stop ramp, then disabled */
    VALUE(0x6060, 0, ALWAYS, ALWAYS, mode),
    VALUE(0x6061, 0, ALWAYS, NEVER, mode_shown),
    VALUE(0x6064, 0, ALWAYS, NEVER, position),
    VALUE(0x607A, 0, ALWAYS, ALWAYS, target_position),
    FIXED(0x6502, 0, 4, 1u << (CYCLIC_SYNCHRONOUS_POSITION - 1))
};

enum { OBJECTS = sizeof objects / sizeof objects[0] };

void objects_reset(struct values *values)
{
    static const char note[] =
        "a note of the user that is too long for one message and travels in segments";
    memset(values, 0, sizeof *values);
    memcpy(values->note, note, sizeof note - 1);
    values->note_length = sizeof note - 1;
    put16(values->limit, 100);
    put32(values->turns, 0x89ABCDEFu);
    put32(values->turns + 4, 0x01234567u);
    put16(values->tuning, 2);
    put16(values->load, 3);
    put16(values->gain_of_position, 20);
    values->gain_of_velocity[0] = 7;
}

static const struct object *find(uint16_t index, uint8_t subindex)
{
    const struct object *object;
    for (object = objects; object < objects + OBJECTS; object++) {
        if (object->index == index && object->subindex == subindex) {
            return object;
        }
    }
    return NULL;
}

size_t object_size(uint16_t index, uint8_t subindex)
{
    const struct object *object = find(index, subindex);
    return object == NULL ? 0 : object->size;
}

static uint32_t missing(uint16_t index)
{
    return find(index, 0) != NULL && !PLANTED(SDO_WRONG_ABORT) ? ABORT_NO_SUBINDEX : ABORT_NO_OBJECT;
}

/* A text may be shorter than its object, everything else has one size. */
static int is_text(const struct object *object)
{
    return object->offset == offsetof(struct values, note);
}

uint32_t object_read(struct slave *slave, uint16_t index, uint8_t subindex, uint8_t *data,
                     size_t *length)
{
    const struct values *values = &slave->application->values;
    const struct object *object = find(index, subindex);
    uint8_t number[4];
    if (object == NULL) {
        return missing(index);
    }
    if (object->readable == NEVER) {
        return ABORT_WRITE_ONLY;
    }
    if (!(object->readable & slave->al.state) && !PLANTED(SDO_STATE_UNCHECKED)) {
        return ABORT_STATE;
    }
    *length = is_text(object) ? values->note_length : object->size;
    if (object->offset != CONSTANT) {
        memcpy(data, (const uint8_t *)values + object->offset, *length);
    } else if (object->text != NULL) {
        memcpy(data, object->text, *length);
    } else {
        put32(number, object->number);
        memcpy(data, number, *length);
    }
    return ABORT_NONE;
}

/* What can be judged before the data have come. */
static uint32_t announced(const struct slave *slave, const struct object *object, size_t length)
{
    if (object->writable == NEVER) {
        return ABORT_READ_ONLY;
    }
    if (!(object->writable & slave->al.state) && !PLANTED(SDO_STATE_UNCHECKED)) {
        return ABORT_STATE;
    }
    if (length > object->size) {
        return ABORT_TOO_LONG;
    }
    if (length < object->size && !is_text(object) && !PLANTED(SDO_SIZE_UNCHECKED)) {
        return ABORT_TOO_SHORT;
    }
    return ABORT_NONE;
}

static uint32_t out_of_range(const struct object *object, const uint8_t *data)
{
    int32_t value;
    if (object->lowest == object->highest) {
        return ABORT_NONE;
    }
    value = get16(data);    /* all that have a range are two bytes long */
    if (object->lowest < 0 && value > INT16_MAX) {
        value -= UINT16_MAX + 1;
    }
    if (value > object->highest) {
        return ABORT_TOO_HIGH;
    }
    return value < object->lowest && !PLANTED(SDO_RANGE_ONE_SIDED) ? ABORT_TOO_LOW : ABORT_NONE;
}

uint32_t object_write(struct slave *slave, uint16_t index, uint8_t subindex, const uint8_t *data,
                      size_t length)
{
    const struct object *object = find(index, subindex);
    struct values *values = &slave->application->values;
    uint8_t *at;
    uint32_t code;
    if (object == NULL) {
        return missing(index);
    }
    if (data == NULL) {
        return announced(slave, object, length);
    }
    code = out_of_range(object, data);
    if (code != ABORT_NONE) {
        return code;
    }
    at = (uint8_t *)values + object->offset;
    if (at == values->mode && data[0] != CYCLIC_SYNCHRONOUS_POSITION) {
        return ABORT_RANGE;
    }
    /* in OP the process data bring these */
    if ((at == values->control_word || at == values->target_position) && slave->al.state == OP) {
        return ABORT_MAPPED;
    }
    memset(at, 0, object->size);
    memcpy(at, data, length);
    if (is_text(object)) {
        values->note_length = length;
    }
    values->mode_shown[0] = values->mode[0];
    return ABORT_NONE;
}
