/* CiA 402: the drive state machine, and the process data that carry its words. */
#include "faults.h"
#include "slave.h"

#include <string.h>

enum { SWITCH_ON = 0x01, ENABLE_VOLTAGE = 0x02, QUICK_STOP = 0x04, ENABLE_OPERATION = 0x08,
       FAULT_RESET = 0x80 };
enum { VOLTAGE_ENABLED = 0x0010, REMOTE = 0x0200 };
enum { SELF_TEST = 10000, STOPPING = 50000, REACTION = 20000 };    /* microseconds */

static const uint8_t patterns[] = {
    0x00,    /* NOT_READY */
    0x40,    /* SWITCH_ON_DISABLED */
    0x21,    /* READY_TO_SWITCH_ON */
    0x23,    /* SWITCHED_ON */
    0x27,    /* OPERATION_ENABLED */
    0x07,    /* QUICK_STOP_ACTIVE */
    0x0F,    /* FAULT_REACTION_ACTIVE */
    0x08     /* IN_FAULT */
};

/* Show the state. A drive that is enabled is where it shall be: this one has no mass. */
static void show(struct slave *slave)
{
    struct values *values = &slave->values;
    enum drive_state state = slave->drive.state;
    if (state == OPERATION_ENABLED) {
        memcpy(values->position, values->target_position, sizeof values->position);
    }
    put16(values->status_word, (uint16_t)(patterns[state] | VOLTAGE_ENABLED
                                          | (slave->al.state == OP ? REMOTE : 0)));
}

static void enter(struct slave *slave, enum drive_state state, uint32_t timer)
{
    slave->drive.state = state;
    slave->drive.timer = timer;
    show(slave);
}

void drive_reset(struct slave *slave)
{
    memset(&slave->drive, 0, sizeof slave->drive);
    enter(slave, NOT_READY, SELF_TEST);
}

/* Where a command of bits 0 to 3 leads from a state; the state itself where it has no effect. */
static enum drive_state commanded(enum drive_state state, int control)
{
    int disable = !(control & ENABLE_VOLTAGE), stop = !(control & QUICK_STOP);
    int on = control & SWITCH_ON, enable = control & ENABLE_OPERATION;
    switch (state) {
    case SWITCH_ON_DISABLED:
        return disable || stop || on ? state : READY_TO_SWITCH_ON;
    case READY_TO_SWITCH_ON:
        return disable || stop ? SWITCH_ON_DISABLED : on ? SWITCHED_ON : state;
    case SWITCHED_ON:
        return disable || stop ? SWITCH_ON_DISABLED
               : !on ? READY_TO_SWITCH_ON : enable ? OPERATION_ENABLED : state;
    case OPERATION_ENABLED:
        return disable ? SWITCH_ON_DISABLED
               : stop ? (PLANTED(QUICK_STOP_IGNORED) ? state : QUICK_STOP_ACTIVE)
               : !on ? READY_TO_SWITCH_ON : enable ? state : SWITCHED_ON;
    case QUICK_STOP_ACTIVE:
        return disable ? SWITCH_ON_DISABLED : state;
    default:
        return state;
    }
}

/* Look at the control word: commands count by their level, fault reset by its rising edge. */
static void look(struct slave *slave, int reset)
{
    struct drive *drive = &slave->drive;
    int control = get16(slave->values.control_word);
    if (PLANTED(RESET_BY_LEVEL)) {
        reset = control & FAULT_RESET;
    }
    if (drive->state == IN_FAULT) {
        if (reset && !drive->cause) {
            enter(slave, SWITCH_ON_DISABLED, 0);
        }
    } else if (!(control & FAULT_RESET)) {
        enum drive_state next = commanded(drive->state, control);
        if (next != drive->state) {
            enter(slave, next, next == QUICK_STOP_ACTIVE ? STOPPING : 0);
        }
    }
    show(slave);
}

/* --- process data ---------------------------------------------------------------------------- */

void drive_outputs(struct slave *slave)
{
    struct values *values = &slave->values;
    const uint8_t *image = slave->drive.outputs;
    int before = get16(values->control_word);
    if (slave->al.state != OP && !PLANTED(OUTPUTS_IN_SAFEOP)) {
        return;
    }
    memcpy(values->control_word, image, sizeof values->control_word);
    memcpy(values->target_position, image + 2, sizeof values->target_position);
    look(slave, get16(values->control_word) & ~before & FAULT_RESET);
}

void drive_inputs(struct slave *slave)
{
    const struct values *values = &slave->values;
    uint8_t image[INPUTS_LENGTH];
    if (slave->al.state < SAFEOP) {
        return;
    }
    show(slave);
    memcpy(image, values->status_word, 2);
    memcpy(image + 2, values->position, 4);
    memcpy(image + 6, values->mode_shown, 1);
    esc_put_inputs(&slave->esc, image);
}

/* --- what comes by itself -------------------------------------------------------------------- */

/* The self-test, a quick stop or the reaction to a fault is done, if the drive is at that. */
void drive_done(struct slave *slave, enum drive_state state)
{
    if (slave->drive.state == state) {
        enter(slave, state == FAULT_REACTION_ACTIVE ? IN_FAULT : SWITCH_ON_DISABLED, 0);
    }
}

void drive_advance(struct slave *slave, uint32_t microseconds)
{
    struct drive *drive = &slave->drive;
    if (drive->timer > microseconds) {
        drive->timer -= microseconds;
    } else if (drive->timer > 0) {
        drive_done(slave, drive->state);
    }
    if (slave->al.state == OP) {
        look(slave, 0);
    }
}

/* OP ended. */
void drive_disconnected(struct slave *slave)
{
    enum drive_state state = slave->drive.state;
    if (state >= READY_TO_SWITCH_ON && state <= QUICK_STOP_ACTIVE) {
        enter(slave, SWITCH_ON_DISABLED, 0);
    }
}

void drive_fault(struct slave *slave)
{
    slave->drive.cause = 1;
    if (slave->drive.state < FAULT_REACTION_ACTIVE) {
        enter(slave, FAULT_REACTION_ACTIVE, REACTION);
    }
}

void drive_fault_gone(struct slave *slave)
{
    slave->drive.cause = 0;
}
