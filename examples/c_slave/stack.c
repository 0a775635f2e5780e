/* Stack and application as a shared library, level B of docs/adapters.md: ecatspec_chip.h is the
 * chip. make library, then ecatspec run slave.ecs --dut lib:build/libstack.so */
#include "application.h"

#include <ecatspec_chip.h>
#include <stdlib.h>

struct esc { const struct ecatspec_esc *of; };

struct board {
    struct esc esc;
    struct slave slave;
    struct application application;
};

uint32_t esc_events(struct esc *esc) { return esc->of->al_event(esc->of->context); }

void esc_read(struct esc *esc, uint16_t address, void *data, size_t length)
{
    esc->of->pdi_read(esc->of->context, address, data, length);
}

void esc_write(struct esc *esc, uint16_t address, const void *data, size_t length)
{
    esc->of->pdi_write(esc->of->context, address, data, length);
}

static void *create(const struct ecatspec_esc *esc)
{
    struct board *board = calloc(1, sizeof *board);
    if (board != NULL) {
        board->esc.of = esc;
    }
    return board;
}

static void init(void *context)
{
    struct board *board = context;
    slave_init(&board->slave, &board->esc, &board->application);
    application_reset(&board->slave);
}

static void poll(void *context, uint32_t microseconds)
{
    slave_poll(&((struct board *)context)->slave, microseconds);
}

static int local(void *context, const char *event)
{
    return application_local(&((struct board *)context)->slave, event);
}

const struct ecatspec_dut *ecatspec_dut(void)
{
    static const struct ecatspec_stack stack = { create, free, init, poll, local };
    static const struct ecatspec_dut dut = {
        .abi = ECATSPEC_DUT_ABI,
        .name = "c_slave",
        .protocols = "al coe ds402 emergency mailbox process_data sdo sdo_information",
        .locals = "ds402.fault ds402.fault_gone ds402.stopped ds402.reaction_done",
        .stack = &stack
    };
    return &dut;
}
