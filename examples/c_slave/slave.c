/* The way into the device, and its main loop. */
#include "slave.h"

#include <string.h>

static const char fault[] = "ds402.fault", fault_gone[] = "ds402.fault_gone";
static const char stopped[] = "ds402.stopped", reaction_done[] = "ds402.reaction_done";

const char *const slave_events[] = { fault, fault_gone, stopped, reaction_done, NULL };

/* Look at what happened and serve it. Firmware does this over and over; here the MainDevice can
 * act only through slave_read and slave_write, so looking after each of them is enough. */
static void serve(struct slave *slave)
{
    uint16_t control;
    if (esc_take_settings(&slave->esc)) {
        al_settings_changed(slave);
        mailbox_repeat(slave);
    }
    if (esc_take_al_control(&slave->esc, &control)) {
        al_request(slave, control);
    }
    if (esc_take_outputs(&slave->esc, slave->drive.outputs) && slave->al.state >= SAFEOP) {
        slave->al.fed = 1;
        drive_outputs(slave);
    }
    mailbox_serve(slave);
    drive_inputs(slave);
}

void slave_reset(struct slave *slave)
{
    esc_reset(&slave->esc);
    objects_reset(slave);
    al_reset(slave);
    mailbox_start(slave);
    drive_reset(slave);
}

int slave_read(struct slave *slave, uint16_t address, uint8_t *data, size_t length)
{
    int counter = esc_main_read(&slave->esc, address, data, length);
    serve(slave);
    return counter;
}

int slave_write(struct slave *slave, uint16_t address, const uint8_t *data, size_t length)
{
    int counter = esc_main_write(&slave->esc, address, data, length);
    serve(slave);
    return counter;
}

void slave_advance(struct slave *slave, uint32_t microseconds)
{
    while (microseconds > 0) {
        uint32_t step = microseconds;
        /* not beyond what comes first, so that everything happens in its order */
        if (slave->drive.timer > 0 && slave->drive.timer < step) {
            step = slave->drive.timer;
        }
        if (slave->esc.watchdog_runs && slave->esc.watchdog < step) {
            step = slave->esc.watchdog;
        }
        microseconds -= step;
        drive_advance(slave, step);
        if (esc_watchdog_expires(&slave->esc, step)) {
            al_watchdog_expired(slave);
        }
    }
    serve(slave);
}

int slave_local(struct slave *slave, const char *event)
{
    if (strcmp(event, fault) == 0) {
        drive_fault(slave);
    } else if (strcmp(event, fault_gone) == 0) {
        drive_fault_gone(slave);
    } else if (strcmp(event, stopped) == 0) {
        drive_done(slave, QUICK_STOP_ACTIVE);
    } else if (strcmp(event, reaction_done) == 0) {
        drive_done(slave, FAULT_REACTION_ACTIVE);
    } else {
        return -1;
    }
    serve(slave);
    return 0;
}
