/* The ESC: registers, SyncManagers and their buffers. In a real device a chip does this. */
#include "slave.h"

#include <string.h>

enum {
    EVENT_AL_CONTROL = 1u << 0,
    EVENT_SETTINGS   = 1u << 4,
    EVENT_MANAGER_0  = 1u << 8
};
enum { AT_CONTROL = 4, AT_STATUS = 5, AT_ACTIVATION = 6, AT_PDI_CONTROL = 7, MANAGER_SIZE = 8 };
enum { MODE_MASK = 0x03, MODE_BUFFERED = 0x00, MODE_MAILBOX = 0x02, DIRECTION_MASK = 0x0C,
       MAIN_WRITES = 0x04, WATCHDOG_TRIGGER = 0x40 };
enum { ENABLED = 0x01, REPEAT = 0x02 };
enum { BUFFERS = 3, FMMUS = 4, FMMU_SIZE = 16, FMMU_USED = 13, TICKS_OF_MICROSECOND = 25 };

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

static uint8_t *manager(struct esc *esc, int number)
{
    return esc->memory + REGISTER_SYNC_MANAGERS + MANAGER_SIZE * number;
}

static void raise_event(struct esc *esc, uint32_t event)
{
    uint8_t *request = esc->memory + REGISTER_AL_EVENT;
    put32(request, get32(request) | event);
}

/* Whether something happened since the device looked; looking clears it. */
static int take_event(struct esc *esc, uint32_t event)
{
    uint8_t *request = esc->memory + REGISTER_AL_EVENT;
    uint32_t events = get32(request);
    put32(request, events & ~event);
    return (events & event) != 0;
}

static void show_channel(struct esc *esc, int number)
{
    const struct channel *channel = &esc->channels[number];
    uint8_t *status = manager(esc, number) + AT_STATUS;
    if (channel->mailbox) {
        *status = (uint8_t)(channel->full << 3);
    } else {
        *status = (uint8_t)(channel->written | channel->taken << 1 | channel->newest << 4
                            | (channel->reading != NO_BUFFER) << 6
                            | (channel->writing != NO_BUFFER) << 7);
    }
}

static void show_watchdog(struct esc *esc)
{
    esc->memory[REGISTER_WATCHDOG_STATUS] = esc->watchdog_runs || !esc_watchdog_on(esc);
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
    /* a SyncManager that covers registers, or more memory than there is, guards nothing */
    new.enabled = (at[AT_ACTIVATION] & ENABLED) && new.length > 0
                  && (new.mailbox || (at[AT_CONTROL] & MODE_MASK) == MODE_BUFFERED)
                  && new.start >= ESC_PROCESS_MEMORY && end <= ESC_SIZE;
    if (new.enabled != old->enabled || new.mailbox != old->mailbox || new.start != old->start
        || new.length != old->length || new.main_writes != old->main_writes) {
        *old = new;
        take_event(esc, (uint32_t)EVENT_MANAGER_0 << number);
    }
    show_channel(esc, number);
}

void esc_reset(struct esc *esc)
{
    int number;
    memset(esc, 0, sizeof *esc);
    put16(esc->memory + REGISTER_AL_CONTROL, INIT);
    put16(esc->memory + REGISTER_AL_STATUS, INIT);
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

static int read_mail(struct esc *esc, struct channel *channel, uint32_t address, uint8_t *data,
                     size_t length)
{
    if (channel->main_writes || !channel->full) {
        return 0;
    }
    memcpy(data, esc->memory + address, length);
    if (address + length == visible_end(channel)) {
        channel->full = 0;
        esc->fetched = 1;
        raise_event(esc, (uint32_t)EVENT_MANAGER_0 << number_of(esc, channel));
    }
    return 1;
}

/* A buffer opens with its first byte and changes hands with its last one. */
static int read_inputs(struct esc *esc, struct channel *channel, uint32_t address, uint8_t *data,
                       size_t length)
{
    uint32_t offset = address - channel->start;
    if (channel->main_writes || address >= visible_end(channel)) {
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
        raise_event(esc, (uint32_t)EVENT_MANAGER_0 << number_of(esc, channel));
    }
    return 1;
}

static int write_mail(struct esc *esc, struct channel *channel, uint32_t address,
                      const uint8_t *data, size_t length)
{
    if (!channel->main_writes || channel->full) {
        return 0;
    }
    memcpy(esc->memory + address, data, length);
    if (address + length == visible_end(channel)) {
        channel->full = 1;
        raise_event(esc, (uint32_t)EVENT_MANAGER_0 << number_of(esc, channel));
    }
    return 1;
}

static int write_outputs(struct esc *esc, struct channel *channel, uint32_t address,
                         const uint8_t *data, size_t length)
{
    uint32_t offset = address - channel->start;
    if (!channel->main_writes || address >= visible_end(channel)
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
        raise_event(esc, (uint32_t)EVENT_MANAGER_0 << number_of(esc, channel));
        if (esc_watchdog_on(esc)) {
            esc->watchdog = (get16(esc->memory + REGISTER_WATCHDOG_DIVIDER) + 2u)
                            * get16(esc->memory + REGISTER_WATCHDOG_TIME) / TICKS_OF_MICROSECOND;
            esc->watchdog_runs = 1;
        }
    }
    return 1;
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

int esc_main_read(struct esc *esc, uint16_t address, uint8_t *data, size_t length)
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
        } else {
            counter |= channel->mailbox ? read_mail(esc, channel, at, data, part)
                                        : read_inputs(esc, channel, at, data, part);
            show_channel(esc, number_of(esc, channel));
        }
        at += (uint32_t)part;
        data += part;
        length -= part;
    }
    return counter;
}

int esc_main_write(struct esc *esc, uint16_t address, const uint8_t *data, size_t length)
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
        } else {
            counter |= channel->mailbox ? write_mail(esc, channel, at, data, part)
                                        : write_outputs(esc, channel, at, data, part);
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

int esc_take_al_control(struct esc *esc, uint16_t *control)
{
    *control = get16(esc->memory + REGISTER_AL_CONTROL);
    return take_event(esc, EVENT_AL_CONTROL);
}

int esc_take_settings(struct esc *esc)
{
    return take_event(esc, EVENT_SETTINGS);
}

int esc_take_fetched(struct esc *esc)
{
    int fetched = esc->fetched;
    esc->fetched = 0;
    take_event(esc, (uint32_t)EVENT_MANAGER_0 << MAIL_IN);
    return fetched;
}

int esc_take_outputs(struct esc *esc, uint8_t image[OUTPUTS_LENGTH])
{
    struct channel *channel = &esc->channels[DATA_OUT];
    if (!take_event(esc, (uint32_t)EVENT_MANAGER_0 << DATA_OUT) || channel->newest == NO_BUFFER
        || channel->length != OUTPUTS_LENGTH) {
        return 0;
    }
    memcpy(image, buffer(esc, channel, channel->newest), OUTPUTS_LENGTH);
    channel->written = 0;
    channel->taken = 1;
    show_channel(esc, DATA_OUT);
    return 1;
}

void esc_put_inputs(struct esc *esc, const uint8_t image[INPUTS_LENGTH])
{
    struct channel *channel = &esc->channels[DATA_IN];
    uint8_t number = free_buffer(channel);
    if (!channel->enabled || channel->main_writes || channel->length != INPUTS_LENGTH) {
        return;
    }
    memcpy(buffer(esc, channel, number), image, INPUTS_LENGTH);
    channel->newest = number;
    channel->written = 1;
    channel->taken = 0;
    take_event(esc, (uint32_t)EVENT_MANAGER_0 << DATA_IN);
    show_channel(esc, DATA_IN);
}

void esc_free_mail(struct esc *esc)
{
    esc->channels[MAIL_OUT].full = 0;
    take_event(esc, (uint32_t)EVENT_MANAGER_0 << MAIL_OUT);
    show_channel(esc, MAIL_OUT);
}

void esc_put_mail(struct esc *esc, const uint8_t message[MAILBOX_IN_LENGTH])
{
    memcpy(esc->memory + MAILBOX_IN_START, message, MAILBOX_IN_LENGTH);
    esc->channels[MAIL_IN].full = 1;
    show_channel(esc, MAIL_IN);
}

void esc_drop_mail(struct esc *esc)
{
    esc->channels[MAIL_IN].full = 0;
    esc->fetched = 0;
    show_channel(esc, MAIL_IN);
}

int esc_repeat_bit(const struct esc *esc)
{
    const uint8_t *at = esc->memory + REGISTER_SYNC_MANAGERS + MANAGER_SIZE * MAIL_IN;
    return (at[AT_ACTIVATION] & REPEAT) != 0;
}

void esc_acknowledge_repeat(struct esc *esc, int bit)
{
    uint8_t *control = manager(esc, MAIL_IN) + AT_PDI_CONTROL;
    *control = (uint8_t)((*control & ~REPEAT) | (bit ? REPEAT : 0));
}

int esc_watchdog_on(const struct esc *esc)
{
    const uint8_t *at = esc->memory + REGISTER_SYNC_MANAGERS + MANAGER_SIZE * DATA_OUT;
    return (at[AT_CONTROL] & WATCHDOG_TRIGGER) && get16(esc->memory + REGISTER_WATCHDOG_TIME) > 0;
}

int esc_watchdog_expires(struct esc *esc, uint32_t microseconds)
{
    if (!esc_watchdog_on(esc)) {
        esc->watchdog_runs = 0;
    }
    if (!esc->watchdog_runs || microseconds < esc->watchdog) {
        esc->watchdog -= esc->watchdog_runs ? microseconds : 0;
        return 0;
    }
    esc->watchdog_runs = 0;
    show_watchdog(esc);
    return 1;
}
