/* CiA 402: the drive state machine, and the process data that carry its words. */
#include "application.h"
#include "faults.h"

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
    struct values *values = &slave->application->values;
    enum drive_state state = slave->application->drive.state;
    if (state == OPERATION_ENABLED) {
        memcpy(values->position, values->target_position, sizeof values->position);
    }
    put16(values->status_word, (uint16_t)(patterns[state] | VOLTAGE_ENABLED
                                          | (slave->al.state == OP ? REMOTE : 0)));
}

static void enter(struct slave *slave, enum drive_state state, uint32_t timer)
{
    slave->application->drive.state = state;
    slave->application->drive.timer = timer;
    show(slave);
}

void application_reset(struct slave *slave)
{
    objects_reset(&slave->application->values);
    memset(&slave->application->drive, 0, sizeof slave->application->drive);
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
    struct drive *drive = &slave->application->drive;
    int control = get16(slave->application->values.control_word);
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

const uint16_t outputs_length = OUTPUTS_LENGTH, inputs_length = INPUTS_LENGTH;

void application_started(struct slave *slave)
{
    struct values *values = &slave->application->values;
    const uint8_t *image = slave->application->drive.outputs;
    int before = get16(values->control_word);
    if (slave->al.state != OP && !PLANTED(OUTPUTS_IN_SAFEOP)) {
        return;
    }
    memcpy(values->control_word, image, sizeof values->control_word);
    memcpy(values->target_position, image + 2, sizeof values->target_position);
    look(slave, get16(values->control_word) & ~before & FAULT_RESET);
}

void application_outputs(struct slave *slave, const uint8_t *image)
{
    memcpy(slave->application->drive.outputs, image, OUTPUTS_LENGTH);
    application_started(slave);
}

void application_inputs(struct slave *slave, uint8_t *image)
{
    const struct values *values = &slave->application->values;
    show(slave);
    memcpy(image, values->status_word, 2);
    memcpy(image + 2, values->position, 4);
    memcpy(image + 6, values->mode_shown, 1);
}

/* --- what comes by itself -------------------------------------------------------------------- */

/* The self-test, a quick stop or the reaction to a fault is done, if the drive is at that. */
static void done(struct slave *slave, enum drive_state state)
{
    if (slave->application->drive.state == state) {
        enter(slave, state == FAULT_REACTION_ACTIVE ? IN_FAULT : SWITCH_ON_DISABLED, 0);
    }
}

void application_advance(struct slave *slave, uint32_t microseconds)
{
    struct drive *drive = &slave->application->drive;
    if (drive->timer > microseconds) {
        drive->timer -= microseconds;
    } else if (drive->timer > 0) {
        done(slave, drive->state);
    }
    if (slave->al.state == OP) {
        look(slave, 0);
    }
}

void application_stopped(struct slave *slave)
{
    enum drive_state state = slave->application->drive.state;
    if (state >= READY_TO_SWITCH_ON && state <= QUICK_STOP_ACTIVE) {
        enter(slave, SWITCH_ON_DISABLED, 0);
    }
}

static const char fault[] = "ds402.fault", fault_gone[] = "ds402.fault_gone";
static const char stopped[] = "ds402.stopped", reaction_done[] = "ds402.reaction_done";

const char *const application_events[] = { fault, fault_gone, stopped, reaction_done, NULL };

int application_local(struct slave *slave, const char *event)
{
    struct drive *drive = &slave->application->drive;
    if (strcmp(event, fault) == 0) {
        drive->cause = 1;
        if (drive->state < FAULT_REACTION_ACTIVE) {
            enter(slave, FAULT_REACTION_ACTIVE, REACTION);
        }
    } else if (strcmp(event, fault_gone) == 0) {
        drive->cause = 0;
    } else if (strcmp(event, stopped) == 0) {
        done(slave, QUICK_STOP_ACTIVE);
    } else if (strcmp(event, reaction_done) == 0) {
        done(slave, FAULT_REACTION_ACTIVE);
    } else {
        return -1;
    }
    return 0;
}
