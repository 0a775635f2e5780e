/* The stack of a small EtherCAT SubDevice: what runs on the processor of a device, without hardware.
 *
 * All state is in one struct, time comes from outside, and nothing is allocated. Each file looks
 * after one part of it:
 *
 *   slave.c    the main loop
 *   al.c       AL state machine, AL status codes, watchdog of the process data
 *   mailbox.c  mailbox header, counters, repeats, error replies
 *   sdo.c      CoE: SDO expedited, normal and segmented
 *   esc.c      what the stack wants of the ESC, through the three functions of the hardware layer
 *
 * Below it is the hardware layer, above it the application: both belong to a device. Here they are
 * chip.c, and objects.c with drive.c; examples/c_level_b has others.
 */
#ifndef SLAVE_H
#define SLAVE_H

#include <stddef.h>
#include <stdint.h>

/* --- layout of the device, as slave.ecs has it ----------------------------------------------- */

enum {
    MAILBOX_OUT_START = 0x1000, MAILBOX_OUT_LENGTH = 48,
    MAILBOX_IN_START  = 0x1080, MAILBOX_IN_LENGTH  = 48,
    OUTPUTS_START     = 0x1100,
    INPUTS_START      = 0x1400,
    LONGEST_IMAGE     = 64,
    LONGEST_OBJECT    = 120
};

/* --- the hardware layer: the ESC as a processor sees it --------------------------------------- */

struct esc;

uint32_t esc_events(struct esc *esc);    /* the register AL Event Request */
void esc_read(struct esc *esc, uint16_t address, void *data, size_t length);
void esc_write(struct esc *esc, uint16_t address, const void *data, size_t length);

/* --- registers ------------------------------------------------------------------------------- */

enum {
    REGISTER_STATION_ADDRESS  = 0x0010,
    REGISTER_AL_CONTROL       = 0x0120,
    REGISTER_AL_STATUS        = 0x0130,
    REGISTER_AL_STATUS_CODE   = 0x0134,
    REGISTER_AL_EVENT         = 0x0220,
    REGISTER_WATCHDOG_DIVIDER = 0x0400,
    REGISTER_WATCHDOG_TIME    = 0x0420,
    REGISTER_WATCHDOG_STATUS  = 0x0440,
    REGISTER_FMMUS            = 0x0600,
    REGISTER_SYNC_MANAGERS    = 0x0800,
    REGISTERS_END             = 0x0820
};

/* Of one SyncManager. */
enum { AT_CONTROL = 4, AT_STATUS = 5, AT_ACTIVATION = 6, AT_PDI_CONTROL = 7, MANAGER_SIZE = 8 };
enum { MODE_MASK = 0x03, MODE_BUFFERED = 0x00, MODE_MAILBOX = 0x02, DIRECTION_MASK = 0x0C,
       MAIN_WRITES = 0x04, WATCHDOG_TRIGGER = 0x40 };
enum { ENABLED = 0x01, REPEAT = 0x02, FULL = 0x08 };                   /* activation, status */
enum { DEACTIVATED = 0x01, REPEAT_ACKNOWLEDGED = 0x02 };               /* PDI control */

/* --- esc.c ----------------------------------------------------------------------------------- */

enum {
    EVENT_AL_CONTROL = 1u << 0,
    EVENT_SETTINGS   = 1u << 4,
    EVENT_WATCHDOG   = 1u << 6,
    EVENT_MANAGER_0  = 1u << 8
};

enum { SYNC_MANAGERS = 4 };
enum sync_manager { MAIL_OUT, MAIL_IN, DATA_OUT, DATA_IN };

/* A SyncManager as its registers set it. */
struct manager {
    uint16_t start, length;
    int enabled, mailbox, main_writes, repeat;
};

struct slave;

/* Reading an event takes it. A message is dropped by switching the SyncManager off and on. */
int esc_take_settings(struct slave *slave);
int esc_take_al_control(struct slave *slave, uint16_t *control);
int esc_take_watchdog(struct slave *slave);
int esc_take_outputs(struct slave *slave, uint8_t *image);
int esc_take_mail(struct slave *slave, uint8_t message[MAILBOX_OUT_LENGTH]);
void esc_free_mail(struct slave *slave);    /* without looking at it */
int esc_mail_read(struct slave *slave);     /* whether what was put is no longer there */
void esc_put_mail(struct slave *slave, const uint8_t message[MAILBOX_IN_LENGTH]);
void esc_drop_mail(struct slave *slave);
void esc_acknowledge_repeat(struct slave *slave, int bit);
void esc_show_al(struct slave *slave, uint16_t status, uint16_t code);

uint16_t get16(const uint8_t *bytes);
uint32_t get32(const uint8_t *bytes);
void put16(uint8_t *bytes, uint16_t value);
void put32(uint8_t *bytes, uint32_t value);

/* --- al.c ------------------------------------------------------------------------------------ */

enum al_state { INIT = 1, PREOP = 2, BOOT = 3, SAFEOP = 4, OP = 8 };

struct al {
    enum al_state state;
    int error;
    uint16_t code;
    int fed;    /* outputs came since SAFEOP was entered, and the watchdog has not expired */
};

/* --- mailbox.c ------------------------------------------------------------------------------- */

struct mailbox {
    uint8_t last_counter;                /* of the last request; 0 is never a duplicate */
    uint8_t own_counter;                 /* of the last reply, 1 to 7 */
    int repeat_acknowledged;             /* the repeat bit as it was answered last */
    int unread;                          /* a message of ours lies in the mailbox */
    int has_last, has_waiting;
    uint8_t present[MAILBOX_IN_LENGTH];  /* what lies in the mailbox */
    uint8_t last[MAILBOX_IN_LENGTH];     /* what was read last: a repeat sends it again */
    uint8_t waiting[MAILBOX_IN_LENGTH];  /* what a repeated message pushed aside */
};

/* --- sdo.c ----------------------------------------------------------------------------------- */

enum transfer { NO_TRANSFER, DOWNLOAD, UPLOAD };

struct sdo {
    enum transfer transfer;
    uint16_t index;
    uint8_t subindex;
    uint8_t toggle;              /* of the next segment */
    size_t size, done;           /* bytes announced, bytes that have travelled */
    uint8_t data[LONGEST_OBJECT];
};

/* --- slave.c --------------------------------------------------------------------------------- */

struct slave {
    struct esc *esc;                    /* of the hardware layer */
    struct application *application;    /* of the application */
    uint32_t events;                    /* when this round of the main loop began */
    struct manager managers[SYNC_MANAGERS];
    struct al al;
    struct mailbox mailbox;
    struct sdo sdo;
};

/* Power on: the ESC is as after its reset. */
void slave_init(struct slave *slave, struct esc *esc, struct application *application);

/* One round of the main loop; so much time has passed since the last one. */
void slave_poll(struct slave *slave, uint32_t microseconds);

/* --- what the layers give each other --------------------------------------------------------- */

void al_reset(struct slave *slave);
void al_request(struct slave *slave, uint16_t control);
void al_settings_changed(struct slave *slave);
void al_inputs(struct slave *slave);
void al_watchdog_expired(struct slave *slave);
int al_mailbox_works(const struct slave *slave);

void mailbox_start(struct slave *slave);
void mailbox_serve(struct slave *slave);
void mailbox_repeat(struct slave *slave);

/* Takes the CoE message of a request; writes that of the reply. Returns its length: 0 for silence,
 * or minus a detail of mailbox errors. */
int coe_serve(struct slave *slave, const uint8_t *request, size_t length, uint8_t *reply);
void sdo_start(struct slave *slave);

/* --- the application ------------------------------------------------------------------------- */

/* SDO abort codes. */
enum {
    ABORT_NONE                   = 0,
    ABORT_TOGGLE                 = 0x05030000,
    ABORT_COMMAND                = 0x05040001,
    ABORT_UNSUPPORTED_ACCESS     = 0x06010000,
    ABORT_WRITE_ONLY             = 0x06010001,
    ABORT_READ_ONLY              = 0x06010002,
    ABORT_MAPPED                 = 0x06010006,
    ABORT_NO_OBJECT              = 0x06020000,
    ABORT_LENGTH                 = 0x06070010,
    ABORT_TOO_LONG               = 0x06070012,
    ABORT_TOO_SHORT              = 0x06070013,
    ABORT_NO_SUBINDEX            = 0x06090011,
    ABORT_RANGE                  = 0x06090030,
    ABORT_TOO_HIGH               = 0x06090031,
    ABORT_TOO_LOW                = 0x06090032,
    ABORT_GENERAL                = 0x08000000,
    ABORT_STATE                  = 0x08000022
};

/* Objects: read and write return an abort code. Without data, `write` tells whether it would take so
 * many bytes. The size of an object that is not there is 0. */
uint32_t object_read(struct slave *slave, uint16_t index, uint8_t subindex, uint8_t *data,
                     size_t *length);
uint32_t object_write(struct slave *slave, uint16_t index, uint8_t subindex, const uint8_t *data,
                      size_t length);
size_t object_size(uint16_t index, uint8_t subindex);

/* Process data: their lengths, at most LONGEST_IMAGE, and what becomes of them. */
extern const uint16_t outputs_length, inputs_length;
void application_outputs(struct slave *slave, const uint8_t *image);    /* in SAFEOP and OP */
void application_inputs(struct slave *slave, uint8_t *image);
void application_started(struct slave *slave);                          /* OP begins */
void application_stopped(struct slave *slave);                          /* OP ended */
void application_advance(struct slave *slave, uint32_t microseconds);

#endif
