/* What the stack wants of the ESC. */
#include "slave.h"

#include <string.h>

uint16_t get16(const uint8_t *bytes)
{
    return (uint16_t)(bytes[0] | bytes[1] << 8);
}

uint32_t get32(const uint8_t *bytes)
{
    return get16(bytes) | (uint32_t)get16(bytes + 2) << 16;
}

void put16(uint8_t *bytes, uint16_t value)
{
    bytes[0] = (uint8_t)value;
    bytes[1] = (uint8_t)(value >> 8);
}

void put32(uint8_t *bytes, uint32_t value)
{
    put16(bytes, (uint16_t)value);
    put16(bytes + 2, (uint16_t)(value >> 16));
}

static uint16_t manager(int number, int offset)
{
    return (uint16_t)(REGISTER_SYNC_MANAGERS + MANAGER_SIZE * number + offset);
}

static int happened(const struct slave *slave, uint32_t event)
{
    return (slave->events & event) != 0;
}

int esc_take_settings(struct slave *slave)
{
    uint8_t registers[MANAGER_SIZE * SYNC_MANAGERS];
    int number;
    if (!happened(slave, EVENT_SETTINGS)) {
        return 0;
    }
    esc_read(slave->esc, REGISTER_SYNC_MANAGERS, registers, sizeof registers);
    for (number = 0; number < SYNC_MANAGERS; number++) {
        const uint8_t *at = registers + MANAGER_SIZE * number;
        struct manager *set = &slave->managers[number];
        set->start = get16(at);
        set->length = get16(at + 2);
        set->mailbox = (at[AT_CONTROL] & MODE_MASK) == MODE_MAILBOX;
        set->main_writes = (at[AT_CONTROL] & DIRECTION_MASK) == MAIN_WRITES;
        set->enabled = at[AT_ACTIVATION] & ENABLED
                       && (set->mailbox || (at[AT_CONTROL] & MODE_MASK) == MODE_BUFFERED);
        set->repeat = (at[AT_ACTIVATION] & REPEAT) != 0;
    }
    return 1;
}

int esc_take_al_control(struct slave *slave, uint16_t *control)
{
    uint8_t bytes[2];
    if (!happened(slave, EVENT_AL_CONTROL)) {
        return 0;
    }
    esc_read(slave->esc, REGISTER_AL_CONTROL, bytes, sizeof bytes);
    *control = get16(bytes);
    return 1;
}

int esc_take_watchdog(struct slave *slave)
{
    uint8_t status[2];
    if (!happened(slave, EVENT_WATCHDOG)) {
        return 0;
    }
    esc_read(slave->esc, REGISTER_WATCHDOG_STATUS, status, sizeof status);
    return 1;
}

int esc_take_outputs(struct slave *slave, uint8_t *image)
{
    const struct manager *set = &slave->managers[DATA_OUT];
    if (!happened(slave, EVENT_MANAGER_0 << DATA_OUT) || set->start != OUTPUTS_START
        || set->length != outputs_length) {
        return 0;
    }
    esc_read(slave->esc, OUTPUTS_START, image, outputs_length);
    return 1;
}

int esc_take_mail(struct slave *slave, uint8_t message[MAILBOX_OUT_LENGTH])
{
    if (!happened(slave, EVENT_MANAGER_0 << MAIL_OUT)) {
        return 0;
    }
    esc_read(slave->esc, MAILBOX_OUT_START, message, MAILBOX_OUT_LENGTH);
    return 1;
}

void esc_free_mail(struct slave *slave)
{
    const struct manager *set = &slave->managers[MAIL_OUT];
    uint8_t byte;
    if (set->enabled && set->length > 0 && happened(slave, EVENT_MANAGER_0 << MAIL_OUT)) {
        /* a mailbox opens with its first byte and is free with its last one */
        esc_read(slave->esc, set->start, &byte, 1);
        esc_read(slave->esc, (uint16_t)(set->start + set->length - 1), &byte, 1);
    }
}

int esc_mail_read(struct slave *slave)
{
    uint8_t status;
    esc_read(slave->esc, manager(MAIL_IN, AT_STATUS), &status, 1);
    return !(status & FULL);
}

void esc_put_mail(struct slave *slave, const uint8_t message[MAILBOX_IN_LENGTH])
{
    esc_write(slave->esc, MAILBOX_IN_START, message, MAILBOX_IN_LENGTH);
}

static void control_mail(struct slave *slave, int bits)
{
    uint8_t control = (uint8_t)bits;
    esc_write(slave->esc, manager(MAIL_IN, AT_PDI_CONTROL), &control, 1);
}

void esc_drop_mail(struct slave *slave)
{
    control_mail(slave, DEACTIVATED);
    esc_acknowledge_repeat(slave, slave->mailbox.repeat_acknowledged);
}

void esc_acknowledge_repeat(struct slave *slave, int bit)
{
    control_mail(slave, bit ? REPEAT_ACKNOWLEDGED : 0);
}

void esc_show_al(struct slave *slave, uint16_t status, uint16_t code)
{
    uint8_t bytes[2];
    /* the code comes first: a MainDevice that sees the error reads the code at once */
    put16(bytes, code);
    esc_write(slave->esc, REGISTER_AL_STATUS_CODE, bytes, sizeof bytes);
    put16(bytes, status);
    esc_write(slave->esc, REGISTER_AL_STATUS, bytes, sizeof bytes);
}
