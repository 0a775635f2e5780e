/* The ESC: registers, SyncManagers and their buffers. In a real device a chip does this. */
#include "chip.h"

#include <string.h>

enum { BUFFERS = 3, FMMUS = 4, FMMU_SIZE = 16, FMMU_USED = 13, TICKS_OF_MICROSECOND = 25 };

static uint8_t *manager(struct esc *esc, int number)
{
    return esc->memory + REGISTER_SYNC_MANAGERS + MANAGER_SIZE * number;
}

static void raise_event(struct esc *esc, uint32_t event)
{
    uint8_t *request = esc->memory + REGISTER_AL_EVENT;
    put32(request, get32(request) | event);
}

static void clear_event(struct esc *esc, uint32_t event)
{
    uint8_t *request = esc->memory + REGISTER_AL_EVENT;
    put32(request, get32(request) & ~event);
}

static int is_full(const struct channel *channel)
{
    return channel->mailbox && channel->newest != NO_BUFFER;
}

/* Show what became of the buffers: in the status, and as the event that the device waits for. */
static void show_channel(struct esc *esc, int number)
{
    const struct channel *channel = &esc->channels[number];
    uint8_t *status = manager(esc, number) + AT_STATUS;
    uint32_t event = (uint32_t)EVENT_MANAGER_0 << number;
    *status = (uint8_t)(channel->written | channel->taken << 1);
    if (channel->mailbox) {
        *status |= (uint8_t)(is_full(channel) << 3);
    } else {
        *status |= (uint8_t)(channel->newest << 4 | (channel->reading != NO_BUFFER) << 6
                             | (channel->writing != NO_BUFFER) << 7);
    }
    if (channel->main_writes ? channel->written : channel->taken) {
        raise_event(esc, event);
    } else {
        clear_event(esc, event);
    }
}

static int watchdog_on(const struct esc *esc)
{
    const uint8_t *at = esc->memory + REGISTER_SYNC_MANAGERS + MANAGER_SIZE * DATA_OUT;
    return (at[AT_CONTROL] & WATCHDOG_TRIGGER) && get16(esc->memory + REGISTER_WATCHDOG_TIME) > 0;
}

static void show_watchdog(struct esc *esc)
{
    esc->memory[REGISTER_WATCHDOG_STATUS] = esc->watchdog_runs || !watchdog_on(esc);
}

/* Set a channel up as its registers say. One whose settings stay keeps what its buffers hold. */
static void arrange(struct esc *esc, int number)
{
    const uint8_t *at = manager(esc, number);
    struct channel *old = &esc->channels[number], new;
    uint32_t end;

    memset(&new, 0, sizeof new);
    new.newest = new.writing = new.reading = NO_BUFFER;
    new.start = get16(at);
    new.length = get16(at + 2);
    new.mailbox = (at[AT_CONTROL] & MODE_MASK) == MODE_MAILBOX;
    new.main_writes = (at[AT_CONTROL] & DIRECTION_MASK) == MAIN_WRITES;
    end = new.start + (uint32_t)new.length * (new.mailbox ? 1 : BUFFERS);
    new.off = at[AT_PDI_CONTROL] & DEACTIVATED;
    /* a SyncManager that covers registers, or more memory than there is, guards nothing */
    new.enabled = (at[AT_ACTIVATION] & ENABLED) && new.length > 0
                  && (new.mailbox || (at[AT_CONTROL] & MODE_MASK) == MODE_BUFFERED)
                  && new.start >= ESC_PROCESS_MEMORY && end <= ESC_SIZE;
    if (new.enabled != old->enabled || new.mailbox != old->mailbox || new.start != old->start
        || new.length != old->length || new.main_writes != old->main_writes || new.off != old->off) {
        *old = new;
    }
    show_channel(esc, number);
}

void chip_reset(struct esc *esc)
{
    int number;
    memset(esc, 0, sizeof *esc);
    put16(esc->memory + REGISTER_AL_CONTROL, 1);
    put16(esc->memory + REGISTER_AL_STATUS, 1);
    put16(esc->memory + REGISTER_WATCHDOG_DIVIDER, 0x09C2);
    put16(esc->memory + REGISTER_WATCHDOG_TIME, 1000);
    for (number = 0; number < SYNC_MANAGERS; number++) {
        esc->channels[number].newest = NO_BUFFER;
        esc->channels[number].writing = NO_BUFFER;
        esc->channels[number].reading = NO_BUFFER;
        show_channel(esc, number);
    }
    show_watchdog(esc);
}

/* --- pieces of an access --------------------------------------------------------------------- */

static uint32_t visible_end(const struct channel *channel)
{
    return (uint32_t)channel->start + channel->length;
}

static uint32_t hidden_end(const struct channel *channel)
{
    return channel->start + (uint32_t)channel->length * (channel->mailbox ? 1 : BUFFERS);
}

/* Whose an address is; an area counts before the hidden buffers of another. */
static struct channel *owner_of(struct esc *esc, uint32_t address)
{
    struct channel *channel, *owner = NULL;
    for (channel = esc->channels; channel < esc->channels + SYNC_MANAGERS; channel++) {
        if (channel->enabled && address >= channel->start && address < visible_end(channel)) {
            return channel;
        }
        if (channel->enabled && address >= channel->start && address < hidden_end(channel)) {
            owner = channel;
        }
    }
    return owner;
}

/* How far an access goes before the next border of an area. */
static size_t piece_length(const struct esc *esc, uint32_t address, size_t length)
{
    const struct channel *channel;
    uint32_t end = address + (uint32_t)length;
    for (channel = esc->channels; channel < esc->channels + SYNC_MANAGERS; channel++) {
        uint32_t borders[3];
        int n;
        borders[0] = channel->start;
        borders[1] = visible_end(channel);
        borders[2] = hidden_end(channel);
        for (n = 0; channel->enabled && n < 3; n++) {
            if (borders[n] > address && borders[n] < end) {
                end = borders[n];
            }
        }
    }
    return end - address;
}

static int number_of(const struct esc *esc, const struct channel *channel)
{
    return (int)(channel - esc->channels);
}

static uint8_t *buffer(struct esc *esc, const struct channel *channel, int number)
{
    return esc->memory + channel->start + (uint32_t)channel->length * (unsigned)number;
}

static uint8_t free_buffer(const struct channel *channel)
{
    uint8_t number = 0;
    while (number == channel->newest || number == channel->reading) {
        number++;
    }
    return number;
}

/* The side that reads. A buffer opens with its first byte and changes hands with its last one. */
static int take(struct esc *esc, struct channel *channel, uint32_t address, uint8_t *data,
                size_t length)
{
    uint32_t offset = address - channel->start;
    if (channel->off || address >= visible_end(channel)) {
        return 0;
    }
    if (offset == 0) {
        channel->reading = channel->newest;
        channel->written = 0;
    }
    if (channel->reading == NO_BUFFER) {
        return 0;
    }
    memcpy(data, buffer(esc, channel, channel->reading) + offset, length);
    if (offset + length == channel->length) {
        channel->reading = NO_BUFFER;
        channel->taken = 1;
        if (channel->mailbox) {
            channel->newest = NO_BUFFER;    /* one buffer: it is the writer's again */
        }
    }
    return 1;
}

/* The side that writes. */
static int put(struct esc *esc, struct channel *channel, uint32_t address, const uint8_t *data,
               size_t length)
{
    uint32_t offset = address - channel->start;
    if (channel->off || address >= visible_end(channel) || is_full(channel)
        || (offset > 0 && channel->writing == NO_BUFFER)) {
        return 0;
    }
    if (offset == 0) {
        channel->taken = 0;
    }
    if (channel->writing == NO_BUFFER) {
        channel->writing = free_buffer(channel);
    }
    memcpy(buffer(esc, channel, channel->writing) + offset, data, length);
    if (offset + length == channel->length) {
        channel->newest = channel->writing;
        channel->writing = NO_BUFFER;
        channel->written = 1;
    }
    return 1;
}

static void feed_watchdog(struct esc *esc)
{
    if (watchdog_on(esc)) {
        esc->watchdog = (get16(esc->memory + REGISTER_WATCHDOG_DIVIDER) + 2u)
                        * get16(esc->memory + REGISTER_WATCHDOG_TIME) / TICKS_OF_MICROSECOND;
        esc->watchdog_runs = 1;
    }
}

/* --- registers ------------------------------------------------------------------------------- */

static int writable(struct esc *esc, uint32_t address)
{
    if (address >= REGISTER_SYNC_MANAGERS && address < REGISTERS_END) {
        uint32_t offset = (address - REGISTER_SYNC_MANAGERS) % MANAGER_SIZE;
        return offset <= AT_CONTROL || offset == AT_ACTIVATION;
    }
    if (address >= REGISTER_FMMUS && address < REGISTER_FMMUS + FMMUS * FMMU_SIZE) {
        return (address - REGISTER_FMMUS) % FMMU_SIZE < FMMU_USED;
    }
    switch (address & ~1u) {
    case REGISTER_AL_CONTROL:
        /* not taken again before the device has read it */
        return !(get32(esc->memory + REGISTER_AL_EVENT) & EVENT_AL_CONTROL);
    case REGISTER_STATION_ADDRESS:
    case REGISTER_WATCHDOG_DIVIDER:
    case REGISTER_WATCHDOG_TIME:
        return 1;
    default:
        return address >= REGISTERS_END;
    }
}

static int write_registers(struct esc *esc, uint32_t address, const uint8_t *data, size_t length)
{
    int counter = 0, control_written = 0, settings_written = 0, number;
    size_t n;
    for (n = 0; n < length; n++, address++) {
        if (!writable(esc, address)) {
            continue;
        }
        counter = 1;
        if (address >= REGISTER_SYNC_MANAGERS && address < REGISTERS_END) {
            uint32_t offset = (address - REGISTER_SYNC_MANAGERS) % MANAGER_SIZE;
            settings_written = 1;
            /* settings can be written only while the SyncManager is disabled */
            if (offset <= AT_CONTROL && esc->memory[address - offset + AT_ACTIVATION] & ENABLED) {
                continue;
            }
        }
        control_written |= (address & ~1u) == REGISTER_AL_CONTROL;
        esc->memory[address] = data[n];
    }
    if (control_written) {
        raise_event(esc, EVENT_AL_CONTROL);
    }
    if (settings_written) {
        for (number = 0; number < SYNC_MANAGERS; number++) {
            arrange(esc, number);
        }
        raise_event(esc, EVENT_SETTINGS);
    }
    return counter;
}

/* --- the side of the MainDevice -------------------------------------------------------------- */

int chip_main_read(struct esc *esc, uint16_t address, uint8_t *data, size_t length)
{
    uint32_t at = address;
    int counter = 0;
    if (length > (size_t)ESC_SIZE - at) {
        return 0;
    }
    memset(data, 0, length);
    while (length > 0) {
        size_t part = piece_length(esc, at, length);
        struct channel *channel = owner_of(esc, at);
        if (channel == NULL) {
            memcpy(data, esc->memory + at, part);
            counter = 1;
        } else if (!channel->main_writes && take(esc, channel, at, data, part)) {
            counter = 1;
            show_channel(esc, number_of(esc, channel));
        }
        at += (uint32_t)part;
        data += part;
        length -= part;
    }
    return counter;
}

int chip_main_write(struct esc *esc, uint16_t address, const uint8_t *data, size_t length)
{
    uint32_t at = address;
    int counter = 0;
    if (length > (size_t)ESC_SIZE - at) {
        return 0;
    }
    while (length > 0) {
        size_t part = piece_length(esc, at, length);
        struct channel *channel = owner_of(esc, at);
        if (channel == NULL) {
            counter |= write_registers(esc, at, data, part);
        } else if (channel->main_writes && put(esc, channel, at, data, part)) {
            counter = 1;
            if (!channel->mailbox && channel->writing == NO_BUFFER) {
                feed_watchdog(esc);    /* the image is complete */
            }
            show_channel(esc, number_of(esc, channel));
        }
        at += (uint32_t)part;
        data += part;
        length -= part;
    }
    show_watchdog(esc);
    return counter;
}

/* --- the side of the device ------------------------------------------------------------------ */

uint32_t esc_events(struct esc *esc)
{
    return get32(esc->memory + REGISTER_AL_EVENT);
}

static int overlaps(uint32_t start, size_t size, uint32_t address, size_t length)
{
    return length > 0 && address < start + size && start < address + length;
}

/* What the device reads as an event it has seen. */
static void clear_seen(struct esc *esc, uint32_t address, size_t length)
{
    int number;
    if (overlaps(REGISTER_AL_CONTROL, 2, address, length)) {
        clear_event(esc, EVENT_AL_CONTROL);
    }
    if (overlaps(REGISTER_WATCHDOG_STATUS, 2, address, length)) {
        clear_event(esc, EVENT_WATCHDOG);
    }
    for (number = 0; number < SYNC_MANAGERS; number++) {
        if (overlaps(REGISTER_SYNC_MANAGERS + (uint32_t)(MANAGER_SIZE * number + AT_ACTIVATION), 1,
                     address, length)) {
            clear_event(esc, EVENT_SETTINGS);
        }
    }
}

void esc_read(struct esc *esc, uint16_t address, void *data, size_t length)
{
    uint32_t at = address;
    uint8_t *to = data;
    memset(data, 0, length);
    clear_seen(esc, address, length);
    while (length > 0) {
        size_t part = piece_length(esc, at, length);
        struct channel *channel = owner_of(esc, at);
        if (channel == NULL) {
            memcpy(to, esc->memory + at, part);
        } else if (channel->main_writes && take(esc, channel, at, to, part)) {
            show_channel(esc, number_of(esc, channel));
        }
        at += (uint32_t)part;
        to += part;
        length -= part;
    }
}

void esc_write(struct esc *esc, uint16_t address, const void *data, size_t length)
{
    uint32_t at = address;
    const uint8_t *from = data;
    int number;
    while (length > 0) {
        size_t part = piece_length(esc, at, length);
        struct channel *channel = owner_of(esc, at);
        if (channel == NULL) {
            memcpy(esc->memory + at, from, part);
        } else if (!channel->main_writes && put(esc, channel, at, from, part)) {
            show_channel(esc, number_of(esc, channel));
        }
        at += (uint32_t)part;
        from += part;
        length -= part;
    }
    for (number = 0; number < SYNC_MANAGERS; number++) {
        arrange(esc, number);
    }
}

/* --- time ------------------------------------------------------------------------------------ */

uint32_t chip_due(const struct esc *esc)
{
    return esc->watchdog_runs && watchdog_on(esc) ? esc->watchdog : 0;
}

void chip_advance(struct esc *esc, uint32_t microseconds)
{
    if (!watchdog_on(esc)) {
        esc->watchdog_runs = 0;
    }
    if (esc->watchdog_runs && microseconds >= esc->watchdog) {
        esc->watchdog_runs = 0;
        show_watchdog(esc);
        raise_event(esc, EVENT_WATCHDOG);
    } else if (esc->watchdog_runs) {
        esc->watchdog -= microseconds;
    }
}
