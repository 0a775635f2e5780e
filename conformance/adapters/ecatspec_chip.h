/* ecatspec_chip.h: the chip of level B in C, so that a run takes about the time of level A.
 *
 * The library of a stack includes it in one file:
 *
 *   #include <ecatspec_chip.h>
 *
 * Nothing else changes: table and hooks are those of ecatspec_dut.h, which comes with it. The library
 * then exports ecatspec_chip() too, and ecatspec uses what that gives instead of its chip in Python.
 * Both chips do the same. With -DECATSPEC_PYTHON_CHIP this file is ecatspec_dut.h and nothing else.
 */
#ifndef ECATSPEC_CHIP_H
#define ECATSPEC_CHIP_H

#include "ecatspec_dut.h"

#ifndef ECATSPEC_PYTHON_CHIP

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The version of the tables below. A library that was built with another is refused. */
#define ECATSPEC_CHIP_ABI 1

/* Bytes of memory. */
struct ecatspec_chip_span {
    uint16_t address, size;
};

/* Bits of memory: the lowest is bit `low` of the byte at `address`. */
struct ecatspec_chip_field {
    uint16_t address;
    uint8_t low, bits;
};

/* What the text of a device says of its chip. The pointers need to last until `create` returns. */
struct ecatspec_chip_settings {
    uint32_t memory_size;                        /* at most 0x10000 */
    uint32_t registers_end;                      /* behind the last register */
    uint32_t poll;                               /* microseconds between two polls, at least 1 */
    uint32_t writable_registers;                 /* how many there are in `writable` */
    const uint8_t *reset;                        /* the registers at power-on */
    const struct ecatspec_chip_span *writable;   /* registers that the MainDevice may write */
};

/* What ecatspec calls. */
struct ecatspec_chip {
    uint32_t abi;                                /* ECATSPEC_CHIP_ABI */
    uint32_t numbers;                            /* ECATSPEC_CHIP_NUMBERS */
    void *(*create)(const struct ecatspec_stack *stack, const struct ecatspec_chip_settings *settings);
    struct ecatspec_device device;               /* of what `create` gave; its own `create` is null */
};

/* Where the registers of a SyncManager lie, and what its status and its event are made of. */
struct ecatspec_chip_manager {
    struct ecatspec_chip_span settings, status, activation, pdi_control;
    struct ecatspec_chip_field start, length, mode, direction, enabled, deactivated;
    uint8_t is_mailbox, wanted_mode, status_reset;
    uint8_t written, taken, full, last_buffer, read_open, write_open;    /* masks of the status */
    uint32_t event;
};

/* made from the texts: `make chip` writes from here */
static const struct ecatspec_chip_manager ecatspec_chip_managers[] = {
    { { 0x0800, 5 }, { 0x0805, 1 }, { 0x0806, 1 }, { 0x0807, 1 },
      { 0x0800, 0, 16 }, { 0x0802, 0, 16 }, { 0x0804, 0, 2 }, { 0x0804, 2, 2 },
      { 0x0806, 0, 1 }, { 0x0807, 0, 1 },
      1, 2, 0x0, 0x1, 0x2, 0x8, 0x0, 0x0, 0x0, 0x100 },
    { { 0x0808, 5 }, { 0x080d, 1 }, { 0x080e, 1 }, { 0x080f, 1 },
      { 0x0808, 0, 16 }, { 0x080a, 0, 16 }, { 0x080c, 0, 2 }, { 0x080c, 2, 2 },
      { 0x080e, 0, 1 }, { 0x080f, 0, 1 },
      1, 2, 0x0, 0x1, 0x2, 0x8, 0x0, 0x0, 0x0, 0x200 },
    { { 0x0810, 5 }, { 0x0815, 1 }, { 0x0816, 1 }, { 0x0817, 1 },
      { 0x0810, 0, 16 }, { 0x0812, 0, 16 }, { 0x0814, 0, 2 }, { 0x0814, 2, 2 },
      { 0x0816, 0, 1 }, { 0x0817, 0, 1 },
      0, 0, 0x30, 0x1, 0x2, 0x0, 0x30, 0x40, 0x80, 0x400 },
    { { 0x0818, 5 }, { 0x081d, 1 }, { 0x081e, 1 }, { 0x081f, 1 },
      { 0x0818, 0, 16 }, { 0x081a, 0, 16 }, { 0x081c, 0, 2 }, { 0x081c, 2, 2 },
      { 0x081e, 0, 1 }, { 0x081f, 0, 1 },
      0, 0, 0x30, 0x1, 0x2, 0x0, 0x30, 0x40, 0x80, 0x800 },
};
static const struct ecatspec_chip_span
    ecatspec_chip_al_control = { 0x0120, 2 },
    ecatspec_chip_al_event_request = { 0x0220, 4 },
    ecatspec_chip_watchdog_status = { 0x0440, 2 };
enum {
    ECATSPEC_CHIP_AL_CONTROL_EVENT = 0x1,
    ECATSPEC_CHIP_CHANGE_EVENT = 0x10,
    ECATSPEC_CHIP_WATCHDOG_EVENT = 0x40,
    ECATSPEC_CHIP_WATCHDOG_RUNNING = 0x1,
    ECATSPEC_CHIP_MAIN_WRITES = 0x1,
    ECATSPEC_CHIP_OUTPUTS = 0x2
};
#define ECATSPEC_CHIP_WATCHDOG_ON(chip) \
    (ecatspec_chip_bits(chip, 0x0814, 6, 1) && (ecatspec_chip_bits(chip, 0x0420, 0, 16) > 0))
#define ECATSPEC_CHIP_WATCHDOG_TIME(chip) \
    (((ecatspec_chip_bits(chip, 0x0400, 0, 16) + 2) * ecatspec_chip_bits(chip, 0x0420, 0, 16)) / 25)
#define ECATSPEC_CHIP_NUMBERS 0x55ee24d9u
/* made from the texts: to here */

enum {
    ECATSPEC_CHIP_MEMORY = 0x10000,
    ECATSPEC_CHIP_MANAGERS = sizeof ecatspec_chip_managers / sizeof ecatspec_chip_managers[0],
    ECATSPEC_CHIP_BUFFERS = 3,
    ECATSPEC_CHIP_NONE = -1
};

/* The buffers of a SyncManager since it was set up: one of a mailbox, three of process data. One side
 * writes, the other reads. */
struct ecatspec_chip_buffers {
    int set_up, off, main_writes, count;
    uint32_t start, length;
    int written, taken;                 /* events: of a complete image, of one that was read */
    int newest, writing, reading;       /* numbers of buffers, or ECATSPEC_CHIP_NONE */
    uint8_t images[ECATSPEC_CHIP_BUFFERS][ECATSPEC_CHIP_MEMORY];
};

struct ecatspec_chip_state {
    const struct ecatspec_stack *functions;
    void *stack;
    struct ecatspec_esc hooks;
    struct ecatspec_chip_settings settings;
    struct ecatspec_chip_span *writable;
    uint8_t reset[ECATSPEC_CHIP_MEMORY], memory[ECATSPEC_CHIP_MEMORY];
    uint32_t events;
    int al_control_locked;
    uint64_t watchdog;                  /* microseconds until it expires; 0: it does not run */
    struct ecatspec_chip_buffers managers[ECATSPEC_CHIP_MANAGERS];
};

/* --- registers --------------------------------------------------------------------------------- */

static uint32_t ecatspec_chip_get(const struct ecatspec_chip_state *chip,
                                  struct ecatspec_chip_field field)
{
    uint64_t content = 0;
    int byte;
    for (byte = (field.low + field.bits - 1) / 8; byte >= 0; byte--) {
        content = content << 8 | chip->memory[field.address + byte];
    }
    return (uint32_t)(content >> field.low & (((uint64_t)1 << field.bits) - 1));
}

static uint64_t ecatspec_chip_bits(const struct ecatspec_chip_state *chip, uint16_t address, int low,
                                   int bits)
{
    struct ecatspec_chip_field field;
    field.address = address;
    field.low = (uint8_t)low;
    field.bits = (uint8_t)bits;
    return ecatspec_chip_get(chip, field);
}

static void ecatspec_chip_put(struct ecatspec_chip_state *chip, struct ecatspec_chip_span span,
                              uint32_t content)
{
    int byte;
    for (byte = 0; byte < span.size; byte++) {
        chip->memory[span.address + byte] = (uint8_t)(content >> 8 * byte);
    }
}

/* Whether the memory has all bytes of an access. */
static int ecatspec_chip_holds(const struct ecatspec_chip_state *chip, uint16_t address, size_t length)
{
    size_t size = chip->settings.memory_size;
    return address <= size && length <= size - address;
}

static int ecatspec_chip_meets(struct ecatspec_chip_span span, uint32_t address, size_t length)
{
    return address < (uint32_t)span.address + span.size && span.address < address + length;
}

/* --- buffers ----------------------------------------------------------------------------------- */

/* Let the status register and the event tell what became of the buffers. */
static void ecatspec_chip_show_buffers(struct ecatspec_chip_state *chip, int number)
{
    const struct ecatspec_chip_manager *manager = &ecatspec_chip_managers[number];
    const struct ecatspec_chip_buffers *buffers = &chip->managers[number];
    uint32_t status = manager->status_reset;
    chip->events &= ~manager->event;
    if (buffers->set_up) {
        int full = buffers->newest != ECATSPEC_CHIP_NONE;
        status |= buffers->written ? manager->written : 0u;
        status |= buffers->taken ? manager->taken : 0u;
        status |= full ? manager->full : 0u;
        status |= buffers->reading != ECATSPEC_CHIP_NONE ? manager->read_open : 0u;
        status |= buffers->writing != ECATSPEC_CHIP_NONE ? manager->write_open : 0u;
        if (full) {
            uint32_t lowest = manager->last_buffer & (~(uint32_t)manager->last_buffer + 1);
            status = (status & ~(uint32_t)manager->last_buffer) | (uint32_t)buffers->newest * lowest;
        }
        if (buffers->main_writes ? buffers->written : buffers->taken) {
            chip->events |= manager->event;
        }
    }
    ecatspec_chip_put(chip, manager->status, status);
}

/* Set the areas up as the registers say; one whose settings stay keeps its buffers. */
static void ecatspec_chip_arrange(struct ecatspec_chip_state *chip)
{
    int number, n;
    for (number = 0; number < ECATSPEC_CHIP_MANAGERS; number++) {
        const struct ecatspec_chip_manager *manager = &ecatspec_chip_managers[number];
        struct ecatspec_chip_buffers *buffers = &chip->managers[number];
        uint32_t start = ecatspec_chip_get(chip, manager->start);
        uint32_t length = ecatspec_chip_get(chip, manager->length);
        int main_writes =
            ecatspec_chip_get(chip, manager->direction) == ECATSPEC_CHIP_MAIN_WRITES;
        int off = ecatspec_chip_get(chip, manager->deactivated) != 0;
        /* the registers lie below the memory that a SyncManager can cover */
        if (!ecatspec_chip_get(chip, manager->enabled) || start < chip->settings.registers_end
            || length == 0 || ecatspec_chip_get(chip, manager->mode) != manager->wanted_mode) {
            buffers->set_up = 0;
        } else if (!buffers->set_up || buffers->start != start || buffers->length != length
                   || buffers->main_writes != main_writes || buffers->off != off) {
            buffers->set_up = 1;
            buffers->start = start;
            buffers->length = length;
            buffers->main_writes = main_writes;
            buffers->off = off;
            buffers->count = manager->is_mailbox ? 1 : ECATSPEC_CHIP_BUFFERS;
            buffers->written = buffers->taken = 0;
            buffers->newest = buffers->writing = buffers->reading = ECATSPEC_CHIP_NONE;
            for (n = 0; n < buffers->count; n++) {
                memset(buffers->images[n], 0, length);
            }
        }
        ecatspec_chip_show_buffers(chip, number);
    }
}

static int ecatspec_chip_is_mailbox(const struct ecatspec_chip_buffers *buffers)
{
    return buffers->count == 1;
}

/* The first end of an area, of what can be accessed of it, or of the access that comes. */
static uint32_t ecatspec_chip_piece_end(const struct ecatspec_chip_state *chip, uint32_t address,
                                        uint32_t end)
{
    int number, n;
    for (number = 0; number < ECATSPEC_CHIP_MANAGERS; number++) {
        const struct ecatspec_chip_buffers *buffers = &chip->managers[number];
        uint32_t borders[3];
        borders[0] = buffers->start;
        borders[1] = buffers->start + buffers->length;
        borders[2] = buffers->start + buffers->length * (uint32_t)buffers->count;
        for (n = 0; buffers->set_up && n < 3; n++) {
            if (address < borders[n] && borders[n] < end) {
                end = borders[n];
            }
        }
    }
    return end;
}

/* Whose area an address is; an area counts before the hidden buffers of another. */
static int ecatspec_chip_owner(const struct ecatspec_chip_state *chip, uint32_t address)
{
    int number, hidden = ECATSPEC_CHIP_NONE;
    for (number = 0; number < ECATSPEC_CHIP_MANAGERS; number++) {
        const struct ecatspec_chip_buffers *buffers = &chip->managers[number];
        if (buffers->set_up && address >= buffers->start) {
            uint32_t offset = address - buffers->start;
            if (offset < buffers->length) {
                return number;
            }
            if (offset < buffers->length * (uint32_t)buffers->count) {
                hidden = number;
            }
        }
    }
    return hidden;
}

/* Write a piece of an area; 0 where it is refused: nothing is free, or it begins wrongly. */
static int ecatspec_chip_fill(struct ecatspec_chip_buffers *buffers, uint32_t offset,
                              const uint8_t *data, size_t length)
{
    if (buffers->off
        || (ecatspec_chip_is_mailbox(buffers) && buffers->newest != ECATSPEC_CHIP_NONE)) {
        return 0;
    }
    if (buffers->writing == ECATSPEC_CHIP_NONE) {
        if (offset > 0) {
            return 0;
        }
        for (buffers->writing = 0; buffers->writing == buffers->newest
                                   || buffers->writing == buffers->reading; buffers->writing++) {
        }
    }
    if (offset == 0) {
        buffers->taken = 0;
    }
    memcpy(buffers->images[buffers->writing] + offset, data, length);
    if (offset + length == buffers->length) {
        buffers->newest = buffers->writing;
        buffers->writing = ECATSPEC_CHIP_NONE;
        buffers->written = 1;
    }
    return 1;
}

/* Read a piece of an area; 0 where it is refused: there is nothing, or it begins wrongly. */
static int ecatspec_chip_take(struct ecatspec_chip_buffers *buffers, uint32_t offset, uint8_t *data,
                              size_t length)
{
    if (buffers->off) {
        return 0;
    }
    if (offset == 0) {
        buffers->reading = buffers->newest;
        buffers->written = 0;
    }
    if (buffers->reading == ECATSPEC_CHIP_NONE) {
        return 0;
    }
    memcpy(data, buffers->images[buffers->reading] + offset, length);
    if (offset + length == buffers->length) {
        buffers->reading = ECATSPEC_CHIP_NONE;
        buffers->taken = 1;
        if (ecatspec_chip_is_mailbox(buffers)) {
            buffers->newest = ECATSPEC_CHIP_NONE;
        }
    }
    return 1;
}

/* --- memory, for both sides -------------------------------------------------------------------- */

/* Read, in pieces that lie in one area or in none; what is refused is zeros. Gives whether one was
 * carried out. */
static int ecatspec_chip_read(struct ecatspec_chip_state *chip, uint32_t address, uint8_t *data,
                              size_t length, int main_device)
{
    uint32_t end = address + (uint32_t)length;
    int done = 0;
    while (address < end) {
        uint32_t piece = ecatspec_chip_piece_end(chip, address, end) - address;
        int owner = ecatspec_chip_owner(chip, address), taken = 1;
        if (owner == ECATSPEC_CHIP_NONE) {
            memcpy(data, chip->memory + address, piece);
        } else {
            struct ecatspec_chip_buffers *buffers = &chip->managers[owner];
            uint32_t offset = address - buffers->start;
            taken = 0;
            if (buffers->main_writes != main_device && offset < buffers->length) {
                taken = ecatspec_chip_take(buffers, offset, data, piece);
                ecatspec_chip_show_buffers(chip, owner);
            }
        }
        if (!taken) {
            memset(data, 0, piece);
        }
        done |= taken;
        address += piece;
        data += piece;
    }
    return done;
}

/* Write a piece of an area from one side; gives whether it was carried out. */
static int ecatspec_chip_write_area(struct ecatspec_chip_state *chip, int owner, uint32_t address,
                                    const uint8_t *data, size_t length, int main_device)
{
    struct ecatspec_chip_buffers *buffers = &chip->managers[owner];
    uint32_t offset = address - buffers->start;
    int done;
    if (buffers->main_writes != main_device || offset >= buffers->length) {
        return 0;
    }
    done = ecatspec_chip_fill(buffers, offset, data, length);
    ecatspec_chip_show_buffers(chip, owner);
    return done;
}

/* --- the side of the MainDevice ---------------------------------------------------------------- */

/* The SyncManager to which a register belongs. */
static int ecatspec_chip_manager_of(struct ecatspec_chip_span at)
{
    int number;
    for (number = 0; number < ECATSPEC_CHIP_MANAGERS; number++) {
        const struct ecatspec_chip_manager *manager = &ecatspec_chip_managers[number];
        if (at.address == manager->settings.address || at.address == manager->status.address
            || at.address == manager->activation.address
            || at.address == manager->pdi_control.address) {
            return number;
        }
    }
    return ECATSPEC_CHIP_NONE;
}

/* Write what an access has of a register. */
static int ecatspec_chip_write_register(struct ecatspec_chip_state *chip,
                                        struct ecatspec_chip_span at, uint32_t address,
                                        const uint8_t *data, size_t length)
{
    int manager = ecatspec_chip_manager_of(at);
    uint32_t low = address > at.address ? address : at.address;
    uint32_t end = (uint32_t)at.address + at.size;
    if (end > address + length) {
        end = address + (uint32_t)length;
    }
    if (at.address == ecatspec_chip_al_control.address) {
        if (chip->al_control_locked) {
            return 0;
        }
        chip->al_control_locked = 1;
        chip->events |= ECATSPEC_CHIP_AL_CONTROL_EVENT;
    }
    if (manager != ECATSPEC_CHIP_NONE
        && at.address == ecatspec_chip_managers[manager].settings.address
        && ecatspec_chip_get(chip, ecatspec_chip_managers[manager].enabled)) {
        return 1;
    }
    memcpy(chip->memory + low, data + (low - address), end - low);
    if (manager != ECATSPEC_CHIP_NONE) {
        ecatspec_chip_arrange(chip);
        chip->events |= ECATSPEC_CHIP_CHANGE_EVENT;
    }
    return 1;
}

static int ecatspec_chip_write_memory(struct ecatspec_chip_state *chip, uint32_t address,
                                      const uint8_t *data, size_t length)
{
    int done = 0;
    uint32_t n;
    if (address >= chip->settings.registers_end) {
        memcpy(chip->memory + address, data, length);
        return 1;
    }
    for (n = 0; n < chip->settings.writable_registers; n++) {
        if (ecatspec_chip_meets(chip->writable[n], address, length)) {
            done |= ecatspec_chip_write_register(chip, chip->writable[n], address, data, length);
        }
    }
    return done;
}

static void ecatspec_chip_show_watchdog(struct ecatspec_chip_state *chip, int running)
{
    ecatspec_chip_put(chip, ecatspec_chip_watchdog_status,
                      running ? ECATSPEC_CHIP_WATCHDOG_RUNNING : 0);
}

/* Follow the settings of the watchdog; outputs restart it. */
static void ecatspec_chip_watch(struct ecatspec_chip_state *chip, int fed)
{
    if (!ECATSPEC_CHIP_WATCHDOG_ON(chip)) {
        chip->watchdog = 0;
        ecatspec_chip_show_watchdog(chip, 1);
    } else if (fed) {
        chip->watchdog = ECATSPEC_CHIP_WATCHDOG_TIME(chip);
        ecatspec_chip_show_watchdog(chip, 1);
    } else if (chip->watchdog == 0) {
        ecatspec_chip_show_watchdog(chip, 0);
    }
}

/* Each image of the outputs that is complete has another buffer. */
static int ecatspec_chip_newest_outputs(const struct ecatspec_chip_state *chip)
{
    const struct ecatspec_chip_manager *outputs = &ecatspec_chip_managers[ECATSPEC_CHIP_OUTPUTS];
    return chip->memory[outputs->status.address] & outputs->last_buffer;
}

static void ecatspec_chip_poll(struct ecatspec_chip_state *chip, uint64_t microseconds)
{
    chip->functions->poll(chip->stack, (uint32_t)microseconds);
}

static int ecatspec_chip_main_read(void *device, uint16_t address, uint8_t *data, size_t length)
{
    struct ecatspec_chip_state *chip = (struct ecatspec_chip_state *)device;
    uint32_t before = chip->events;
    int counter;
    if (!ecatspec_chip_holds(chip, address, length)) {
        return 0;
    }
    counter = ecatspec_chip_read(chip, address, data, length, 1);
    if (chip->events != before) {
        ecatspec_chip_poll(chip, 0);
    }
    return counter;
}

static int ecatspec_chip_main_write(void *device, uint16_t address, const uint8_t *data,
                                    size_t length)
{
    struct ecatspec_chip_state *chip = (struct ecatspec_chip_state *)device;
    int newest = ecatspec_chip_newest_outputs(chip), counter = 0;
    uint32_t at = address, end = address + (uint32_t)length;
    while (at < end && ecatspec_chip_holds(chip, address, length)) {
        uint32_t piece = ecatspec_chip_piece_end(chip, at, end) - at;
        int owner = ecatspec_chip_owner(chip, at);
        if (owner == ECATSPEC_CHIP_NONE) {
            counter |= ecatspec_chip_write_memory(chip, at, data, piece);
        } else {
            counter |= ecatspec_chip_write_area(chip, owner, at, data, piece, 1);
        }
        at += piece;
        data += piece;
    }
    ecatspec_chip_watch(chip, ecatspec_chip_newest_outputs(chip) != newest);
    ecatspec_chip_poll(chip, 0);
    return counter;
}

/* --- the side of the device -------------------------------------------------------------------- */

static void ecatspec_chip_within(const struct ecatspec_chip_state *chip, uint16_t address,
                                 size_t length)
{
    if (!ecatspec_chip_holds(chip, address, length)) {
        fprintf(stderr, "%lu bytes at 0x%04x are not in the memory of the ESC\n",
                (unsigned long)length, (unsigned)address);
        fflush(stderr);
        abort();
    }
}

static uint32_t ecatspec_chip_al_event(void *context)
{
    return ((const struct ecatspec_chip_state *)context)->events;
}

/* Take the events of the registers that the device reads. */
static void ecatspec_chip_look(struct ecatspec_chip_state *chip, uint32_t address, size_t length)
{
    int number;
    if (ecatspec_chip_meets(ecatspec_chip_al_control, address, length)) {
        chip->al_control_locked = 0;
        chip->events &= ~(uint32_t)ECATSPEC_CHIP_AL_CONTROL_EVENT;
    }
    for (number = 0; number < ECATSPEC_CHIP_MANAGERS; number++) {
        if (ecatspec_chip_meets(ecatspec_chip_managers[number].activation, address, length)) {
            chip->events &= ~(uint32_t)ECATSPEC_CHIP_CHANGE_EVENT;
        }
    }
    if (ecatspec_chip_meets(ecatspec_chip_al_event_request, address, length)) {
        ecatspec_chip_put(chip, ecatspec_chip_al_event_request, chip->events);
    }
    if (ecatspec_chip_meets(ecatspec_chip_watchdog_status, address, length)) {
        chip->events &= ~(uint32_t)ECATSPEC_CHIP_WATCHDOG_EVENT;
    }
}

static void ecatspec_chip_pdi_read(void *context, uint16_t address, void *data, size_t length)
{
    struct ecatspec_chip_state *chip = (struct ecatspec_chip_state *)context;
    ecatspec_chip_within(chip, address, length);
    if (length > 0) {
        if (address < chip->settings.registers_end) {
            ecatspec_chip_look(chip, address, length);
        }
        ecatspec_chip_read(chip, address, (uint8_t *)data, length, 0);
    }
}

static void ecatspec_chip_pdi_write(void *context, uint16_t address, const void *data, size_t length)
{
    struct ecatspec_chip_state *chip = (struct ecatspec_chip_state *)context;
    const uint8_t *from = (const uint8_t *)data;
    uint32_t at = address, end = address + (uint32_t)length;
    int number, controlled = 0;
    ecatspec_chip_within(chip, address, length);
    while (at < end) {
        uint32_t piece = ecatspec_chip_piece_end(chip, at, end) - at;
        int owner = ecatspec_chip_owner(chip, at);
        if (owner == ECATSPEC_CHIP_NONE) {
            memcpy(chip->memory + at, from, piece);
        } else {
            ecatspec_chip_write_area(chip, owner, at, from, piece, 0);
        }
        at += piece;
        from += piece;
    }
    for (number = 0; length > 0 && number < ECATSPEC_CHIP_MANAGERS; number++) {
        controlled |= ecatspec_chip_meets(ecatspec_chip_managers[number].pdi_control, address, length);
    }
    if (controlled) {
        ecatspec_chip_arrange(chip);
    }
}

/* --- power and time ---------------------------------------------------------------------------- */

static void ecatspec_chip_power_on(struct ecatspec_chip_state *chip)
{
    int number;
    memcpy(chip->memory, chip->reset, sizeof chip->memory);
    for (number = 0; number < ECATSPEC_CHIP_MANAGERS; number++) {
        chip->managers[number].set_up = 0;
    }
    chip->events = 0;
    chip->al_control_locked = 0;
    chip->watchdog = 0;
    ecatspec_chip_watch(chip, 0);
}

static void ecatspec_chip_reset(void *device)
{
    struct ecatspec_chip_state *chip = (struct ecatspec_chip_state *)device;
    ecatspec_chip_power_on(chip);
    chip->functions->init(chip->stack);
    ecatspec_chip_poll(chip, 0);
}

/* Let time pass, with a poll at each step of it and when the watchdog expires. */
static void ecatspec_chip_advance(void *device, uint64_t microseconds)
{
    struct ecatspec_chip_state *chip = (struct ecatspec_chip_state *)device;
    while (microseconds > 0) {
        uint64_t step = chip->settings.poll;
        if (microseconds < step) {
            step = microseconds;
        }
        if (chip->watchdog > 0 && chip->watchdog < step) {
            step = chip->watchdog;
        }
        microseconds -= step;
        if (chip->watchdog > 0) {
            chip->watchdog -= step;
            if (chip->watchdog == 0) {
                ecatspec_chip_show_watchdog(chip, 0);
                chip->events |= ECATSPEC_CHIP_WATCHDOG_EVENT;
            }
        }
        ecatspec_chip_poll(chip, step);
    }
}

static int ecatspec_chip_local(void *device, const char *event)
{
    struct ecatspec_chip_state *chip = (struct ecatspec_chip_state *)device;
    int unknown = chip->functions->local(chip->stack, event);
    if (!unknown) {
        ecatspec_chip_poll(chip, 0);
    }
    return unknown;
}

static void ecatspec_chip_free(struct ecatspec_chip_state *chip)
{
    free(chip->writable);
    free(chip);
}

static void ecatspec_chip_destroy(void *device)
{
    struct ecatspec_chip_state *chip = (struct ecatspec_chip_state *)device;
    chip->functions->destroy(chip->stack);
    ecatspec_chip_free(chip);
}

static void *ecatspec_chip_create(const struct ecatspec_stack *stack,
                                  const struct ecatspec_chip_settings *settings)
{
    size_t registers = settings->writable_registers * sizeof *settings->writable;
    struct ecatspec_chip_state *chip = (struct ecatspec_chip_state *)calloc(1, sizeof *chip);
    if (chip == NULL) {
        return NULL;
    }
    chip->functions = stack;
    chip->settings = *settings;
    chip->writable = (struct ecatspec_chip_span *)malloc(registers);
    if (chip->writable != NULL) {
        memcpy(chip->writable, settings->writable, registers);
        memcpy(chip->reset, settings->reset, settings->registers_end);
        chip->hooks.context = chip;
        chip->hooks.pdi_read = ecatspec_chip_pdi_read;
        chip->hooks.pdi_write = ecatspec_chip_pdi_write;
        chip->hooks.al_event = ecatspec_chip_al_event;
        ecatspec_chip_power_on(chip);
        chip->stack = stack->create(&chip->hooks);
    }
    if (chip->stack == NULL) {
        ecatspec_chip_free(chip);
        return NULL;
    }
    return chip;
}

#if defined(_WIN32)
__declspec(dllexport)
#elif defined(__GNUC__)
__attribute__((visibility("default")))
#endif
const struct ecatspec_chip *ecatspec_chip(void);

const struct ecatspec_chip *ecatspec_chip(void)
{
    static const struct ecatspec_chip chip = {
        ECATSPEC_CHIP_ABI, ECATSPEC_CHIP_NUMBERS, ecatspec_chip_create,
        { NULL, ecatspec_chip_destroy, ecatspec_chip_reset, ecatspec_chip_main_read,
          ecatspec_chip_main_write, ecatspec_chip_advance, ecatspec_chip_local }
    };
    return &chip;
}

#ifdef __cplusplus
}
#endif

#endif
#endif
