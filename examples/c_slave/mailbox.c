/* Mailbox: header, counters, repeats, error replies. */
#include "faults.h"
#include "slave.h"

#include <string.h>

enum { HEADER = 6, AT_TYPE = 5, TYPE_ERROR = 0, TYPE_COE = 3, HIGHEST_COUNTER = 7 };
enum { SMALLEST_COE = 2, ERROR_COMMAND = 1, ERROR_LENGTH = 4 };
enum { PROTOCOL_UNSUPPORTED = 2, SIZE_TOO_SHORT = 6, INVALID_SIZE = 8 };

void mailbox_start(struct slave *slave)
{
    struct mailbox *mailbox = &slave->mailbox;
    memset(mailbox, 0, sizeof *mailbox);
    mailbox->repeat_acknowledged = slave->managers[MAIL_IN].repeat;
    esc_drop_mail(slave);    /* a reply from before has lost its request */
    sdo_start(slave);
}

static void put(struct slave *slave, const uint8_t message[MAILBOX_IN_LENGTH])
{
    memcpy(slave->mailbox.present, message, MAILBOX_IN_LENGTH);
    slave->mailbox.unread = 1;
    esc_put_mail(slave, message);
}

/* The MainDevice has read a message: keep it for a repeat, send what that had pushed aside. */
static void read_by_main_device(struct slave *slave)
{
    struct mailbox *mailbox = &slave->mailbox;
    memcpy(mailbox->last, mailbox->present, MAILBOX_IN_LENGTH);
    mailbox->has_last = 1;
    if (mailbox->has_waiting) {
        mailbox->has_waiting = 0;
        put(slave, mailbox->waiting);
    }
}

/* The settings of a SyncManager were written: was it the repeat bit? */
void mailbox_repeat(struct slave *slave)
{
    struct mailbox *mailbox = &slave->mailbox;
    int bit = slave->managers[MAIL_IN].repeat;
    if (!al_mailbox_works(slave) || bit == mailbox->repeat_acknowledged) {
        return;
    }
    if (mailbox->has_last) {
        if (mailbox->unread && !mailbox->has_waiting) {
            memcpy(mailbox->waiting, mailbox->present, MAILBOX_IN_LENGTH);
            mailbox->has_waiting = 1;
        }
        esc_drop_mail(slave);
        put(slave, mailbox->last);
    }
    mailbox->repeat_acknowledged = bit;
    if (!PLANTED(REPEAT_UNACKNOWLEDGED)) {
        esc_acknowledge_repeat(slave, bit);
    }
}

/* Write the message of a reply; returns its length as coe_serve does. */
static int answer(struct slave *slave, const uint8_t *request, uint8_t *reply)
{
    struct mailbox *mailbox = &slave->mailbox;
    size_t length = get16(request);
    uint8_t counter = request[AT_TYPE] >> 4 & HIGHEST_COUNTER;
    int duplicate = counter != 0 && counter == mailbox->last_counter;
    if (length > MAILBOX_OUT_LENGTH - HEADER && !PLANTED(MAILBOX_LENGTH_UNCHECKED)) {
        mailbox->last_counter = counter;
        return -INVALID_SIZE;
    }
    if (duplicate && !PLANTED(MAILBOX_COUNTER_IGNORED)) {
        return 0;
    }
    mailbox->last_counter = counter;
    if ((request[AT_TYPE] & 0x0F) != TYPE_COE) {
        return -PROTOCOL_UNSUPPORTED;
    }
    if (length < SMALLEST_COE) {
        return -SIZE_TOO_SHORT;
    }
    return coe_serve(slave, request + HEADER, length, reply);
}

static void serve_request(struct slave *slave, const uint8_t *request)
{
    struct mailbox *mailbox = &slave->mailbox;
    uint8_t reply[MAILBOX_IN_LENGTH], type = TYPE_COE;
    int length;
    memset(reply, 0, sizeof reply);
    length = answer(slave, request, reply + HEADER);
    if (length == 0) {
        return;
    }
    if (length < 0) {
        put16(reply + HEADER, ERROR_COMMAND);
        put16(reply + HEADER + 2, (uint16_t)-length);
        length = ERROR_LENGTH;
        type = TYPE_ERROR;
    }
    mailbox->own_counter = (uint8_t)(PLANTED(MAILBOX_COUNTER_STUCK)
                                     ? 1 : mailbox->own_counter % HIGHEST_COUNTER + 1);
    put16(reply, (uint16_t)length);
    reply[AT_TYPE] = (uint8_t)(type | mailbox->own_counter << 4);
    put(slave, reply);
}

/* One message at a time: a request waits while the reply before is unread. */
void mailbox_serve(struct slave *slave)
{
    struct mailbox *mailbox = &slave->mailbox;
    uint8_t request[MAILBOX_OUT_LENGTH];
    if (!al_mailbox_works(slave)) {
        esc_free_mail(slave);
        return;
    }
    if (mailbox->unread && esc_mail_read(slave)) {
        mailbox->unread = 0;
        read_by_main_device(slave);
    }
    if (!mailbox->unread && esc_take_mail(slave, request)) {
        serve_request(slave, request);
    }
}
