/* The application: a drive, its objects and its process data. */
#ifndef APPLICATION_H
#define APPLICATION_H

#include "slave.h"

enum { OUTPUTS_LENGTH = 6, INPUTS_LENGTH = 7, NOTE_LENGTH = LONGEST_OBJECT };

/* --- objects.c ------------------------------------------------------------------------------- */

/* The objects that can change. The others are constants of the dictionary. */
struct values {
    uint8_t note[NOTE_LENGTH];
    size_t note_length;
    uint8_t limit[2], turns[8], key[4], tuning[2], load[2], gain_of_position[2], gain_of_velocity[1];
    uint8_t control_word[2], status_word[2], mode[1], mode_shown[1], position[4], target_position[4];
};

void objects_reset(struct values *values);

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

struct application {
    struct values values;
    struct drive drive;
};

/* Power on, once the stack is. */
void application_reset(struct slave *slave);

/* Raise a local event in the drive, named as application_events has it. Returns 0 if it knows it. */
int application_local(struct slave *slave, const char *event);
extern const char *const application_events[];    /* ends with a null pointer */

#endif
