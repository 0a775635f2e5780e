/* A small EtherCAT SubDevice: everything that a MainDevice sees of a drive, without hardware.
 *
 * All state is in one struct, time comes from outside, and nothing is allocated. Each file looks
 * after one part of it:
 *
 *   slave.c    the way in: what a MainDevice reads and writes, time, local events; the main loop
 *   al.c       AL state machine, AL status codes, watchdog of the process data
 *   mailbox.c  mailbox header, counters, repeats, error replies
 *   sdo.c      CoE: SDO expedited, normal and segmented
 *   objects.c  object dictionary
 *   drive.c    CiA 402 and the process data
 *   esc.c      registers, SyncManagers, buffers: what a chip does in a real device
 */
#ifndef SLAVE_H
#define SLAVE_H

#include <stddef.h>
#include <stdint.h>

/* --- layout of the device, as slave.ecs has it ----------------------------------------------- */

enum {
    MAILBOX_OUT_START = 0x1000, MAILBOX_OUT_LENGTH = 48,
    MAILBOX_IN_START  = 0x1080, MAILBOX_IN_LENGTH  = 48,
    OUTPUTS_START     = 0x1100, OUTPUTS_LENGTH     = 6,
    INPUTS_START      = 0x1400, INPUTS_LENGTH      = 7,
    NOTE_LENGTH       = 120
};

/* --- esc.c ----------------------------------------------------------------------------------- */

enum { ESC_SIZE = 0x10000, ESC_PROCESS_MEMORY = 0x1000, SYNC_MANAGERS = 4, NO_BUFFER = 3 };

enum sync_manager { MAIL_OUT, MAIL_IN, DATA_OUT, DATA_IN };

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

/* A SyncManager as its registers set it, and what became of its buffers. A mailbox has one, in
 * which `full` says whose it is; process data have three behind each other. */
struct channel {
    int enabled, mailbox, main_writes;
    uint16_t start, length;
    int full;                            /* mailbox: a message waits for the reader */
    uint8_t newest, writing, reading;    /* process data: numbers of buffers, or NO_BUFFER */
    int written, taken;                  /* process data: completed by the writer, by the reader */
};

struct esc {
    uint8_t memory[ESC_SIZE];
    struct channel channels[SYNC_MANAGERS];
    int fetched;            /* the MainDevice has emptied the mailbox since the device looked */
    uint32_t watchdog;      /* microseconds until the watchdog of the process data expires */
    int watchdog_runs;
};

void esc_reset(struct esc *esc);
int esc_main_read(struct esc *esc, uint16_t address, uint8_t *data, size_t length);
int esc_main_write(struct esc *esc, uint16_t address, const uint8_t *data, size_t length);

/* The side of the device. Reading an event takes it; a message is read in place and then freed.
 * A real device drops a message by switching the SyncManager off and on. */
int esc_take_al_control(struct esc *esc, uint16_t *control);
int esc_take_settings(struct esc *esc);
int esc_take_fetched(struct esc *esc);
int esc_take_outputs(struct esc *esc, uint8_t image[OUTPUTS_LENGTH]);
void esc_put_inputs(struct esc *esc, const uint8_t image[INPUTS_LENGTH]);
void esc_free_mail(struct esc *esc);
void esc_put_mail(struct esc *esc, const uint8_t message[MAILBOX_IN_LENGTH]);
void esc_drop_mail(struct esc *esc);
int esc_repeat_bit(const struct esc *esc);
void esc_acknowledge_repeat(struct esc *esc, int bit);
int esc_watchdog_on(const struct esc *esc);
int esc_watchdog_expires(struct esc *esc, uint32_t microseconds);

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
    uint8_t data[NOTE_LENGTH];   /* the longest object */
};

/* --- objects.c ------------------------------------------------------------------------------- */

/* The objects that can change. The others are constants of the dictionary. */
struct values {
    uint8_t note[NOTE_LENGTH];
    size_t note_length;
    uint8_t limit[2], turns[8], key[4], tuning[2], load[2], gain_of_position[2], gain_of_velocity[1];
    uint8_t control_word[2], status_word[2], mode[1], mode_shown[1], position[4], target_position[4];
};

/* --- drive.c --------------------------------------------------------------------------------- */

enum drive_state {
    NOT_READY, SWITCH_ON_DISABLED, READY_TO_SWITCH_ON, SWITCHED_ON,
    OPERATION_ENABLED, QUICK_STOP_ACTIVE, FAULT_REACTION_ACTIVE, IN_FAULT
};

struct drive {
    enum drive_state state;
    int cause;          /* the cause of the fault is still there */
    uint32_t timer;     /* microseconds until self-test, quick stop or reaction is done; 0: off */
    uint8_t outputs[OUTPUTS_LENGTH];    /* the newest ones; they act in OP */
};

/* --- slave.c --------------------------------------------------------------------------------- */

struct slave {
    struct esc esc;
    struct al al;
    struct mailbox mailbox;
    struct sdo sdo;
    struct values values;
    struct drive drive;
};

/* Power cycle. */
void slave_reset(struct slave *slave);

/* Read or write as a MainDevice. Returns the working counter: 0 where the access is refused. */
int slave_read(struct slave *slave, uint16_t address, uint8_t *data, size_t length);
int slave_write(struct slave *slave, uint16_t address, const uint8_t *data, size_t length);

/* Let time pass. */
void slave_advance(struct slave *slave, uint32_t microseconds);

/* Make something befall the device, named as slave_events has it. Returns 0 if it knows the event. */
int slave_local(struct slave *slave, const char *event);
extern const char *const slave_events[];    /* ends with a null pointer */

/* --- what the layers give each other --------------------------------------------------------- */

void al_reset(struct slave *slave);
void al_request(struct slave *slave, uint16_t control);
void al_settings_changed(struct slave *slave);
void al_watchdog_expired(struct slave *slave);
int al_mailbox_works(const struct slave *slave);

void mailbox_start(struct slave *slave);
void mailbox_serve(struct slave *slave);
void mailbox_repeat(struct slave *slave);

/* Takes the CoE message of a request; writes that of the reply. Returns its length: 0 for silence,
 * or minus a detail of mailbox errors. */
int coe_serve(struct slave *slave, const uint8_t *request, size_t length, uint8_t *reply);
void sdo_start(struct slave *slave);

void objects_reset(struct slave *slave);
/* SDO abort codes. The functions of the dictionary return one of them. */
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

/* `announce` is all that can be judged before the data have come, `download` the rest. */
uint32_t object_upload(const struct slave *slave, uint16_t index, uint8_t subindex, uint8_t *data,
                       size_t *length);
uint32_t object_announce(const struct slave *slave, uint16_t index, uint8_t subindex, size_t length);
uint32_t object_download(struct slave *slave, uint16_t index, uint8_t subindex, const uint8_t *data,
                         size_t length);
int object_exists(uint16_t index);
size_t object_size(uint16_t index, uint8_t subindex);

void drive_reset(struct slave *slave);
void drive_outputs(struct slave *slave);
void drive_inputs(struct slave *slave);
void drive_advance(struct slave *slave, uint32_t microseconds);
void drive_disconnected(struct slave *slave);
void drive_fault(struct slave *slave);
void drive_fault_gone(struct slave *slave);
void drive_done(struct slave *slave, enum drive_state state);

#endif
