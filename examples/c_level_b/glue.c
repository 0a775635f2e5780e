/* Between the application, the stack of ../c_slave and ecatspec: all that a port of level B needs. */
#include "application.h"
#include "slave.h"

#include <ecatspec_chip.h>

struct esc { const struct ecatspec_esc *of; };

static struct esc esc;
static struct slave slave;

/* --- the hardware layer of the stack: ecatspec_chip.h is the chip ----------------------------- */

uint32_t esc_events(struct esc *at) { return at->of->al_event(at->of->context); }
void esc_read(struct esc *at, uint16_t address, void *data, size_t length)
{ at->of->pdi_read(at->of->context, address, data, length); }
void esc_write(struct esc *at, uint16_t address, const void *data, size_t length)
{ at->of->pdi_write(at->of->context, address, data, length); }

/* --- what the stack wants of the application: objects, and here no process data --------------- */

uint32_t object_read(struct slave *of, uint16_t index, uint8_t subindex, uint8_t *data,
                     size_t *length)
{ (void)of; return read_object(index, subindex, data, length); }
uint32_t object_write(struct slave *of, uint16_t index, uint8_t subindex, const uint8_t *data,
                      size_t length)
{ (void)of; return write_object(index, subindex, data, length); }
size_t object_size(uint16_t index, uint8_t subindex)
{
    uint8_t data[LONGEST_OBJECT];
    size_t length;
    return read_object(index, subindex, data, &length) ? 0 : length;
}

const uint16_t outputs_length = 0, inputs_length = 0;
void application_outputs(struct slave *of, const uint8_t *image) { (void)of; (void)image; }
void application_inputs(struct slave *of, uint8_t *image) { (void)of; (void)image; }
void application_started(struct slave *of) { (void)of; }
void application_stopped(struct slave *of) { (void)of; }
void application_advance(struct slave *of, uint32_t microseconds) { (void)of; (void)microseconds; }

/* --- what ecatspec wants of both -------------------------------------------------------------- */

static void *create(const struct ecatspec_esc *at) { esc.of = at; return &slave; }
static void destroy(void *stack) { (void)stack; }
static void init(void *stack) { switch_on(); slave_init(stack, &esc, NULL); }
static void poll(void *stack, uint32_t microseconds) { slave_poll(stack, microseconds); }

const struct ecatspec_dut *ecatspec_dut(void)
{
    static const struct ecatspec_stack stack = { create, destroy, init, poll, NULL };
    static const struct ecatspec_dut dut = {
        .abi = ECATSPEC_DUT_ABI, .name = "thermostat", .stack = &stack
    };
    return &dut;
}
