/* The main loop. */
#include "slave.h"

#include <string.h>

void slave_init(struct slave *slave, struct esc *esc, struct application *application)
{
    memset(slave, 0, sizeof *slave);
    slave->esc = esc;
    slave->application = application;
    al_reset(slave);
    mailbox_start(slave);
}

void slave_poll(struct slave *slave, uint32_t microseconds)
{
    uint8_t image[LONGEST_IMAGE];
    uint16_t control;
    slave->events = esc_events(slave->esc);
    if (microseconds > 0) {
        application_advance(slave, microseconds);
    }
    if (esc_take_watchdog(slave)) {
        al_watchdog_expired(slave);
    }
    if (esc_take_settings(slave)) {
        al_settings_changed(slave);
        mailbox_repeat(slave);
    }
    if (esc_take_al_control(slave, &control)) {
        al_request(slave, control);
    }
    if (esc_take_outputs(slave, image) && slave->al.state >= SAFEOP) {
        slave->al.fed = 1;
        application_outputs(slave, image);
    }
    mailbox_serve(slave);
    al_inputs(slave);
}
