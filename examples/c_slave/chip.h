/* A chip in software: the ESC below the stack, and what the MainDevice sees of it. */
#ifndef CHIP_H
#define CHIP_H

#include "slave.h"

enum { ESC_SIZE = 0x10000, ESC_PROCESS_MEMORY = 0x1000, NO_BUFFER = 3 };

/* A SyncManager as its registers set it, and what became of its buffers. A mailbox has one, which is
 * full while it is the newest; process data have three behind each other. */
struct channel {
    int enabled, mailbox, main_writes, off;
    uint16_t start, length;
    uint8_t newest, writing, reading;    /* numbers of buffers, or NO_BUFFER */
    int written, taken;                  /* events: completed by the writer, by the reader */
};

struct esc {
    uint8_t memory[ESC_SIZE];
    struct channel channels[SYNC_MANAGERS];
    uint32_t watchdog;      /* microseconds until the watchdog of the process data expires */
    int watchdog_runs;
};

void chip_reset(struct esc *esc);
int chip_main_read(struct esc *esc, uint16_t address, uint8_t *data, size_t length);
int chip_main_write(struct esc *esc, uint16_t address, const uint8_t *data, size_t length);

/* Microseconds until something comes by itself, 0: nothing does. */
uint32_t chip_due(const struct esc *esc);
void chip_advance(struct esc *esc, uint32_t microseconds);

#endif
