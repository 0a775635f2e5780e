/* ecatspec_dut.h: a device under test as a shared library, for `ecatspec run ... --dut lib:./libdut.so`.
 *
 * The library exports one function, ecatspec_dut(), that gives a table. The table names the device and
 * has one of two parts:
 *
 *   device   level A: a whole SubDevice, with registers and mailboxes as a MainDevice sees them
 *   stack    level B: a stack or firmware above an ESC; ecatspec supplies the ESC, in C where the
 *            library includes ecatspec_chip.h
 *
 * The library runs in a process of its own, on one thread: a crash, a hang and a report of a sanitizer
 * are verdicts, and the run goes on. stdout and stderr are shown when the device dies.
 *
 * Time is virtual: it passes only through `advance` and `poll`, as fast as the library can count.
 *
 *   cc -shared -fPIC -I "$(ecatspec adapters --include)" -o libdut.so my_device.c
 */
#ifndef ECATSPEC_DUT_H
#define ECATSPEC_DUT_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The version of this file. It changes when a table changes; a library that was built with another is
 * refused when it is loaded. */
#define ECATSPEC_DUT_ABI 1

/* Level A. `device` is what `create` gave; there may be several. `local` may be null, all others not. */
struct ecatspec_device {
    void *(*create)(void);    /* null: it cannot be done */
    void (*destroy)(void *device);

    /* Power cycle: all volatile state is gone. Also called once after `create`. */
    void (*reset)(void *device);

    /* An access of the MainDevice. Returns the working counter: 0 where the access is refused, and
     * then `data` counts for nothing. address + length is at most 0x10000. */
    int (*read)(void *device, uint16_t address, uint8_t *data, size_t length);
    int (*write)(void *device, uint16_t address, const uint8_t *data, size_t length);

    /* Let so much time of the device pass. */
    void (*advance)(void *device, uint64_t microseconds);

    /* Raise a local event of `locals` in the device. Returns 0; anything else: it does not know it. */
    int (*local)(void *device, const char *event);
};

/* What a stack is given: the ESC as the processor of a device sees it. Reading and writing has the
 * effects that it has in a chip: reading AL Control frees it for the MainDevice, reading the activation
 * of a SyncManager clears the event of changed settings, the first byte of a mailbox clears its event,
 * the last byte hands it over. What a chip refuses (a write to a full mailbox, the wrong direction) has
 * no effect; a read gives zeros then. An access of no bytes does nothing. An access beyond the memory of
 * the ESC counts as a crash of the stack. */
struct ecatspec_esc {
    void *context;
    void (*pdi_read)(void *context, uint16_t address, void *data, size_t length);
    void (*pdi_write)(void *context, uint16_t address, const void *data, size_t length);
    uint32_t (*al_event)(void *context);    /* the register AL Event Request */
};

/* Level B. `stack` is what `create` gave. `local` may be null, all others not. */
struct ecatspec_stack {
    /* `esc` stays valid until `destroy`. Null: it cannot be done. */
    void *(*create)(const struct ecatspec_esc *esc);
    void (*destroy)(void *stack);

    /* Power on: the ESC is as after its reset. Also called once after `create`. */
    void (*init)(void *stack);

    /* One round of the main loop; `us` microseconds have passed since the last one. It is called
     * after what the MainDevice does, then with 0, and every millisecond while time passes. */
    void (*poll)(void *stack, uint32_t microseconds);

    /* As in struct ecatspec_device. */
    int (*local)(void *stack, const char *event);
};

/* Lists are words with spaces between them. All but `abi`, `name` and one of `device` and `stack` may be
 * left zero. What the fields mean, and what `limits` and `without` may say: docs/adapters.md. */
struct ecatspec_dut {
    uint32_t abi;                 /* ECATSPEC_DUT_ABI */
    const char *name;             /* for the report: my stack 1.2 */
    const char *protocols;        /* layers that are the device's own: "al mailbox sdo"; null: all of
                                     the text */
    const char *locals;           /* events that `local` takes: "ds402.fault ds402.fault_gone" */
    const char *limits;           /* "segment_data=7" */
    const char *without;          /* "complete_access malformed" */
    const char *notes;            /* for the report, one note a line */
    int open_dictionary;          /* not 0: there are objects that the text does not list */
    const struct ecatspec_device *device;
    const struct ecatspec_stack *stack;
};

#if defined(_WIN32)
__declspec(dllexport)
#elif defined(__GNUC__)
__attribute__((visibility("default")))
#endif
const struct ecatspec_dut *ecatspec_dut(void);

#ifdef __cplusplus
}
#endif

#endif
