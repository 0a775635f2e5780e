/* AL state machine: what the MainDevice asks for, what is refused and why. */
#include "faults.h"
#include "slave.h"

enum { STATE_MASK = 0x0F, ACKNOWLEDGE = 0x10, ERROR_INDICATION = 0x10 };

enum {
    NO_ERROR = 0x0000,
    INVALID_STATE_CHANGE = 0x0011,
    UNKNOWN_STATE = 0x0012,
    NO_BOOTSTRAP = 0x0013,
    INVALID_MAILBOX = 0x0016,
    WATCHDOG_EXPIRED = 0x001B,
    INVALID_OUTPUTS = 0x001D,
    INVALID_INPUTS = 0x001E
};

static void show(struct slave *slave)
{
    const struct al *al = &slave->al;
    esc_show_al(slave, (uint16_t)(al->state | (al->error ? ERROR_INDICATION : 0)), al->code);
}

void al_reset(struct slave *slave)
{
    slave->al.state = INIT;
    slave->al.error = 0;
    slave->al.code = NO_ERROR;
    slave->al.fed = 0;
    show(slave);
}

static int fits(const struct manager *set, int mailbox, int main_writes, uint16_t start,
                uint16_t length)
{
    return set->enabled && set->mailbox == mailbox && set->main_writes == main_writes
           && set->start == start && set->length == length;
}

static int mailboxes_fit(const struct slave *slave)
{
    const struct manager *managers = slave->managers;
    return fits(&managers[MAIL_OUT], 1, 1, MAILBOX_OUT_START, MAILBOX_OUT_LENGTH)
           && fits(&managers[MAIL_IN], 1, 0, MAILBOX_IN_START, MAILBOX_IN_LENGTH);
}

int al_mailbox_works(const struct slave *slave)
{
    return slave->al.state != INIT && mailboxes_fit(slave);
}

/* The code that says what is wrong with the process data settings, NO_ERROR if they fit. */
static uint16_t process_data_error(const struct slave *slave)
{
    const struct manager *out = &slave->managers[DATA_OUT], *in = &slave->managers[DATA_IN];
    uint16_t out_length = PLANTED(PDO_LENGTH_UNCHECKED) ? out->length : outputs_length;
    uint16_t in_length = PLANTED(PDO_LENGTH_UNCHECKED) ? in->length : inputs_length;
    if (outputs_length > 0 && !fits(out, 0, 1, OUTPUTS_START, out_length)) {
        return INVALID_OUTPUTS;
    }
    return inputs_length > 0 && !fits(in, 0, 0, INPUTS_START, in_length) ? INVALID_INPUTS
                                                                        : NO_ERROR;
}

void al_inputs(struct slave *slave)
{
    uint8_t image[LONGEST_IMAGE];
    if (slave->al.state >= SAFEOP && inputs_length > 0) {
        application_inputs(slave, image);
        esc_write(slave->esc, INPUTS_START, image, inputs_length);
    }
}

/* Enter a state without error. What runs only above it stops. */
static void enter(struct slave *slave, enum al_state state)
{
    enum al_state before = slave->al.state;
    slave->al.state = state;
    slave->al.error = 0;
    slave->al.code = NO_ERROR;
    if (before == OP && state != OP) {
        application_stopped(slave);
    }
    if (before == INIT && state == PREOP) {
        mailbox_start(slave);
    }
    if (before == PREOP && state == SAFEOP) {
        slave->al.fed = 0;
        al_inputs(slave);    /* inputs are there before AL Status says so */
    }
    if (before == SAFEOP && state == OP) {
        application_started(slave);
    }
}

static void fail(struct slave *slave, uint16_t code)
{
    slave->al.error = 1;
    slave->al.code = PLANTED(AL_CODE_FORGOTTEN) ? NO_ERROR : code;
}

/* The code of a refusal, NO_ERROR if the device goes to the state. */
static uint16_t refusal(const struct slave *slave, int requested)
{
    enum al_state state = slave->al.state;
    switch (requested) {
    case INIT:
        return NO_ERROR;
    case PREOP:
        return state == INIT && !mailboxes_fit(slave) && !PLANTED(AL_MAILBOX_UNCHECKED)
               ? INVALID_MAILBOX : NO_ERROR;
    case BOOT:
        return state == INIT ? NO_BOOTSTRAP : INVALID_STATE_CHANGE;
    case SAFEOP:
        if (state == INIT) {
            return INVALID_STATE_CHANGE;
        }
        return state == PREOP ? process_data_error(slave) : NO_ERROR;
    case OP:
        if (state == INIT || state == PREOP) {
            return INVALID_STATE_CHANGE;
        }
        return state == SAFEOP && outputs_length > 0 && !slave->al.fed ? WATCHDOG_EXPIRED : NO_ERROR;
    default:
        return PLANTED(AL_UNKNOWN_STATE) ? INVALID_STATE_CHANGE : UNKNOWN_STATE;
    }
}

void al_request(struct slave *slave, uint16_t control)
{
    int requested = control & STATE_MASK;
    uint16_t code;
    /* until the error is acknowledged only INIT is obeyed */
    if (slave->al.error && !(control & ACKNOWLEDGE) && requested != INIT
        && !PLANTED(AL_ERROR_NOT_LATCHED)) {
        return;
    }
    code = refusal(slave, requested);
    if (code == NO_ERROR) {
        enter(slave, (enum al_state)requested);
    } else {
        fail(slave, code);
    }
    show(slave);
}

/* The MainDevice wrote SyncManager settings: below what they carry the device cannot stay. */
void al_settings_changed(struct slave *slave)
{
    uint16_t code = process_data_error(slave);
    if (slave->al.state != INIT && !mailboxes_fit(slave)) {
        enter(slave, INIT);
        fail(slave, INVALID_MAILBOX);
    } else if (slave->al.state >= SAFEOP && code != NO_ERROR) {
        enter(slave, PREOP);
        fail(slave, code);
    }
    show(slave);
}

void al_watchdog_expired(struct slave *slave)
{
    slave->al.fed = 0;
    if (slave->al.state == OP && !PLANTED(WATCHDOG_IGNORED)) {
        enter(slave, SAFEOP);
        fail(slave, WATCHDOG_EXPIRED);
        show(slave);
    }
}
